"""Tolerances of an effect's own numbers: those of this robot, from its model file."""

import re
from dataclasses import replace

import numpy as np
import pytest
import virtual_findings as vf
from datasets import measured
from findings import dataset

from parallel_cal.base.errors import FitError, ModelFileError
from parallel_cal.identification.fit import fit
from parallel_cal.model.file.modelfile import dump_model, parse_model, read_model, write_model
from parallel_cal.model.model import Noise, new_model
from parallel_cal.model.parameters import Parameter
from parallel_cal.recordings.simulate import simulate
from parallel_cal.session.steps import add, fitted
from parallel_cal.virtual import joint_effects as ve
from parallel_cal.virtual import robot as vr

NAME = "backlash.joint1.width"
BELT = vr.Backlash((3e-2, 2e-2, 2.5e-2))  # 1.7 degrees of play: beyond what any gear has


def with_key(path, key, model):
    """The file of a model with one more key in one of its effect's entries."""
    line = next(x for x in dump_model(model).splitlines() if x.startswith("    joint1.width"))
    path.write_text(dump_model(model).replace(line, line.replace("unit: rad", f"unit: rad, {key}")))
    return path


def test_a_range_grows_with_its_tolerance():
    play = Parameter("play", "rad", 0.0, 1e-4, low=0.0, high=1e-3)
    wide = play.with_tolerance(5e-4)
    assert (wide.low, wide.tolerance) == (0.0, 5e-4)
    assert wide.high == pytest.approx(5e-3)
    assert wide.plausible_range() == pytest.approx((0.0, 5e-3))


def test_noise_may_make_the_estimate_of_no_play_slightly_negative():
    play = Parameter("play", "rad", 0.0, 1e-4, low=0.0, high=1e-3)
    assert play.plausible_range(2e-5) == pytest.approx((-6e-5, 1.06e-3))
    assert play.plausible_range(np.nan) == play.plausible_range() == pytest.approx((0.0, 1e-3))


def test_a_model_file_says_how_far_this_robot_strays(tmp_path):
    model = new_model("delta54").with_effect("backlash")
    usual = model.table[NAME]
    read = read_model(with_key(tmp_path / "belt.yaml", "tolerance: 0.02", model))
    assert read.table[NAME].tolerance == 0.02
    assert read.table[NAME].high == pytest.approx(usual.high * 0.02 / usual.tolerance)
    assert read.table["backlash.joint2.width"] == model.table["backlash.joint2.width"]
    write_model(read, tmp_path / "again.yaml")
    assert read_model(tmp_path / "again.yaml").tolerances == {NAME: 0.02}
    found = fit(read.without_effect("backlash").with_effect("backlash"), measured(3), hold_out=0)
    assert found.model.table[NAME].tolerance == 0.02


def test_readings_before_a_gear_may_err_by_its_ratio_more(tmp_path):
    model = new_model("delta54").with_effect("backlash").with_effect("encoder_gain")
    text = dump_model(model).replace(
        "  joint2: {unit: rad,", "  joint2: {unit: rad, gearing: 30.0,"
    )
    (tmp_path / "geared.yaml").write_text(text)
    read = read_model(tmp_path / "geared.yaml")
    plain, geared = (m.table["backlash.joint2.width"] for m in (model, read))
    assert geared.tolerance == pytest.approx(30 * plain.tolerance)
    assert geared.high == pytest.approx(30 * plain.high)
    for name in ("backlash.joint1.width", "encoder_gain.joint2.gain"):  # a share is a share
        assert read.table[name] == model.table[name]
    assert read.without_effect("backlash").with_effect("backlash").table[geared.name] == geared
    assert "gearing: 30.0" in dump_model(read)
    (tmp_path / "bad.yaml").write_text(text.replace("gearing: 30.0", "gearing: 0.0"))
    with pytest.raises(ModelFileError, match=r"joints\.joint2\.gearing"):
        read_model(tmp_path / "bad.yaml")


def test_a_model_file_may_state_tolerances_of_effects_that_it_does_not_have_yet(tmp_path):
    """Belts that go 12 mm too far on a metre, before a model that knows of belts."""
    text = dump_model(new_model("delta54"))
    belts = "tolerances:\n  encoder_gain.*.gain: 4.0e-3\n"
    (tmp_path / "belts.yaml").write_text(text.replace("history:", f"{belts}history:"))
    model = read_model(tmp_path / "belts.yaml")
    usual = new_model("delta54").with_effect("encoder_gain").table["encoder_gain.joint2.gain"]
    gain = model.with_effect("encoder_gain").table["encoder_gain.joint2.gain"]
    assert (gain.tolerance, gain.high) == pytest.approx((4e-3, usual.high * 4e-3 / usual.tolerance))
    assert '  "encoder_gain.*.gain": 0.004\n' in dump_model(model)
    driven = measured(2, effects=[ve.WrongPitch((0.012, -0.01, 0.011))])
    plain = add(new_model("delta54"), "encoder_gain", driven)
    assert any("larger than usual (0.01" in words for words in plain.warnings)
    step = add(model, "encoder_gain", driven)
    assert not any("larger than usual" in words for words in step.warnings)
    write_model(step.model, tmp_path / "added.yaml")
    again = read_model(tmp_path / "added.yaml")
    assert again.value("encoder_gain.joint1.gain") == pytest.approx(0.012, rel=0.1)


def test_a_tolerance_for_an_unknown_parameter_is_refused_with_its_line(tmp_path):
    text = dump_model(new_model("delta54"))
    for key, words in (
        ("encoder_gian.*", r"robot.yaml:\d+: tolerances.encoder_gian.*: .*encoder_gain"),
        ("encoder_gain.*.gian", r"robot.yaml:\d+: .*no parameter matches"),
    ):
        wrong = text.replace("history:", f"tolerances: {{{key}: 1.0e-3}}\nhistory:")
        (tmp_path / "robot.yaml").write_text(wrong)
        with pytest.raises(ModelFileError, match=words):
            read_model(tmp_path / "robot.yaml")


@pytest.mark.parametrize(
    ("key", "words"),
    [
        ("tolerance: 0", r"belt.yaml:\d+: effects.0.parameters.joint1.width.tolerance: expected a"),
        ("tolerance: wide", r"belt.yaml:\d+: .*joint1.width.tolerance: expected a number"),
        ("tolerances: 1", r"belt.yaml:\d+: .*unknown key; did you mean 'tolerance'"),
    ],
)
def test_a_wrong_tolerance_is_refused_with_its_line(tmp_path, key, words):
    model = new_model("delta54").with_effect("backlash")
    with pytest.raises(ModelFileError, match=words):
        read_model(with_key(tmp_path / "belt.yaml", key, model))


def test_an_unusual_size_is_accepted_with_a_warning_and_its_file_can_be_read(tmp_path):
    data = measured(7, effects=[BELT])
    model = new_model("delta54").with_effect("backlash")
    step = fitted(model, data, True, hold_out=0)
    assert sorted(step.result.unusual) == [f"backlash.joint{i}.width" for i in (1, 2, 3)]
    assert re.match(
        r"backlash.joint1.width is larger than usual \((30|29.\d) mrad; usual up to 3\): a fault, "
        "or another effect",
        step.result.unusual[NAME].description,
    )
    [words] = [w for w in step.warnings if "larger than usual" in w]
    assert words.endswith("a fault, or another effect (2 more of its parameters are, too)")
    write_model(step.model, tmp_path / "belt.yaml")
    again = read_model(tmp_path / "belt.yaml")
    assert again.value(NAME) == pytest.approx(3e-2, rel=0.02)
    assert not fit(again, data, hold_out=0).unusual  # its own file allows it


def test_insist_does_not_accept_a_negative_backlash():
    data = measured(7, effects=[vr.Backlash((-3e-2,) * 3)])
    with pytest.raises(FitError, match=r"^backlash.joint1.width would have to be -0.0"):
        fit(new_model("delta54").with_effect("backlash"), data, hold_out=0, insist=True)


@pytest.mark.wide
def test_a_fitted_model_can_be_read_again_though_the_data_cannot_separate_two_plays():
    """A robot whose play is below zero, which none is: between reversals that are all far apart a
    lag and a backlash look alike, and each takes a part of it that its file would not excuse."""
    crank = replace(new_model("slider_crank"), noise=Noise(1e-6, 1e-6, 1e-6))
    rng = np.random.default_rng(1)
    turns = rng.uniform(0.3, 1.0, 40) * rng.choice([-1, 1], 40)
    robot = crank.with_effect("backlash", {"crank.width": -0.6e-3})
    data = simulate(robot, 40, seed=1, targets=np.cumsum(turns)[:, None]).dataset()
    width = {"crank.width": crank.with_effect("hysteresis").table["hysteresis.crank.width"].low}
    both = crank.with_effect("hysteresis", width).with_effect("backlash")
    with pytest.raises(FitError, match=r"^hysteresis.crank.lag would have to be -0.00023\d* rad"):
        fit(both, data, hold_out=0)
    less = crank.with_effect("backlash", {"crank.width": 0.6e-3})
    data = simulate(less, 40, seed=1, targets=np.cumsum(turns)[:, None]).dataset()
    found = fit(both, data, hold_out=0)
    assert np.isinf(found.estimate.sigma[both.table.index_of("hysteresis.crank.lag")])
    again = parse_model(dump_model(found.model))
    assert again.value("hysteresis.crank.lag") == found.model.value("hysteresis.crank.lag") > 0


def test_a_hysteresis_larger_than_its_width_is_refused_unless_insist_is_set():
    """A lag of 2.5 mrad that builds up in 1.1 mrad: the drive goes on, the joint comes back."""
    day = vf.session(3)
    data = dataset(vf.samples(day, [vr.Backlash((5e-3,) * 3)], vr.THESIS_NOISE, 3), vr.THESIS_NOISE)
    steep = {f"joint{i}.width": 1.1e-3 for i in (1, 2, 3)}
    model = new_model("delta54").with_effect("hysteresis", steep)
    with pytest.raises(FitError, match=r"joint1.lag would have to be .* its drive continues"):
        fit(model, data, hold_out=0)
    warnings = fit(model, data, hold_out=0, insist=True).warnings
    assert [w for w in warnings if "continues: accepted because of --force" in w]
    gentle = new_model("delta54").with_effect("hysteresis")
    assert not fit(gentle, data, hold_out=0).model.find_contradiction()


def test_insist_does_not_accept_a_geometry_outside_its_plausible_range():
    data = measured(0)
    with pytest.raises(FitError, match=r"chain1.La_x was identified as"):
        fit(new_model("delta54"), replace(data, r=1.1 * data.r), hold_out=0, insist=True)


def test_a_winch_behind_a_gear_strays_by_what_its_line_does():
    """50 um of line at the platform: R / (gear advantage) of it a radian of the motor."""
    cable = new_model("cable")
    for name in ("zero_shift", "backlash"):
        model = cable.with_effect(name)
        numbers = [p for p in model.table if p.name.startswith(name) and "motor1" in p.name]
        in_metres = {"zero_shift": (50e-6, 0.5e-3), "backlash": (20e-6, 0.2e-3)}[name]
        R, gear, advantage = (cable.value(n) for n in ("spool1.R", "line1.gear", "line1.advantage"))
        expected = [s * gear * advantage / R for s in in_metres]
        assert [numbers[0].tolerance, numbers[0].high] == pytest.approx(expected)
    # A radian of a motor lets out as much as the closure says.
    x = np.concatenate([np.zeros(4), [0.1, 0.05, 0.3], np.eye(3).ravel()])
    step = x + 1e-4 * np.eye(len(x))[0]
    before, after = (np.array(cable.structure.closure(q, [], cable.values)[0]) for q in (x, step))
    assert abs(after - before)[0, 0] == pytest.approx(1e-4 * cable.mechanism.winds[0], rel=1e-6)
    play = new_model("delta24").with_effect("backlash").table["backlash.joint1.width"]
    assert play.tolerance == 0.3e-3  # an arm's joint strays as arms do
