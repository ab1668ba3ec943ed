"""Settings of grblHAL become a model, which is written back into them; or one clear line."""

import re

import numpy as np
import pytest
import virtual_firmware as vf

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.exporting.export import export, export_into
from parallel_cal.importing.controller_files import configured
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import new_model

MM = 1e-3
# The Delta's settings as grblHAL is delivered (kinematics/delta.c), among others.
DELIVERED = """\
$0=5.0
$640=0.20
$641=300.000
$642=100.000
$643=75.000 (Base radius)
$644=24.000
$645=400.000
$646=0.000
"""


def written(tmp_path, text, name="settings.txt"):
    path = tmp_path / name
    path.write_text(text)
    return path


def assert_moves_as_computed(model, settings):
    """Compare a model's joints with the firmware's motors, which count down from the horizontal."""
    r, _ = poses_in_workspace(model.mechanism, 200, np.random.default_rng(0))
    motors = np.radians(vf.GrblHal(settings).motors(r / MM))
    reached = np.isfinite(motors).all(axis=1)
    assert reached.mean() > 0.8
    found = Kinematics(model).inverse(r[reached]).joints
    np.testing.assert_allclose(found, -motors[reached], atol=1e-9)


@pytest.mark.parametrize("name", ["settings.txt", "backup.settings"])
def test_the_robot_moves_as_the_firmware_computes(name, tmp_path):
    assert_moves_as_computed(configured([written(tmp_path, DELIVERED, name)]).model, DELIVERED)


def test_an_arm_at_its_switch_is_where_a_right_triangle_puts_it(tmp_path):
    """An axis is 51 tan(30) / 2 = 14.72 mm from the centre, the elbow of a level arm 114.72 mm:
    the rod reaches down by sqrt(300^2 - 114.72^2) = 277.20 mm."""
    model = configured([written(tmp_path, DELIVERED)]).model
    ends = np.array(model.mechanism.joint_limits)[:, 1]
    np.testing.assert_allclose(
        Kinematics(model).direct(ends).position / MM, [0, 0, -277.2], atol=5e-3
    )


def test_end_stops_that_differ_are_named_with_the_way_to_the_mean(tmp_path):
    """Arms at their switches are 0.3 degrees higher, 0.1 lower and 0.1 higher than stated."""
    path = written(tmp_path, DELIVERED)
    model = configured([path]).model
    values, off = model.values.copy(), np.radians([0.3, -0.1, 0.1])
    for i, by in enumerate(off, start=1):
        arm = model.value(f"chain{i}.La_x")
        values[model.table.index_of(f"chain{i}.La_x")] = arm * np.cos(by)
        values[model.table.index_of(f"chain{i}.La_y")] = arm * np.sin(by)
    done = export_into(model.with_values(values), "grblhal", [path])
    assert done.loss["position_max"] > 0.2 * MM
    words = next(remark for remark in done.remarks if "one position for all end-stops" in remark)
    found = dict(re.findall(r"(joint\d) ([+-]\S+?)(?:,| degrees)", words))
    assert {name: float(by) for name, by in found.items()} == pytest.approx(
        {"joint1": -0.2, "joint2": 0.2, "joint3": 0.0}, abs=0.011
    )


def test_settings_come_back_with_nothing_lost_and_no_other_line_changed(tmp_path):
    path = written(tmp_path, DELIVERED)
    model = configured([path]).model
    assert export_into(model, "grblhal", [path]).loss["position_max"] < 1e-12
    assert path.read_text() == DELIVERED
    values = model.values.copy()
    for i in (1, 2, 3):
        values[model.table.index_of(f"chain{i}.Lb")] += 1.0 * MM
    model = model.with_values(values)
    assert export_into(model, "grblhal", [path]).loss["position_max"] < 1e-9
    kept = [line for line in DELIVERED.splitlines() if line[:4] not in ("$641", "$643", "$644")]
    changed = path.read_text().splitlines()
    assert [line for line in changed if line in kept] == kept
    assert [line for line in changed if line not in kept] == [
        "$641=301.000",
        "$643=51.000 (Base radius)",
        "$644=0.000",
    ]
    again = configured([path]).model
    np.testing.assert_allclose(again.values, model.values, atol=1e-12)


def test_what_was_exported_is_read_again(tmp_path):
    (path,) = export(new_model("delta_nominal"), "grblhal", tmp_path).paths
    assert_moves_as_computed(configured([path]).model, path.read_text())


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("$641=300", "$641=90", r"\$641 is '90.000', expected a length in mm that reaches"),
        ("$642=100.000\n", "", r"no \$642, expected a length in mm"),
        ("$646=0", "$646=120", r":8: \$646 is '120.000', expected the homing angle in degrees"),
        ("$", "M665 L", "expected the delta radius"),  # a log of Marlin has the same ending
    ],
)
def test_settings_that_cannot_be_are_named(old, new, message, tmp_path):
    with pytest.raises(ParallelCalError, match=message):
        configured([written(tmp_path, DELIVERED.replace(old, new))])
