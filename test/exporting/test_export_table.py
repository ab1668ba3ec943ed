"""The exported look-up table, read and interpolated by somebody else."""

import json

import numpy as np
import pytest
import virtual_day as vd
from scipy.interpolate import RegularGridInterpolator
from test_export_firmware import off

from parallel_cal.base.errors import ModelError
from parallel_cal.exporting.export import export
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import new_model
from parallel_cal.virtual import robot as vr

MOCK_UP = new_model("delta54", vr.TABLE_5_18)


def read(folder):
    """(axes, values, what is said of it) as a controller's programmer would read the files."""
    about = json.loads((folder / "table.json").read_text())
    axes = [np.array(axis) for axis in about["axes"].values()]
    rows = np.loadtxt(folder / "table.csv", delimiter=",", skiprows=1)
    shape = [len(axis) for axis in axes]
    assert (rows[:, 0].reshape(shape)[:, 0, 0] == axes[0]).all()
    return axes, rows[:, len(axes) :].reshape(*shape, -1), about


@pytest.mark.wide
def test_the_stated_error_is_what_an_independent_robot_shows(tmp_path):
    """Trilinear interpolation by scipy, the robot by rods and points."""
    paths = export(MOCK_UP, "table:size=7", tmp_path).paths
    assert {path.name for path in paths} == {"table.csv", "table.json"}
    axes, values, about = read(tmp_path)
    assert about["bytes_as_float32"] == 4 * 3 * 7**3
    nominal = Kinematics(MOCK_UP.with_values(MOCK_UP.table.vector(about["nominal"])))
    asked = vd.targets(2000, seed=11)
    inside = np.all(
        [(a[0] <= c) & (c <= a[-1]) for a, c in zip(axes, asked.T, strict=True)], axis=0
    )
    asked = asked[inside]
    assert len(asked) > 500
    joints = nominal.inverse(asked).joints + RegularGridInterpolator(axes, values)(asked)
    left = np.linalg.norm(vr.MOCK_UP.forward(joints)[0] - asked, axis=1)
    assert left.mean() == pytest.approx(about["error"]["position_mean"], rel=0.15)
    assert left.max() == pytest.approx(about["error"]["position_max"], rel=0.35)
    before = np.linalg.norm(vr.MOCK_UP.forward(nominal.inverse(asked).joints)[0] - asked, axis=1)
    assert before.mean() == pytest.approx(about["error"]["without"]["position_mean"], rel=0.15)
    assert left.mean() < before.mean() / 20


@pytest.mark.wide
def test_the_direct_table_gives_the_pose(tmp_path):
    export(MOCK_UP, "table:problem=direct,size=7", tmp_path)
    axes, values, about = read(tmp_path)
    assert list(about["axes"]) == ["joint1", "joint2", "joint3"]
    nominal = Kinematics(MOCK_UP.with_values(MOCK_UP.table.vector(about["nominal"])))
    q, _ = vr.MOCK_UP.inverse(vd.targets(500, seed=12))
    change = RegularGridInterpolator(axes, values, bounds_error=False)(q)
    found = nominal.direct(q).position + change[:, :3]
    left = np.linalg.norm(vr.MOCK_UP.forward(q)[0] - found, axis=1)
    assert np.nanmean(left) == pytest.approx(about["error"]["position_mean"], rel=0.2)


@pytest.mark.wide
def test_the_error_at_half_the_size_says_whether_a_larger_table_helps(tmp_path):
    """A quarter where corrections are smooth; little where a ripple is finer than the grid."""
    ripple = {f"gear_transmission_error.joint{i}.sin1": 0.3e-3 for i in (1, 2, 3)}
    ripple["gear_transmission_error.ratio"] = 50.0
    gear = new_model("delta54", vr.TABLE_5_18 | ripple, ["gear_transmission_error"])
    found = {}
    for name, model in (("smooth", MOCK_UP), ("ripple", gear)):
        export(model, "table:size=9", tmp_path)
        found[name] = read(tmp_path)[2]["error"]
    export(MOCK_UP, "table:size=5", tmp_path)
    half = found["smooth"]["half_size"]
    assert half.pop("size") == 5
    smaller = read(tmp_path)[2]["error"]
    assert half == {key: smaller[key] for key in half}
    assert found["smooth"]["position_mean"] < 0.3 * half["position_mean"]
    assert found["ripple"]["position_mean"] > 0.9 * found["ripple"]["half_size"]["position_mean"]


def test_the_largest_error_of_an_orientation_is_at_a_commanded_orientation(tmp_path):
    """Argos only turns: its position is the same everywhere."""
    export(off("argos27"), "table:size=3", tmp_path)
    error = read(tmp_path)[2]["error"]
    worst = np.array(error["orientation_worst_at"])
    grid = np.array(list(read(tmp_path)[2]["axes"].values()))
    low, high = grid[:, 0], grid[:, -1]
    assert "position_worst_at" not in error
    assert ((low <= worst) & (worst <= high)).all()


def test_an_unknown_problem_is_reported(tmp_path):
    with pytest.raises(ModelError, match="problem=both: expected one of inverse, direct"):
        export(MOCK_UP, "table:problem=both", tmp_path)
