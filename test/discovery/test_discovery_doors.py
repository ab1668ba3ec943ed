"""Where a user finds laws: in a session, on the page of the workbench, and in the report."""

import json
import shutil
import sys

import numpy as np
import pytest
from workbench_page import LONG, Served, opened, until

from parallel_cal.base.errors import ModelError
from parallel_cal.cli import main as cli
from parallel_cal.discovery.folds import Choice
from parallel_cal.discovery.in_session import discover_in_session, name_effect, write_laws
from parallel_cal.discovery.law import Discovery, Law
from parallel_cal.identification.prediction_errors import Summary
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.model.shelf import add_plugin_folder, load_effect
from parallel_cal.model.summary import summarise_model
from parallel_cal.reporting.page import page
from parallel_cal.reporting.report import report
from parallel_cal.session.history import SessionError
from parallel_cal.session.session import Session

MODEL, BAG = "config/delta_mockup_nominal.yaml", "bags/delta_crosstalk"
TEXT = """from parallel_cal import Effect, Parameter


class FoundLaw(Effect):
    found_in_data = True
    physics = source = "a test"

    def parameters(self, mechanism):
        return [Parameter("a", "rad", 0.0, 1e-3)]

    def ideal(self, seen, e, at, mechanism):
        return seen.with_q(seen.q + e.a)
"""


def run_command(*arguments):
    given = list(map(str, arguments))
    cli.application(given)(given, standalone_mode=False)


def law(place="joint2", text=TEXT):
    """A proven law with this effect file; its numbers do not matter here."""
    errors = Summary(position_mean=1e-5, position_rms=1e-5)
    return Law(
        place=place,
        drivers=("payload",),
        formula="a",
        unit="rad",
        parameters=(),
        share=0.9,
        before=errors,
        after=errors,
        noise_floor=errors,
        tested={"payload": (0.0, 2.0)},
        alternatives=("chain1.La_y by payload",),
        choice=Choice(np.full(2, 4.0), np.ones(2), np.ones(2), np.arange(2)),
        evidence=9.0,
        threshold=5.0,
        against="",
        device_may_err=False,
        of_device=False,
        sentence="It errs",
        text=text,
    )


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """A session whose error no effect describes: after the fit and its discovery."""
    folder = tmp_path_factory.mktemp("sessions") / "fitted"
    session = Session.new(folder, read_model(MODEL), [BAG])
    session.fit()
    return session


# ------------------------------------------------------------------ effect files of a session


def test_an_effect_file_in_a_plugin_folder_is_loaded_by_name_and_hides_no_other_module(tmp_path):
    path = list(sys.path)
    (tmp_path / "effects").mkdir()
    (tmp_path / "effects" / "law_of_a_folder.py").write_text(TEXT)
    (tmp_path / "effects" / "absent_elsewhere.py").write_text("raise SystemExit\n")
    with pytest.raises(ModelError, match="no effect 'law_of_a_folder'"):
        load_effect("law_of_a_folder")
    add_plugin_folder(tmp_path / "effects")
    assert load_effect("law_of_a_folder").found_in_data
    assert load_effect("law_of_a_folder").name == "law_of_a_folder"
    assert sys.path == path
    with pytest.raises(ModuleNotFoundError):
        __import__("absent_elsewhere")
    sys.modules.pop("law_of_a_folder")


def test_an_effect_file_with_an_error_is_reported_and_can_be_mended(tmp_path):
    add_plugin_folder(tmp_path)
    file = tmp_path / "law_with_an_error.py"
    file.write_text("1 / 0\n")
    with pytest.raises(ModelError, match=r"law_with_an_error.*division by zero"):
        load_effect("law_with_an_error")
    file.write_text(TEXT)
    assert load_effect("law_with_an_error").found_in_data
    sys.modules.pop("law_with_an_error")


def test_the_name_of_a_law_follows_from_its_place_and_its_text(tmp_path):
    one, other = law("chain1.La_y"), law("joints, each its own", TEXT + "\n")
    assert name_effect(one).startswith("law_chain1_La_y_")
    assert name_effect(other).startswith("law_joints_")
    assert name_effect(one) != name_effect(law("chain1.La_y", TEXT + "\n"))
    files = write_laws([one, other], tmp_path / "effects")
    assert [file.read_text() for file in files] == [TEXT, TEXT + "\n"]
    assert write_laws([], tmp_path / "nothing") == []
    assert not (tmp_path / "nothing").exists()


# ------------------------------------------------------------------ a session


@pytest.mark.wide
def test_a_law_that_a_session_finds_is_added_saved_and_reported_with_its_cause_unknown(
    fitted, tmp_path, capsys
):
    folder = shutil.copytree(fitted.folder, tmp_path / "s")
    run_command("session", "discover", folder, "--json")
    document = json.loads(capsys.readouterr().out)
    (file,) = (tmp_path / "s" / "effects").iterdir()
    assert document["verdict"] == "described"
    assert document["files"] == [str(file)]
    session = Session(folder)
    state = session.state
    assert state.step == "fit"
    session.add(file.stem)
    assert session.state.step == f"add {file.stem} (found in data, cause unknown)"
    assert session.state.errors["position_rms"] < 0.5 * state.errors["position_rms"]
    steps = summarise_model(session.model)["steps"]
    assert steps[-1] == f"add {file.stem} (cause unknown: found in data)"
    run_command("session", "save", folder, "-o", tmp_path / "robot.yaml")
    said = capsys.readouterr().out
    assert f"need {file.stem}.py on their Python path: add {folder / 'effects'}" in said
    found = report(session.model, session.dataset)
    assert f"The effect {file.stem} was found in data; its physical cause" in page(found)
    assert found.document()["provenance"]["found_in_data"] == [file.stem]


# ------------------------------------------------------------------ the page


@pytest.mark.wide
def test_the_page_finds_a_law_under_an_unexplained_verdict_and_adds_it(fitted, tmp_path):
    folder = shutil.copytree(fitted.folder, tmp_path / "s")
    with opened() as browser:
        served = Served(folder)
        try:
            window = browser.new_page(viewport={"width": 1280, "height": 1000})
            window.set_default_timeout(1000 * LONG)
            window.goto(served.url)
            window.locator("#verdict").get_by_text("unexplained").wait_for()
            find = window.get_by_role("button", name="Find its law", exact=True)

            find.click()  # a search that is cancelled leaves nothing behind
            window.locator("#stage").get_by_text("screening").wait_for()
            window.get_by_role("button", name="Cancel", exact=True).click()
            window.locator("#message").get_by_text("cancelled; the session is un").wait_for()
            assert not (folder / "laws").exists()
            assert not (folder / "effects").exists()

            find.click()
            window.locator("#law").get_by_text("described: The reading of joint1").wait_for()
            region = window.get_by_role("region", name="Law of the error")
            region.get_by_role("figure", name="joints by next_joint: the error wit").wait_for()
            assert region.get_by_role("cell", name="joints by next_joint").count() == 1
            assert "99 %" in region.inner_text()
            (file,) = (folder / "effects").iterdir()
            assert f"effect file: {file}" in region.inner_text()
            assert Session(folder).state.step == "fit"

            region.get_by_role("button", name="Add joints by next_joint").click()
            history = window.get_by_role("region", name="History")
            history.get_by_text(f"add {file.stem} (found in data, cause unknown)").wait_for()
            window.locator("#verdict-words").get_by_text("its physical cause is unknown").wait_for()
            until(lambda: region.count() == 0, "the end of the search that this step answered")

            window.get_by_role("button", name="Undo", exact=True).click()
            window.locator("#law").get_by_text("described: ").wait_for()  # it is kept
        finally:
            served.end()


@pytest.mark.slow
def test_the_page_does_not_offer_a_search_where_an_effect_explains_the_error(tmp_path):
    from parallel_cal.workbench.bench import Bench

    session = Session.new(tmp_path / "s", read_model(MODEL), ["bags/delta_backlash"])
    session.fit()
    bench = Bench(session.folder)
    until(lambda: not bench.working, "the first look")
    assert bench.session.state.verdict == "explained"
    assert not bench.view["find_law"]
    bench.close()


def test_the_view_of_a_discovery_lists_every_law_and_offers_only_proven_ones(tmp_path):
    from dataclasses import replace

    from parallel_cal.workbench.law_view import make_law_view

    proven, doubted = law(), replace(law("device.z"), against="the device may cause it")
    model = read_model(MODEL)
    found = Discovery(model, (), (proven,), (doubted,), "described", "words", ("more",), model)
    view = make_law_view(found, [tmp_path / "law_a.py"])
    shown = view["table"]["rows"]
    assert [row["law"] for row in shown] == ["joint2 by payload", "device.z by payload"]
    assert [row["proven"] for row in shown] == ["yes", "no: the device may cause it"]
    assert {row["or"] for row in shown} == {"chain1.La_y by payload"}
    assert [one["name"] for one in view["effects"]] == ["law_a"]
    assert view["words"] == "described: words"
    json.dumps(view)


def test_a_search_without_samples_says_so(tmp_path):
    session = Session.new(tmp_path / "s", read_model(MODEL), [])
    with pytest.raises(SessionError, match="no samples yet"):
        discover_in_session(session)
