"""Effects of the catalogue as blocks of the sum."""

from dataclasses import replace

import numpy as np
import pytest

import parallel_cal as pc
from bench.truth import new_effects
from parallel_cal.causes.effects import list_effect_blocks, scan_settings
from parallel_cal.causes.settings import weigh_settings
from parallel_cal.diagnosis.addition import see
from parallel_cal.diagnosis.causes import Causes
from parallel_cal.model.file.modelfile import dump_model, parse_model
from parallel_cal.model.model import Noise, new_model
from parallel_cal.model.shelf import load_effect
from parallel_cal.posterior.blocks import LOG_ODDS
from parallel_cal.posterior.evidence import Choice
from parallel_cal.reporting.summary import describe_missing

LEGS = [f"leg{k}" for k in range(1, 7)]
LEAD, SIZES = 5.36e-3, 3e-6 * np.array([1.0, -1.1, -1.2, 0.8, 1.0, -1.0])


def scene_with_screws(**numbers):
    """40 poses of a hexapod whose screws have these numbers of `screw_pitch_error`, one a leg."""
    noise = Noise(joint=1e-6, position=2e-6, orientation=1e-5)
    model = replace(new_model("stewart42"), noise=noise)
    parts = dict.fromkeys(("sin", "cos", "bend"), np.zeros(6)) | numbers
    lead = parts.pop("lead", 5e-3)
    each = [
        f"{LEGS[k]}.{part}={float(v)!r}" for part, own in parts.items() for k, v in enumerate(own)
    ]
    hidden = f"screw_pitch_error:lead={lead!r}," + ",".join(each)
    data = pc.simulate(model, 40, 1, effects=[hidden]).dataset()
    return see(pc.fit(model, data, hold_out=0))


def test_a_pitch_that_changes_needs_no_waves_of_the_screw():
    """With waves of 317 leads to pay for, a wrong gain was likelier than what is there."""
    scene = scene_with_screws(bend=1e-3 * np.array([-1.4, -1.4, -2.0, -1.3, -1.9, 1.2]))
    names = ["screw_pitch_error", "encoder_crosstalk", "encoder_gain"]
    found = Causes.of(scene, names).sum.search()
    [one] = [one for one in found.chosen if one.block.name == "screw_pitch_error"]
    assert found.probability["screw_pitch_error"] > 0.9
    assert one.block.settings[one.setting] == {}
    assert one.usual.shape[1] == len(LEGS)


def test_a_wave_is_weighed_at_its_peak_not_where_it_was_scanned():
    """The lead lies between two that are scanned, and nearer to a period of its rival's scan."""
    scene = scene_with_screws(lead=LEAD, sin=SIZES, cos=SIZES[::-1])
    names = ["screw_pitch_error", "encoder_interpolation"]
    posterior, _, chosen = Causes.of(scene, names).explain()
    assert [one.name for one in chosen] == ["screw_pitch_error"]
    assert posterior.probability["screw_pitch_error"] > 0.9
    lead = chosen[0].settings["lead"]
    assert lead == pytest.approx(LEAD, rel=1e-2)
    assert (
        float(f"{lead:.6g}") == lead
    )  # the digits that a person copies are those that were weighed


def measure_wave(effect, number, parts, size, poses, seed):
    """Samples of a delta whose joints have a wave of this size and, of all `parts`, this one."""
    each = [
        f"joint{k}.{part}={size * share if part == parts[0] else 0.0}"
        for k, share in ((1, 1.0), (2, -1.2), (3, 0.9))
        for part in parts
    ]
    hidden = f"{effect}:{number}," + ",".join(each)
    return pc.simulate(new_model("delta54"), poses, seed, effects=[hidden]).dataset()


def weigh_numbers(data, effect):
    """The setting that the sum names, and the likely ones with their probabilities."""
    causes = Causes.of(see(pc.fit(new_model("delta54"), data, hold_out=0)), [effect], kinds=())
    found, _, [named] = causes.explain()
    [block] = causes.blocks
    nothing = causes.sum.evidence((), found.nu)
    return (
        named.settings,
        weigh_settings(causes.scene, nothing, Choice(block, 0, 0)),
        block,
        nothing,
    )


RIPPLE = ("gear_transmission_error", ("sin1", "cos1", "sin2", "cos2"))


@pytest.mark.parametrize(("size", "seed"), [(0.2e-3, 4), (0.6e-3, 1)])
def test_a_wave_is_not_taken_for_the_second_harmonic_of_half_its_ratio(size, seed):
    """Both describe it by one wave; half the ratio was named, with a first harmonic of zero."""
    effect, parts = RIPPLE
    named, weighed, _, _ = weigh_numbers(
        measure_wave(effect, "ratio=9.26", parts, size, 80, seed), effect
    )
    assert named["ratio"] == pytest.approx(9.26, abs=0.2)
    assert weighed[0].values["ratio"] == pytest.approx(named["ratio"], abs=1e-3)
    [half] = [
        one.probability
        for one in weighed
        if one.values["ratio"] == pytest.approx(9.26 / 2, abs=0.4)
    ]
    assert 0 < half < 0.01


def test_a_named_number_is_at_its_peak_where_others_are_likely_too():
    """It stayed as it was scanned, since all that were scanned are together likelier than one."""
    effect, parts = RIPPLE
    named, weighed, _, _ = weigh_numbers(
        measure_wave(effect, "ratio=40.0", parts, 0.13e-3, 80, 3), effect
    )
    assert named["ratio"] == pytest.approx(weighed[0].values["ratio"], rel=1e-4)


def test_the_probability_of_each_order_is_its_share_of_the_posterior():
    effect, parts = "encoder_harmonic", ("sin", "cos")
    _, weighed, block, nothing = weigh_numbers(
        measure_wave(effect, "order=5", parts, 0.1e-3, 60, 0), effect
    )
    alone = np.exp(nothing.weigh(block.alone) - nothing.log_p).sum(axis=1)
    expected = {one["order"]: p / alone.sum() for one, p in zip(block.settings, alone, strict=True)}
    probabilities = [one.probability for one in weighed]
    assert probabilities == sorted(probabilities, reverse=True)
    for one in weighed:
        assert one.probability == pytest.approx(expected[one.values["order"]], abs=0.01)
    assert sum(probabilities) == pytest.approx(1.0)


def test_a_diagnosis_states_the_numbers_that_may_be_those_of_an_effect():
    effect = "encoder_harmonic"
    data = measure_wave(effect, "order=5", ("sin", "cos"), 0.12e-3, 60, 5)
    found = pc.diagnose(new_model("delta54"), data, effects=[effect])
    [cause] = found.document()["missing"]
    first, second, *_ = cause["settings"][effect]
    assert first["values"] == found.best.chosen[0].settings == {"order": 5.0}
    assert first["probability"] > second["probability"] > 0.05
    written = f"order 5 {round(100 * first['probability'])} %, or order 4 "
    assert written in describe_missing(found)


def test_the_waves_of_a_known_lead_are_one_set_of_columns():
    model = new_model("stewart42")
    scene = see(pc.fit(model, pc.simulate(model, 30, 1).dataset(), hold_out=0))
    [block] = list_effect_blocks(
        scene, ["screw_pitch_error"], {"screw_pitch_error": {"lead": 5e-3}}
    )
    assert block.settings == ({"lead": 5e-3},)
    assert [one.shape[1] for one in block.columns] == [3 * len(LEGS)]
    assert np.all(block.squares[0] > 0)


def test_each_set_of_columns_says_how_large_its_parameters_are():
    """Of a spool a gain is 50 times as large as of a screw; a pitch that changes has no waves."""
    names, usual = ["encoder_gain", "screw_pitch_error"], {}
    for block in list_effect_blocks(scene_with_screws(), names, {}):
        usual[block.name] = sorted({float(root.max()) for root in block.usual})
        for k, (setting, root) in enumerate(zip(block.settings, block.usual, strict=True)):
            if setting == {}:
                assert block.columns[k] is block.columns[0]
                expected, turned = block.columns[0].astype(float) @ root, block.at(k)
                tiny = 1e-9 * np.sum(expected**2)
                np.testing.assert_allclose(turned @ turned.T, expected @ expected.T, atol=tiny)
    assert usual == {"encoder_gain": [1.0, 50.0], "screw_pitch_error": [1.0]}


def test_equal_parts_may_be_alike():
    """Late drives: six lags of their own, or one lag and what each differs from it by a hundredth
    of the usual size."""
    robot = new_effects.ROBOTS["moving stewart"]
    data = robot.measured([], 1)
    scene = see(pc.fit(robot.model(), data, hold_out=0))
    [block] = list_effect_blocks(scene, ["servo_lag"], {})
    apart, alike, *_ = (root @ root.T for root in block.usual)
    np.testing.assert_allclose(apart, np.eye(6))
    np.testing.assert_allclose(np.diag(alike), np.ones(6))
    between = np.eye(6)[0] - np.eye(6)[1]
    assert between @ alike @ between == pytest.approx(2 * 0.01**2)
    assert block.tried == 2
    assert not any(Choice(block, setting, 1).is_scanned for setting in range(2))


def test_a_number_that_was_scanned_is_told_from_what_needs_none():
    [block] = list_effect_blocks(scene_with_screws(), ["screw_pitch_error"], {})
    scanned = [Choice(block, k, 1).is_scanned for k in range(len(block.columns))]
    assert scanned == [True] * (len(scanned) - 1) + [False]


@pytest.mark.parametrize("name", ["hysteresis", "gear_transmission_error"])
def test_a_model_with_any_setting_of_a_scan_can_be_written_and_read(name):
    """A width of 1/450 rad is a bound: with six digits it would be below it."""
    model = new_model("delta54")
    scene = see(pc.fit(model, pc.simulate(model, 30, 1).dataset(), hold_out=0))
    for setting in scan_settings(scene, load_effect(name)):
        again = parse_model(dump_model(model.with_effect(name, setting)))
        assert again.effects[0].name == name


def test_an_effect_without_a_scanned_number_is_weighed_in_one_joint_alone():
    """That it is alone is as improbable as one more cause; in all joints it costs nothing more."""
    model = replace(new_model("delta54"), noise=Noise(joint=1e-5, position=1e-5, orientation=1e-4))
    scene = see(pc.fit(model, pc.simulate(model, 40, 1).dataset(), hold_out=0))
    [block] = list_effect_blocks(scene, ["encoder_eccentricity"], {})
    together, *alone = [np.flatnonzero(root.any(axis=1)).tolist() for root in block.usual]
    assert together == [0, 1, 2, 3, 4, 5]
    assert alone == [[0, 1], [2, 3], [4, 5]]
    np.testing.assert_allclose(block.log_priors - LOG_ODDS, [0, *3 * [LOG_ODDS - np.log(3)]])
