"""Effects of the catalogue as blocks of the sum."""

from dataclasses import replace

import numpy as np
import pytest

import parallel_cal as pc
from bench.truth import new_effects
from parallel_cal.causes.effects import list_effect_blocks, scan_settings
from parallel_cal.diagnosis.addition import see
from parallel_cal.diagnosis.causes import Causes
from parallel_cal.model.file.modelfile import dump_model, parse_model
from parallel_cal.model.model import Noise, new_model
from parallel_cal.model.shelf import load_effect
from parallel_cal.posterior.evidence import Choice

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
    apart, alike = (root @ root.T for root in block.usual)
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
