"""Before an effect is added: how far it would move the robot, and what the data say it is worth."""

import json

import pytest
from camera_cells import Cell

from parallel_cal.identification.fit import fit
from parallel_cal.identification.platform_shift import compute_platform_shift
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.recordings.loading import load_dataset
from parallel_cal.session.steps import add
from parallel_cal.virtual.robot import Backlash

MODEL, BAG = "config/delta_mockup_nominal.yaml", "bags/delta_backlash"


@pytest.fixture(scope="module")
def fitted():
    model = read_model(MODEL)
    data = load_dataset(BAG, joints=model.joints)
    return fit(model, data, hold_out=0.25), data


def test_an_effect_that_is_there_moves_the_robot_by_what_the_data_show(fitted):
    base, data = fitted
    step = add(base.model, "backlash", data)
    assert step.platform_shift.measured == pytest.approx(step.platform_shift.shown, rel=0.25)
    assert step.document()["moves_robot"]["measured"] == step.platform_shift.measured


def test_an_effect_that_is_not_there_moves_it_by_more(fitted):
    base, data = fitted
    step = add(base.model, "thermal_expansion", data, force=True)
    assert step.platform_shift.shown == 0
    assert step.platform_shift.measured > 1e-6


@pytest.mark.wide
def test_a_common_motion_that_no_pixel_shows_is_not_counted():
    cell = Cell("delta", 1, (Backlash((5e-4, 4e-4, 6e-4)),), board_at=(0.03, -0.02, -0.08))
    data = cell.seen_by_camera(40)
    base = fit(cell.drawn.with_sensors((cell.sensor(),)), data)
    shift = add(base.model, "backlash", data, force=True).platform_shift
    # Half a milliradian moves this platform by about 50 um. The frames move by ten times as much.
    assert 30e-6 < shift.measured < 100e-6
    assert 30e-6 < shift.workspace < 100e-6


def test_nothing_moves_between_a_result_and_itself(fitted):
    base, _ = fitted
    found = compute_platform_shift(base, base)
    assert (found.measured, found.workspace, found.shown) == (0, 0, 0)


def test_the_command_says_it_before_the_model_is_used(fitted, run_cli, tmp_path):
    from parallel_cal.model.file.modelfile import write_model

    write_model(fitted[0].model, tmp_path / "fit.yaml")
    shown = run_cli("add", tmp_path / "fit.yaml", "backlash", BAG)
    assert "moves the origin of 'platform' by 18 um rms at the measured poses" in shown
    assert "um rms over the workspace (at direction 0; the samples have other values)" in shown
    json.loads(run_cli("fit", tmp_path / "fit.yaml", BAG, "--json", "--hold-out", "0"))
