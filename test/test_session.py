"""A session in a folder: steps, undo, branches, exclusions; found again whatever happened."""

import json
import multiprocessing
import shutil

import numpy as np
import pytest

from parallel_cal.base.errors import BagError, DatasetError, FitError
from parallel_cal.identification.options import FitOptions
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.recordings.loading import load_dataset
from parallel_cal.session.session import Session, SessionError

MODEL, BAG = "config/delta_mockup_nominal.yaml", "bags/delta_backlash"


@pytest.fixture(scope="module")
def begun(tmp_path_factory):
    """A session after its first fit, to be copied."""
    folder = tmp_path_factory.mktemp("session") / "s"
    session = Session.new(folder, read_model(MODEL), [BAG], fitting=FitOptions(hold_out=0.5))
    session.fit()
    return folder


@pytest.fixture
def session(begun, tmp_path):
    shutil.copytree(begun, tmp_path / "s")
    return Session(tmp_path / "s")


def test_a_step_leaves_a_state_with_its_errors_and_its_model(session):
    first, fit = session.history()
    assert (first.step, fit.step) == ("begin", "fit")
    assert fit.errors["position_rms"] < 0.1 * fit.before["position_rms"]
    assert fit.noise["position_rms"] < fit.errors["position_rms"]
    assert session.model.history[-1]["step"] == "fit"
    assert session.options.hold_out == 0.5


def test_an_effect_that_helps_is_added_and_one_that_does_not_leaves_no_state(session):
    before = session.state
    with pytest.raises(FitError):
        session.add("thermal_expansion")
    assert session.state == before
    after = session.add("backlash")
    assert after.position_rms < before.position_rms
    assert after.parent == before.number


def test_undo_and_redo_walk_along_the_branch(session):
    fit = session.state
    assert session.undo().step == "begin"
    assert "fit" not in [entry["step"] for entry in session.model.history]
    with pytest.raises(SessionError, match="this is where the session began"):
        session.undo()
    assert session.redo() == fit
    with pytest.raises(SessionError, match="nothing to redo"):
        session.redo()


def test_a_new_step_after_undo_forgets_what_was_undone_but_keeps_it_on_disk(session):
    session.undo()
    session.exclude({3: "bumped"})
    with pytest.raises(SessionError, match="nothing to redo"):
        session.redo()
    assert len(session.record.states) == 3


def test_branches_stand_side_by_side(session):
    fit = session.state
    session.start_branch("without sample 7")
    session.exclude({7: "the tracker was jostled"})
    with pytest.raises(SessionError, match="already"):
        session.start_branch("main")
    assert session.switch("main") == fit
    beside = session.compared()
    assert list(beside) == ["main", "without sample 7"]
    assert beside["without sample 7"].excluded == {7: "the tracker was jostled"}
    with pytest.raises(SessionError, match=r"no branch 'other'; there are main, without sample 7"):
        session.switch("other")


def test_an_excluded_sample_keeps_the_others_numbers_and_can_be_taken_back(session):
    fit = session.state
    out = session.exclude({5: "slipped"})
    assert out.before == fit.errors  # not those of a model that knew the samples
    assert not out.against
    assert 5 not in session.dataset.numbers
    assert len(session.samples) == len(session.dataset) + 1
    session.include([5])
    assert session.state.excluded == {}
    with pytest.raises(SessionError, match="sample 5 is not excluded"):
        session.include([5])
    with pytest.raises(SessionError, match="no sample 999"):
        session.exclude({999: "?"})


def test_another_program_finds_the_same_session_and_changes_are_seen(session):
    other = Session(session.folder)
    other.start_branch("beside")
    assert session.refresh()
    assert session.record.branch == "beside"
    assert not session.refresh()


def test_a_step_of_a_session_that_was_changed_meanwhile_is_refused(session):
    other = Session(session.folder)
    session.undo()
    with pytest.raises(SessionError, match="changed meanwhile"):
        other.fit()
    assert Session(session.folder).state.step == "begin"


def _branches(folder, names):
    session = Session(folder)
    for name in names:
        session.start_branch(name)


def test_two_that_write_at_once_lose_nothing(session):
    names = [[f"{who}{k}" for k in range(20)] for who in "ab"]
    context = multiprocessing.get_context("spawn")
    both = [context.Process(target=_branches, args=(session.folder, n)) for n in names]
    for one in both:
        one.start()
    for one in both:
        one.join(120)
    assert set(Session(session.folder).record.branches) == {"main", *names[0], *names[1]}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d.update(parallel_cal_session=9), "parallel_cal_session is 9, expected 1"),
        (lambda d: d["states"][1].update(parent="none"), "states.1.parent: Input should be"),
        (lambda d: d.update(speed=1), "speed: Extra inputs"),
    ],
)
def test_a_broken_session_file_is_named_with_its_key(session, change, words):
    file = session.folder / "session.json"
    document = json.loads(file.read_text())
    change(document)
    file.write_text(json.dumps(document))
    with pytest.raises(SessionError, match=words):
        Session(session.folder)


def test_a_folder_without_a_session_and_one_with_are_told(session, tmp_path):
    with pytest.raises(SessionError, match="no session here"):
        Session(tmp_path)
    with pytest.raises(SessionError, match="holds a session already"):
        Session.new(session.folder, read_model(MODEL), [BAG])
    with pytest.raises(BagError):
        Session.new(tmp_path / "new", read_model(MODEL), [tmp_path / "none"])
    assert not (tmp_path / "new").exists()


def test_samples_can_be_taken_while_a_session_goes_on(session, tmp_path):
    every = load_dataset(BAG)
    live = Session.new(tmp_path / "live", read_model(MODEL), [])
    with pytest.raises(SessionError, match="no samples yet"):
        live.fit()
    live.take(every.select(range(60)).to_json)
    fit = live.fit()
    live.exclude({4: "bumped", 7: "bumped"})
    live.take(every.select([*range(7), *range(8, 80)]).to_json)  # one was removed at the cell
    assert live.state.excluded == {4: "bumped"}
    assert len(live.dataset) == 78
    assert live.state.errors == {}  # nothing was identified on these yet
    assert live.fit().before["position_rms"] == pytest.approx(fit.errors["position_rms"], rel=0.2)
    for _ in range(4):
        live.undo()
    assert len(Session(live.folder).dataset) == 60


def test_a_sample_can_be_opened_to_the_readings_it_was_made_of(session, tmp_path):
    seen = session.signals(5)
    inside = np.abs(seen.time) < seen.duration / 2
    assert inside.sum() > 20
    assert np.abs(seen.joints[inside].mean(axis=0)).max() < 1e-6  # the robot stood still here
    assert np.abs(seen.joints).max() > 1e-3  # and moved before and after
    assert np.abs(seen.position[np.abs(seen.pose_time) < 0.3 * seen.duration]).max() < 2e-4
    both = Session.new(tmp_path / "two", read_model(MODEL), ["bags/delta_eccentricity", BAG])
    first = int(both.samples.conditions["session"].sum())
    again = both.signals(len(both.samples) - first + 5)  # the same sample of the later session
    np.testing.assert_allclose(again.time, seen.time, atol=1e-9)
    np.testing.assert_array_equal(again.joints, seen.joints)
    live = Session.new(tmp_path / "live", read_model(MODEL), [])
    live.take(session.samples.to_json)
    with pytest.raises(DatasetError, match="holds samples, not the readings"):
        live.signals(5)


def test_poses_are_planned_for_what_is_free_here(session, run_cli):
    file = session.plan(8)
    names, *rows = file.read_text().splitlines()
    assert names.startswith("x,y,z,qx,qy,qz,qw,joint1,joint2,joint3")
    assert len(rows) == 8
    assert run_cli("session", "plan", session.folder, "--poses", "9").strip().endswith("9 poses")


def test_what_is_identified_can_be_chosen_anew_and_that_is_undone_too(session):
    fixed = session.choose(fix=["chain1.*"], prior=True)
    assert fixed.step == "fix chain1.*, prior True"
    assert (session.options.fix, session.options.prior) == (["chain1.*"], True)
    assert session.options.hold_out == 0.5
    again = Session(session.folder)
    assert again.exclude({3: ""}).fitting == fixed.fitting
    assert again.undo() == fixed
    assert again.undo().fitting == {}


@pytest.mark.wide
def test_the_command_line_takes_the_same_steps_and_remembers_options(session, run_cli, tmp_path):
    folder = tmp_path / "mine"
    run_cli("session", "new", folder, MODEL, BAG, "--hold-out", "0.5", "--fix", "chain1.Lb")
    shown = run_cli("session", "fit", folder)
    assert shown.startswith("fit: error at poses left out 606 um to ")
    assert Session(folder).options.fix == ["chain1.Lb"]
    run_cli("session", "branch", folder, "beside")
    run_cli("session", "exclude", folder, 3, 4, "--reason", "bumped")
    shown = run_cli("session", "show", folder)
    assert "exclude 3, 4: error at poses left out" in shown
    assert "; 2 samples left out" in shown
    assert "* beside  exclude 3, 4" in shown
    run_cli("session", "include", folder, 3)
    run_cli("session", "undo", folder)
    document = json.loads(run_cli("session", "redo", folder, "--json"))
    assert [state["step"] for state in document["history"]][-1] == "include 3"
    run_cli("session", "switch", folder, "main")
    run_cli("session", "save", folder, "-o", tmp_path / "out.yaml")
    assert read_model(tmp_path / "out.yaml").history[-1]["step"] == "fit"


@pytest.mark.wide
def test_a_verdict_stays_with_its_state(session, run_cli):
    assert "explained: backlash" in run_cli("session", "diagnose", session.folder)
    assert "  explained: backlash" in run_cli("session", "show", session.folder)
    run_cli("session", "add", session.folder, "backlash")
    assert Session(session.folder).state.verdict == ""
