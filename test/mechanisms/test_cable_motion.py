"""A plotter on four lines that never stops, with two clocks and late motors: from its two tables to
a better model, by the commands that the documentation names."""

import numpy as np
import pytest
import virtual_cable_motion as vm

from parallel_cal.base.rotation import quaternion_to_matrix
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.identification.fit import fit
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism
from parallel_cal.recordings.csv_import import import_csv
from parallel_cal.recordings.options import ReadOptions
from parallel_cal.session.steps import add

OFFSET = 0.08  # s by which the tracker's clock is ahead
LAGS = np.array([6e-3, 11e-3, 8e-3, 14e-3])
MAP = """joints: {line1: {column: line1, unit: mm}, line2: {column: line2, unit: mm},
  line3: {column: line3, unit: mm}, line4: {column: line4, unit: mm}}
position: {columns: [x, y, null], unit: mm}
log: {time: t}
noise: {joint: 5.0e-5, position: 2.0e-4}
"""
STILL = np.random.default_rng(7).uniform([-0.8, -0.5], [0.8, 0.5], (60, 2))  # places to go to


@pytest.fixture(scope="module")
def moving(tmp_path_factory):
    """The plotter, the model as drawn, and the samples of 40 s at up to 0.7 m/s."""
    folder = tmp_path_factory.mktemp("motion")
    plotter = vm.Plotter.drawn(1, LAGS)
    vm.write_tables(folder, plotter, vm.Path2D(1, 1.5), vm.Clock(OFFSET), 40.0, rate=15.0)
    (folder / "map.yaml").write_text(MAP)
    tables = [folder / "joints.csv", folder / "tracker.csv"]
    data = import_csv(tables, folder / "map.yaml", ReadOptions(mode="continuous"))
    return plotter, new_model(load_mechanism("cable", anchors=[[*a] for a in vm.DRAWN])), data


def error_at_rest(plotter, model):
    """Rms distance (m) from where the plotter stands still to where the model says it stands, in
    the frame of the tracker: the lines are hung 10 mm beside where the tracker has its origin."""
    found = Kinematics(model.robot()).direct(plotter.readings_at(STILL)).position
    for tracker in model.sensors:
        found = (found - tracker.position) @ quaternion_to_matrix(tracker.quaternion)
    return float(np.sqrt(np.mean(np.sum((found[:, :2] - STILL) ** 2, axis=1))))


@pytest.mark.wide
def test_the_lag_of_each_motor_is_named_and_the_robot_is_right_at_rest(moving):
    plotter, drawn, data = moving
    assert any("the two clocks differ" in note for note in data.warnings)
    plain = fit(drawn, data).model
    found = diagnose(drawn, data)
    # A first-order lag T also makes an error of T^2 times the acceleration.
    assert {"servo_lag"} <= set(found.effects) <= {"servo_lag", "acceleration_lag"}
    assert "for 100 % of the error above the noise floor" in found.verdict.text
    step = add(plain, "servo_lag", data)
    p = step.model.table.mapping(step.model.values)
    lags = np.array([p[f"servo_lag.line{i}.lag"] for i in range(1, 5)])
    # The clocks were compared with the lines, so the lag that all motors share is in their offset.
    np.testing.assert_allclose(lags - lags.mean(), LAGS - LAGS.mean(), atol=0.2e-3)
    errors = [error_at_rest(plotter, model) for model in (drawn, plain, step.model)]
    assert errors[2] < 0.1 * min(errors[:2])
