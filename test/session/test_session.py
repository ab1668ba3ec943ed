"""A session in a folder: steps, undo, branches, exclusions; found again whatever happened."""

import dataclasses
import json
import multiprocessing
import shutil
from pathlib import Path

import numpy as np
import pytest
import virtual_findings as vf
from findings import hiding

from parallel_cal.base.errors import (
    BagError,
    DatasetError,
    FitError,
    ModelError,
    ParallelCalError,
)
from parallel_cal.base.progress import ignore_progress
from parallel_cal.cli.main import main
from parallel_cal.diagnosis.comparison import compare
from parallel_cal.identification.noise_figures import noise_in_use
from parallel_cal.identification.observations import observe
from parallel_cal.identification.options import FitOptions
from parallel_cal.model.file.modelfile import model_hash, read_model
from parallel_cal.model.model import new_model
from parallel_cal.recordings.loading import load_dataset
from parallel_cal.session.saving import (
    HELD_OUT,
    PERHAPS_USED,
    SaveRefused,
    compare_with_model_in_use,
)
from parallel_cal.session.session import Session, SessionError
from parallel_cal.session.table_preview import preview_file
from parallel_cal.workbench.views import view

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


def test_a_new_session_does_not_read_its_recordings_again(tmp_path, monkeypatch):
    session = Session.new(tmp_path / "new", read_model(MODEL), [BAG])
    monkeypatch.setattr("parallel_cal.session.session.load_sessions", None)
    assert len(session.samples) == 94


def test_an_effect_that_helps_is_added_and_one_that_does_not_leaves_no_state(session):
    before = session.state
    with pytest.raises(FitError, match="thermal_expansion"):
        session.add("thermal_expansion")
    assert session.state == before
    after = session.add("backlash")
    assert after.position_rms < before.position_rms
    assert after.parent == before.number


@pytest.mark.wide
def test_a_second_fit_is_as_good_as_the_first(session):
    first = session.state
    second = session.fit()
    assert second.before == first.errors
    assert second.errors == pytest.approx(first.errors)
    assert second.against == first.against == ""


@pytest.mark.wide
def test_a_session_of_a_fitted_file_says_that_its_samples_are_known(session, tmp_path):
    from parallel_cal.workbench.views import view

    again = Session.new(tmp_path / "again", session.model, [BAG], fitting=FitOptions(hold_out=0.5))
    seen = view(again, lambda stage, fraction: None)
    assert "its error is in-sample" in seen["verdict"]["words"]
    assert seen["tiles"][0]["about"] == "in-sample error"
    state = again.fit()
    assert state.before == state.errors == pytest.approx(session.state.errors)
    assert "the model was fitted to these samples before" in state.against


def test_undo_and_redo_walk_along_the_branch(session):
    fit = session.state
    assert session.undo().step == "begin"
    assert "fit" not in [entry["step"] for entry in session.model.history]
    with pytest.raises(SessionError, match="this is the first state of the session"):
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
    assert out.before == {}  # the validation error of the fit was one at other samples
    assert (fit.samples, out.samples) == (94, 93)
    assert 0.02 < out.sigmas["position"] / out.errors["position_rms"] < 0.1
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
    with pytest.raises(SessionError, match="changed in the meantime"):
        other.fit()
    assert Session(session.folder).state.step == "begin"


def _branches(folder, names):
    session = Session(folder)
    for name in names:
        session.start_branch(name)


@pytest.mark.wide
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
        (lambda d: d.update(parallel_cal_session=9), "parallel_cal_session is 9, expected 2"),
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


def test_a_folder_without_a_session_and_one_with_a_session_are_reported(session, tmp_path):
    with pytest.raises(SessionError, match="no session here"):
        Session(tmp_path)
    with pytest.raises(SessionError, match="already holds a session"):
        Session.new(session.folder, read_model(MODEL), [BAG])
    with pytest.raises(BagError, match="none: no such"):
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
    with pytest.raises(DatasetError, match="contains samples, not the raw readings"):
        live.signals(5)


def test_poses_are_planned_for_what_is_free_here(session, run_cli):
    file = session.plan(8)
    lines = file.read_text().splitlines()
    names, *rows = [line for line in lines if not line.startswith("#")]
    assert names.startswith("x [m],y [m],z [m]")
    assert len(rows) == 8
    assert run_cli("session", "plan", session.folder, "--poses", "9").strip().endswith("9 poses")


def test_a_plan_expects_the_noise_of_the_samples(session, tmp_path):
    """A table that states 150 um and one that states 15 um gave the same forecast: 15.2 um."""

    def forecast(of):
        words = of.plan(12).read_text().split("position error of ", 1)[1]
        return float(words.split(" um", 1)[0])

    data, fitted = session.samples, forecast(session)
    noise = noise_in_use(session.model, observe(session.model, data))
    assert session.state.weights == vars(noise)
    loud = dataclasses.replace(data, pose_cov=100 * data.pose_cov)
    loud.to_json(tmp_path / "loud.json")
    louder = Session.new(tmp_path / "louder", session.model, [tmp_path / "loud.json"])
    assert louder.state.weights == {}
    assert forecast(louder) > 5 * fitted


def test_what_is_identified_can_be_chosen_anew_and_that_is_undone_too(session):
    fixed = session.choose(fix=["chain1.*"], prior=True)
    assert fixed.step == "fix chain1.*, prior True"
    assert (session.options.fix, session.options.prior) == (["chain1.*"], True)
    assert session.options.hold_out == 0.5
    again = Session(session.folder)
    assert again.exclude({3: ""}).fitting == fixed.fitting
    assert again.undo() == fixed
    assert again.undo().fitting == {}


def test_parameters_are_fixed_at_their_present_or_at_their_nominal_values(session):
    table, fitted = session.model.table, session.model
    at = table.index_of("chain1.D_x")
    assert fitted.values[at] != table.nominal[at]
    session.choose(fix=["chain1.D_x"])
    assert session.model.values[at] == fitted.values[at]
    session.choose(fix=["chain1.D_x"], nominal=["chain1.D_x"])
    assert session.model.values[at] == table.nominal[at]
    assert session.state.step == "fix chain1.D_x at nominal"
    session.choose(fix=["chain1.D_x"], values={"chain1.D_x": 75.9e-3})
    assert session.model.values[at] == 75.9e-3
    assert session.state.step == "fix chain1.D_x at measured values"
    with pytest.raises(ModelError, match=r"no parameter matches 'chain1\.none'"):
        session.choose(nominal=["chain1.none"])


@pytest.mark.wide
def test_the_command_line_takes_the_same_steps_and_remembers_options(session, run_cli, tmp_path):
    folder = tmp_path / "mine"
    run_cli("session", "new", folder, MODEL, BAG, "--hold-out", "0.5", "--fix", "chain1.Lb")
    shown = run_cli("session", "fit", folder)
    assert shown.startswith("fit: validation error 606 um to ")
    assert Session(folder).options.fix == ["chain1.Lb"]
    run_cli("session", "branch", folder, "beside")
    run_cli("session", "exclude", folder, 3, 4, "--reason", "bumped")
    shown = run_cli("session", "show", folder)
    assert "exclude 3, 4: validation error" in shown
    assert "; 2 excluded samples" in shown
    assert "* beside  exclude 3, 4" in shown
    run_cli("session", "include", folder, 3)
    run_cli("session", "undo", folder)
    document = json.loads(run_cli("session", "redo", folder, "--json"))
    assert [state["step"] for state in document["history"]][-1] == "include 3"
    run_cli("session", "switch", folder, "main")
    run_cli("session", "save", folder, "-o", tmp_path / "out.yaml")
    entry = read_model(tmp_path / "out.yaml").history[-1]
    # Reports show the step under its name in the session, and know the samples that judged it.
    assert (entry["step"], entry["label"], entry.get("excluded")) == ("fit", "fit", None)
    entry = Session(folder)._model(Session(folder).history("beside")[-1]).history[-1]
    assert (entry["step"], entry["label"], entry["excluded"]) == ("fit", "include 3", [4])


@pytest.mark.wide
def test_a_verdict_stays_with_its_state(session, run_cli):
    assert "explained: backlash" in run_cli("session", "diagnose", session.folder)
    assert "  explained: backlash" in run_cli("session", "show", session.folder)
    run_cli("session", "add", session.folder, "backlash")
    assert Session(session.folder).state.verdict == ""


@pytest.fixture(scope="module")
def knocked(tmp_path_factory):
    """A fitted session in which somebody knocked the device at sample 17."""
    data, _ = hiding([vf.KINDS["backlash"]], 0.8, seed=40)
    data.r[17] += 2e-3 * np.array([0.7, -0.5, 0.5])
    folder = tmp_path_factory.mktemp("knocked")
    data.to_json(folder / "data.json")
    session = Session.new(folder / "s", new_model("delta54"), [folder / "data.json"])
    session.fit()
    return folder / "s"


@pytest.mark.wide
@pytest.mark.parametrize("diagnosed", [True, False])
def test_add_excludes_the_sample_that_the_verdict_excluded(knocked, tmp_path, diagnosed):
    shutil.copytree(knocked, tmp_path / "s")
    session = Session(tmp_path / "s")
    if diagnosed:
        found = session.diagnose(effects=["backlash", "base_drift"])
        assert [one.sample for one in found.knocked] == [17]
        assert Session(tmp_path / "s").state.knocked == [17]
    state = session.add("backlash")
    assert state.samples == 149
    assert state.step == "add backlash without sample 17"
    assert list(state.excluded) == [17]
    assert "far from all others" in state.excluded[17]
    assert state.knocked is None  # of a diagnosis that is not made yet
    assert len(session.dataset) == 149
    assert session.undo().excluded == {}


@pytest.mark.wide
def test_add_uses_all_samples_if_the_verdict_did(knocked, tmp_path):
    shutil.copytree(knocked, tmp_path / "s")
    session = Session(tmp_path / "s")
    session.record_verdict(session.state, "unexplained", "no effect explains this", [])
    state = session.add("backlash", force=True)
    assert state.samples == 150
    assert not state.excluded


@pytest.mark.wide
def test_the_page_shows_the_model_that_save_writes_although_the_verdict_leaves_a_sample_out(
    knocked, tmp_path
):
    shutil.copytree(knocked, tmp_path / "s")
    session = Session(tmp_path / "s")
    made = view(session, ignore_progress)
    assert [*made["knocked"]] == [17]
    now = next(tile for tile in made["tiles"] if tile["name"] == "now")
    assert now["values"][0][0].startswith(f"{1e6 * session.state.errors['position_rms']:.0f} ")
    (row,) = (row for row in made["parameters"]["rows"] if row["name"] == "chain1.D_x")
    assert row["value"] == pytest.approx(1e3 * session.model.value("chain1.D_x"), abs=1e-3)
    assert made["budget"] is None  # of the fit without the sample
    assert made["iso"] == []
    names = [tile["name"] for tile in made["tiles"]]
    assert names == ["before this step", "now", "now, without sample 17", "noise floor"]


def test_a_model_that_was_fitted_with_a_sample_is_not_judged_as_if_it_had_been_held_out(
    knocked, tmp_path
):
    shutil.copytree(knocked, tmp_path / "s")
    session = Session(tmp_path / "s")
    session.save(tmp_path / "robot.yaml", lambda found: True)
    session.exclude({17: "knocked"})
    assert session.state.reason == "knocked"
    assert "forced" not in session.model.history[-1]
    found = []
    session.save(tmp_path / "robot.yaml", lambda replacement: found.append(replacement) or True)
    in_use, this = found[0].models
    assert (in_use.where, this.where) == (PERHAPS_USED, HELD_OUT)
    assert in_use.samples == this.samples == 149
    expected = compare(read_model(tmp_path / "robot.yaml.previous"), session.dataset)
    assert in_use.errors.position_rms == pytest.approx(expected.errors.summary.position_rms)


# ------------------------------------------------------------------ over the model in use


@pytest.fixture(scope="module")
def with_backlash(begun, tmp_path_factory):
    """A model file with backlash, better than the geometry alone of the session after its fit."""
    folder = tmp_path_factory.mktemp("backlash")
    shutil.copytree(begun, folder / "s")
    session = Session(folder / "s")
    session.add("backlash")
    session.save(folder / "robot.yaml")
    return folder / "robot.yaml"


@pytest.fixture
def in_use(with_backlash, tmp_path):
    """A robot's model file, as a campaign leaves it."""
    return Path(shutil.copy(with_backlash, tmp_path / "robot.yaml"))


def test_a_model_that_is_worse_than_the_one_in_use_is_refused_with_both_errors(session, in_use):
    before = in_use.read_text()
    with pytest.raises(SaveRefused) as refused:
        session.save(in_use)
    words = str(refused.value)
    assert "the model in use has an error of 32.5 um" in words
    assert "this model of 37 um" in words
    assert words.count("at held-out poses") == 2
    assert "worse by a factor of 1.07 (position and orientation together)" in words
    assert in_use.read_text() == before
    assert session.state.step == "fit"


def test_a_worse_model_is_written_where_the_owner_insists_and_the_history_keeps_that(
    session, in_use
):
    better = in_use.read_text()
    found = session.save(in_use, insist=lambda replacement: True)
    written = read_model(in_use)
    assert not written.effects
    entry = written.history[-1]
    assert entry["step"] == "save"
    assert "this model is worse" in entry["forced"]
    assert entry["errors"]["position_rms"] == pytest.approx(37.0e-6, rel=0.01)
    assert entry["in_use"]["errors"]["position_rms"] == pytest.approx(32.5e-6, rel=0.01)
    assert entry["in_use"]["hash"] == model_hash(better) == found.in_use_hash
    assert in_use.with_name("robot.yaml.previous").read_text() == better
    again = Session(session.folder)
    assert again.state.step == "save to robot.yaml, forced"
    assert model_hash(again.model) == model_hash(in_use.read_text())  # the robot uses this state's
    assert again.state.errors == again.history()[-2].errors
    assert again.save(in_use).is_in_use  # nothing to ask, and nothing to write
    assert in_use.with_name("robot.yaml.previous").read_text() == better


def test_a_better_model_is_written_without_a_question_and_both_errors_are_reported(
    session, tmp_path
):
    file = tmp_path / "robot.yaml"
    shutil.copy(MODEL, file)
    found = session.save(file)
    assert not found.objections
    assert "has an error of 606 um" in found.comparison
    assert "at samples that none of its fits used, this model of 37 um" in found.comparison
    assert "better by a factor of" in found.comparison
    in_use, this = found.models
    assert (in_use.errors, this.errors) == (found.in_use_errors, found.errors)
    assert in_use.samples == this.samples == 94
    assert 0 < this.sigmas["position"] < 0.1 * this.errors.position_rms
    assert read_model(file).history[-1]["step"] == "fit"
    assert Session(session.folder).state == session.state


def test_a_model_in_use_that_other_samples_made_is_judged_as_it_is(session, in_use, tmp_path):
    """A campaign's samples come back through calibration_node under another hash."""
    live = Session.new(tmp_path / "live", read_model(MODEL), [], fitting=FitOptions(hold_out=0.5))
    live.take(dataclasses.replace(session.samples, sha256="of the collection").to_json)
    live.fit()
    with pytest.raises(
        SaveRefused, match="at samples that one of its fits may have used"
    ) as refused:
        live.save(in_use)
    errors = refused.value.replacement
    assert errors.in_use_errors.position_rms < errors.errors.position_rms


def test_a_step_that_was_refused_and_forced_is_named_before_its_model_is_saved(session, tmp_path):
    def read_samples():
        raise DatasetError("no samples are here")

    forced = session.state.model_copy(update={"against": "the error at held-out poses rises"})
    for state, refused in ((session.state, False), (forced, True)):
        found = compare_with_model_in_use(
            session.model, state, read_samples, tmp_path / "robot.yaml"
        )
        assert ("the error at held-out poses rises" in found.objections) == refused
        assert "the errors of this model are not known: no samples are here" in found.objections


def test_an_amber_model_is_written_only_where_the_owner_insists(session, tmp_path):
    file = tmp_path / "robot.yaml"
    session.record_verdict(session.state, "explained", "backlash explains what is left")
    with pytest.raises(
        SaveRefused, match="the verdict on this model is explained, not yet in the model: backlash"
    ):
        session.save(file)
    assert not file.exists()
    session.save(file, insist=lambda replacement: True)
    assert "explained, not yet in the model: backlash" in read_model(file).history[-1]["forced"]


def test_the_verdict_and_not_its_sentence_decides_whether_a_model_is_amber(session, tmp_path):
    session.record_verdict(session.state, "at_noise", "explained: no effect is needed")
    session.save(tmp_path / "robot.yaml")
    session.record_verdict(session.state, "unexplained", "at_noise: no effect fits")
    with pytest.raises(SaveRefused, match="the verdict on this model is unexplained: at_noise"):
        session.save(tmp_path / "other.yaml")


def test_a_session_file_of_version_1_is_read_and_is_written_as_version_2(session, run_cli):
    file = session.folder / "session.json"
    session.record_verdict(session.state, "explained", "backlash: 3.7 sigmas")
    document = json.loads(file.read_text())
    assert document["states"][1]["verdict"] == "explained"
    document["parallel_cal_session"] = 1
    for state in document["states"]:
        text = f"{state['verdict']}: {state['summary']}" if state["verdict"] else ""
        state["verdict"] = text
        del state["summary"]
    file.write_text(json.dumps(document))

    again = Session(session.folder)
    assert again.state == session.state
    assert again.state.verdict_text == "explained: backlash: 3.7 sigmas"
    assert "  explained: backlash: 3.7 sigmas" in run_cli("session", "show", session.folder)
    again.start_branch("second")
    assert json.loads(file.read_text())["parallel_cal_session"] == 2


def test_what_the_data_cannot_tell_is_asked_before_it_is_written(session, tmp_path):
    session.choose(free=["*"])
    with pytest.raises(SaveRefused, match=r"do not determine .*half length of the platform bar"):
        session.save(tmp_path / "robot.yaml")
    assert not (tmp_path / "robot.yaml").exists()


def test_a_model_that_was_not_identified_on_the_samples_taken_since_is_asked_about(tmp_path):
    every = load_dataset(BAG)
    live = Session.new(tmp_path / "live", read_model(MODEL), [])
    live.take(every.select(range(60)).to_json)
    live.fit()
    live.take(every.to_json)
    with pytest.raises(SaveRefused, match="not identified on this session's samples"):
        live.save(tmp_path / "robot.yaml")


def test_a_model_whose_samples_are_gone_is_written_only_where_the_owner_insists(tmp_path):
    bag = tmp_path / "bag"
    shutil.copytree(BAG, bag)
    session = Session.new(tmp_path / "s", read_model(MODEL), [bag])
    session.fit()
    shutil.rmtree(bag)
    shutil.copy(MODEL, tmp_path / "robot.yaml")
    again = Session(session.folder)
    with pytest.raises(SaveRefused, match="there are no samples to compare them on"):
        again.save(tmp_path / "robot.yaml")
    again.save(tmp_path / "robot.yaml", insist=lambda replacement: True)
    assert read_model(tmp_path / "robot.yaml").history[-1]["step"] == "save"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"\xff\x00 no text", "cannot be compared with this one: .*not YAML"),
        (b"mechanism: [", "cannot be compared with this one: "),
        (
            Path("config/argos_mockup_nominal.yaml").read_bytes(),
            "is a argos.*, this model is a delta",
        ),
    ],
)
def test_a_file_in_use_that_is_no_model_of_this_robot_is_overwritten_only_on_request(
    session, tmp_path, content, words
):
    file = tmp_path / "robot.yaml"
    file.write_bytes(content)
    with pytest.raises(SaveRefused, match=words):
        session.save(file)
    assert file.read_bytes() == content
    session.save(file, insist=lambda replacement: True)
    assert read_model(file).mechanism.name == session.model.mechanism.name
    assert (tmp_path / "robot.yaml.previous").read_bytes() == content


def test_a_confirmation_counts_for_the_models_that_were_compared_and_no_others(session, in_use):
    with pytest.raises(SaveRefused) as refused:
        session.save(in_use)
    confirmed = refused.value.replacement.key
    in_use.write_text(in_use.read_text() + "# a campaign has written another one\n")
    with pytest.raises(SaveRefused):
        session.save(in_use, insist=lambda replacement: replacement.key == confirmed)


def test_a_file_that_is_exchanged_while_it_is_compared_is_not_overwritten(session, in_use):
    def exchange(replacement):
        in_use.write_text("mechanism: another\n")
        return True

    with pytest.raises(SessionError, match="changed during the comparison"):
        session.save(in_use, insist=exchange)
    assert in_use.read_text() == "mechanism: another\n"
    assert Session(session.folder).state.step == "fit"


def test_steps_that_were_undone_can_be_repeated_after_a_model_was_saved(session, in_use):
    session.add("backlash")
    better = session.state
    session.undo()
    session.save(in_use, insist=lambda replacement: True)
    assert session.state.step == "save to robot.yaml, forced"
    assert session.redo() == better


def test_the_command_line_refuses_a_worse_model_unless_forced(session, in_use, run_cli, capsys):
    before = in_use.read_text()
    with pytest.raises(SystemExit) as ended:
        main(["session", "save", str(session.folder), "-o", str(in_use)])
    assert ended.value.code == 1
    said = capsys.readouterr().err
    assert "this model is worse" in said
    assert "--force writes it anyway" in said
    assert in_use.read_text() == before
    document = json.loads(
        run_cli("session", "save", session.folder, "-o", in_use, "--force", "--json")
    )
    assert document["hash"] == model_hash(in_use.read_text())
    assert document["errors"]["position_rms"] > document["in_use"]["errors"]["position_rms"]
    assert "forced" in read_model(in_use).history[-1]


def test_the_reason_for_a_forced_step_is_kept_in_both_histories_and_shown(session, run_cli):
    reason = "its data sheet states it"
    forced = ("--force", "--reason", reason)
    run_cli("session", "add", session.folder, "encoder_gain", *forced)
    session.refresh()
    assert (session.state.step, session.state.reason) == ("add encoder_gain, forced", reason)
    entry = session.model.history[-1]
    assert "does not fall" in entry["forced"]
    assert entry["reason"] == reason
    assert f"reason: {reason}" in run_cli("session", "show", session.folder)


def test_a_step_that_needs_no_force_has_no_reason(session, capsys):
    session.add("backlash", force=True, reason="to be sure")
    assert (session.state.step, session.state.reason) == ("add backlash", "")
    assert "reason" not in session.model.history[-1]
    with pytest.raises(SystemExit) as ended:
        main(["session", "add", str(session.folder), "hysteresis", "--reason", "why"])
    assert ended.value.code == 2
    assert "--reason 'why' is the reason for --force: give both" in capsys.readouterr().err


# ------------------------------------------------------------------ tables

COLUMNS = {
    "joints": {f"joint{k}": {"column": f"arm {k}", "unit": "deg"} for k in (1, 2, 3)},
    "position": {"columns": ["X", "Y", "Z"], "unit": "mm"},
    "noise": {"position": 2e-5},
}


def write_table(file, rows):
    data = load_dataset(BAG)
    numbers = np.column_stack([np.degrees(data.q), 1e3 * data.r])[rows]
    lines = ["arm 1,arm 2,arm 3,X,Y,Z", *(",".join(map(repr, row)) for row in numbers.tolist())]
    file.write_text("\n".join(lines))


def test_a_session_imports_tables_and_keeps_its_excluded_samples(tmp_path):
    first, second = tmp_path / "first.csv", tmp_path / "second.csv"
    write_table(first, slice(0, 40))
    write_table(second, slice(40, 94))
    session = Session.new(tmp_path / "s", read_model(MODEL), [])
    assert session.import_table(first, COLUMNS).step == "import 40 samples of first.csv"
    session.exclude({3: "bumped"})
    assert session.import_table(second, COLUMNS).step == "import 54 samples of second.csv"
    assert session.state.excluded == {3: "bumped"}
    first.unlink()  # the session has its own copy
    again = Session(tmp_path / "s")
    assert (len(again.samples), len(again.dataset)) == (94, 93)
    np.testing.assert_allclose(again.samples.q, load_dataset(BAG).q, atol=1e-12)
    assert np.allclose(again.samples.pose_cov[:, 0, 0], 4e-10)
    again.undo()
    assert len(again.samples) == 40


def test_a_session_imports_samples_that_were_made_of_a_controllers_files(tmp_path):
    file = tmp_path / "touches.json"
    load_dataset(BAG).to_json(file)
    session = Session.new(tmp_path / "s", read_model(MODEL), [])
    assert preview_file(file, session.folder)["words"].startswith("94 samples of 74 poses")
    assert session.import_table(file, {}).step == "import 94 samples of touches.json"
    file.unlink()  # the session has its own copy
    assert len(Session(tmp_path / "s").samples) == 94


def test_a_height_map_is_named_with_the_command_that_reads_it(tmp_path):
    (tmp_path / "map.csv").write_text("RepRapFirmware height map file v2 generated at 2026\n1,2\n")
    session = Session.new(tmp_path / "s", read_model(MODEL), [])
    error = preview_file(tmp_path / "map.csv", session.folder)["error"]
    assert "parallel-cal import rrf map.csv config.g -o touches.json" in error


def test_a_sample_stays_excluded_if_an_imported_table_changes_its_number(tmp_path, session):
    other = load_dataset(BAG).select(np.arange(10))
    other = dataclasses.replace(other, q=other.q + 1e-3, sha256="")
    session.take(other.to_json)
    session.exclude({95: "bumped"})
    excluded = session.samples.q[95]
    write_table(tmp_path / "more.csv", slice(20, 25))
    state = session.import_table(tmp_path / "more.csv", COLUMNS)
    assert state.excluded == {100: "bumped"}
    np.testing.assert_array_equal(session.samples.q[100], excluded)


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("t.xlsx", {}, "t.xlsx: not a table by its suffix: expected .csv, .tsv, .txt, .json"),
        ("t.csv", {"position": {"columns": ["X", "Y", "W"], "unit": "mm"}}, "W"),
        ("t.csv", {"position": {"columns": ["X", "Y", "Z"]}}, "unit"),
    ],
)
def test_a_wrong_import_names_the_cause_and_leaves_the_session_unchanged(
    tmp_path, session, name, change, words
):
    write_table(tmp_path / name, slice(0, 9))
    before = session.state
    with pytest.raises(ParallelCalError, match=words):
        session.import_table(tmp_path / name, COLUMNS | change)
    assert Session(session.folder).state == before
    assert not list((session.folder / "imports").glob("*"))
