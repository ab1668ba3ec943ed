"""Effects may enter the first fit, for robots whose geometry runs away without them."""

import json

import law_sessions
import numpy as np
import pytest
from datasets import measured

from parallel_cal.base.errors import FitError, ModelError
from parallel_cal.cli import main as cli
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.identification.fit import fit
from parallel_cal.identification.fit_warnings import list_setting_warnings
from parallel_cal.model.file.modelfile import read_model, write_model
from parallel_cal.model.model import new_model
from parallel_cal.session.session import Session
from parallel_cal.session.steps import UnprovenStepError, add, fitted, remove
from parallel_cal.virtual import joint_effects as ve
from parallel_cal.virtual import robot as vr

WIDTHS = [f"backlash.joint{i}.width" for i in (1, 2, 3)]


@pytest.fixture(scope="module")
def with_backlash():
    return measured(3, effects=[vr.Backlash((0.8e-3, 1.1e-3, 0.9e-3))])


def test_an_effect_in_the_first_fit_is_identified_together_with_the_geometry(with_backlash):
    model = new_model("delta54")
    result = fit(model, with_backlash, effects=["backlash"])
    found = [result.model.value(name) for name in WIDTHS]
    assert found == pytest.approx([0.8e-3, 1.1e-3, 0.9e-3], abs=0.1e-3)
    assert not result.given.model.effects  # compared with the given model
    two_steps = add(fit(model, with_backlash).model, "backlash", with_backlash)
    assert result.model.values == pytest.approx(two_steps.model.values, abs=1e-6)


@pytest.mark.wide
def test_geometry_that_runs_away_alone_is_identified_together_with_the_missing_effect():
    """Drives that go 6 % too far: lengths would have to be what no such robot has."""
    data = measured(2, effects=[ve.WrongPitch((0.06, 0.055, 0.065))])
    model = new_model("delta54")
    alone = fit(model, data, hold_out=0)
    assert "tolerances from its nominal" in alone.implausible
    assert alone.implausible in alone.warnings
    with pytest.raises(UnprovenStepError, match=r"no such robot has this geometry.*diagnose"):
        fitted(model, data, hold_out=0)  # rather than that nothing was held out
    found = fit(model, data, effects=["encoder_gain"], hold_out=0).model
    gains = [found.value(f"encoder_gain.joint{i}.gain") for i in (1, 2, 3)]
    assert gains == pytest.approx([0.06, 0.055, 0.065], rel=0.1)


def test_the_objection_to_a_forced_model_comes_before_all_other_warnings(with_backlash):
    """A terminal shows three warnings; it was the last one."""
    step = fitted(new_model("delta54"), with_backlash, hold_out=0, force=True)
    assert step.acceptance.against
    assert step.warnings == (step.acceptance.against, *step.result.warnings)
    assert step.result.warnings


@pytest.fixture(scope="module")
def with_a_wrong_pitch():
    """A hexapod of which one drive goes 6 % too far."""
    robot = law_sessions.ROBOTS["hexapod"]
    wrong = ve.WrongPitch((0.06, 0, 0, 0, 0, 0))
    return law_sessions.measured(robot, robot.day(3), [wrong], robot.noise, 3)


@pytest.mark.wide
def test_a_step_to_an_implausible_geometry_is_refused_and_says_how_to_go_on(with_a_wrong_pitch):
    model = new_model("stewart42")
    with pytest.raises(UnprovenStepError, match="diagnose MODEL RECORDING") as error:
        fitted(model, with_a_wrong_pitch)
    assert "no such robot has this geometry" in error.value.against
    forced = fitted(model, with_a_wrong_pitch, force=True)
    assert forced.model.history[-1]["forced"] == error.value.against
    assert forced.result.document()["implausible"] == forced.result.implausible != ""
    step = fitted(model, with_a_wrong_pitch, effects=["encoder_gain"])
    assert step.model.value("encoder_gain.leg1.gain") == pytest.approx(0.06, rel=0.05)


@pytest.mark.slow
def test_what_an_implausible_geometry_imitates_is_diagnosed_and_added_at_once(with_a_wrong_pitch):
    model, tested = new_model("stewart42"), ["backlash", "encoder_gain", "encoder_crosstalk"]
    found = diagnose(model, with_a_wrong_pitch, effects=tested)
    assert found.effects == ("encoder_gain",)
    assert found.missing[0]["probability"] == 1.0
    assert found.addition is not None
    step = add(model, found.addition.text, with_a_wrong_pitch)
    assert step.model.value("encoder_gain.leg1.gain") == pytest.approx(0.06, rel=0.05)


@pytest.mark.wide
def test_where_no_effect_makes_the_geometry_plausible_the_error_stays_unexplained(
    with_a_wrong_pitch,
):
    found = diagnose(new_model("stewart42"), with_a_wrong_pitch, effects=["backlash"])
    assert (found.verdict.word, found.effects, found.left) == ("unexplained", (), "yes")
    assert found.base.fitted.implausible


def test_a_step_records_the_effects_that_its_fit_added(with_backlash):
    step = fitted(new_model("delta54"), with_backlash, effects=["backlash"])
    entry = step.model.history[-1]
    assert (entry["step"], entry["effect"]) == ("fit", "backlash")
    assert not step.acceptance.against
    again = fitted(step.model, with_backlash, force=True)
    assert "effect" not in again.model.history[-1]


def test_an_unknown_effect_one_that_the_model_has_and_an_unstated_ratio_are_refused(with_backlash):
    model = new_model("delta54")
    with pytest.raises(ModelError, match=r"backlahs.*backlash"):
        fit(model, with_backlash, effects=["backlahs"])
    with pytest.raises(ModelError, match="the model already has the effect 'backlash'"):
        fit(model.with_effect("backlash"), with_backlash, effects=["backlash"])
    with pytest.raises(FitError, match=r"gear_transmission_error: ratio is not stated.*use 'add'"):
        fit(model, with_backlash, effects=["gear_transmission_error"])
    stated = fit(model, with_backlash, effects=["gear_transmission_error:ratio=80"], hold_out=0)
    assert stated.model.value("gear_transmission_error.ratio") == 80


@pytest.mark.slow
def test_a_setting_far_outside_its_usual_range_is_named_with_its_unit(with_backlash):
    model, effect = new_model("delta54"), "gear_transmission_error:ratio=5000"
    words = "gear_transmission_error.ratio is 5000, but usually 0.001 to 250: settings of effects"
    with pytest.raises(FitError, match=words):
        add(model, effect, with_backlash, hold_out=0)
    forced = add(model, effect, with_backlash, force=True, hold_out=0)
    assert sum(words in one for one in forced.warnings) == 1
    usual = add(model, "gear_transmission_error:ratio=50", with_backlash, force=True, hold_out=0)
    assert not any("settings of effects" in one for one in usual.warnings)


def test_a_lead_that_was_meant_in_mm_is_named_in_m():
    model = new_model("stewart42").with_effect("screw_pitch_error", {"lead": 5.0})
    [words] = list_setting_warnings(model)
    assert words.startswith("screw_pitch_error.lead is 5 m, but usually 0.0001 to 0.1 m: settings")


def test_parameters_of_an_effect_that_a_step_adds_or_removes_can_be_fixed(with_backlash):
    model = new_model("delta54")
    step = add(model, "backlash", with_backlash, fix=[WIDTHS[0]])
    assert step.model.value(WIDTHS[0]) == 0
    assert step.model.value(WIDTHS[1]) == pytest.approx(1.1e-3, abs=0.1e-3)
    assert step.rival.free.sum() == len(model.table) - model.fixed.sum()
    in_first_fit = fit(model, with_backlash, effects=["backlash"], fix=[WIDTHS[0]])
    assert in_first_fit.model.value(WIDTHS[0]) == 0
    smaller = remove(step.model, "backlash", with_backlash, True, fix=[WIDTHS[0]])
    assert not smaller.model.effects
    with pytest.raises(ModelError, match=r"no parameter matches 'backlash.joint9.width'"):
        add(model, "backlash", with_backlash, fix=["backlash.joint9.width"])


def run(*arguments):
    with pytest.raises(SystemExit) as ended:
        cli.main([str(a) for a in arguments])
    return ended.value.code


def test_the_command_fit_adds_effects_and_a_session_does(with_backlash, tmp_path, capsys):
    robot, samples, better = (tmp_path / n for n in ("robot.yaml", "samples.json", "better.yaml"))
    write_model(new_model("delta54"), robot)
    with_backlash.to_json(samples)
    fixed = ("--fix", "backlash.joint1.width")
    assert run("fit", robot, samples, "--effect", "backlash", *fixed, "-o", better, "--json") == 0
    assert "backlash.joint2.width" in json.loads(capsys.readouterr().out)["parameters"]
    model = read_model(better)
    assert [effect.name for effect in model.effects] == ["backlash"]
    assert model.value(WIDTHS[0]) == 0
    session = Session.new(tmp_path / "session", new_model("delta54"), [samples])
    state = session.fit(effects=["backlash"])
    assert state.step == "fit with backlash"
    assert session.model.value(WIDTHS[1]) == pytest.approx(1.1e-3, abs=0.1e-3)
    assert np.isfinite(state.position_rms)
