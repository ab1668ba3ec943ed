"""Klipper's deltesian printers become a model, which is written back; or one clear line."""

import numpy as np
import pytest

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.exporting.export import export, export_into
from parallel_cal.importing.controller_files import configured
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import new_model

MM = 1e-3
PRINTER = """\
[printer]
kinematics: deltesian
max_velocity: 500

[stepper_left]
rotation_distance: 40
position_endstop: 268   # measured
arm_length: 217
arm_x_length: 160

[stepper_right]
position_endstop = 267.5

[stepper_y]
position_endstop: 0
position_max: 200
"""
# left and right (mm): half width, rod, height at the end-stop
NUMBERS = np.array([[160, 217, 268], [160, 217, 267.5]])


def written(folder, text):
    (folder / "printer.cfg").write_text(text)
    return folder / "printer.cfg"


def carriages(numbers, r):
    """Heights (N, 2) mm of the carriages above z = 0: each rod is a hypotenuse."""
    across = np.column_stack([r[:, 0] + numbers[0, 0], numbers[1, 0] - r[:, 0]])
    return r[:, 2:] + np.sqrt(numbers[:, 1] ** 2 - across**2)


def nozzle(numbers, heights):
    """Where (N, 2) x and z mm the rods of two carriages (N, 2) meet, below the line between them:
    the height of a triangle with three known sides (Heron)."""
    across, up = numbers[:, 0].sum(), heights[:, 1] - heights[:, 0]
    side, (a, b) = np.hypot(across, up), numbers[:, 1]
    half = (side + a + b) / 2
    tall = 2 * np.sqrt(half * (half - side) * (half - a) * (half - b)) / side
    along = np.sqrt(a**2 - tall**2)
    x = (along * across + tall * up) / side - numbers[0, 0]
    return np.column_stack([x, heights[:, 0] + (along * up - tall * across) / side])


def test_a_deltesian_moves_as_klipper_computes(tmp_path):
    model = configured([written(tmp_path, PRINTER)]).model
    r, _ = poses_in_workspace(model.mechanism, 200, np.random.default_rng(0))
    heights = carriages(NUMBERS, r / MM)
    q = np.column_stack([heights, r[:, 1] / MM]) * MM
    np.testing.assert_allclose(Kinematics(model).inverse(r).joints, q, atol=1e-9)
    np.testing.assert_allclose(nozzle(NUMBERS, heights) * MM, r[:, [0, 2]], atol=1e-9)
    np.testing.assert_allclose(Kinematics(model).direct(q).position, r, atol=1e-9)
    # 217^2 = 160^2 + 146.59^2: the end-stops are this far above 268 and 267.5 mm
    up = np.sqrt(217**2 - 160**2)
    np.testing.assert_allclose(
        model.mechanism.switches, np.array([268 + up, 267.5 + up, 0]) * MM, atol=1e-12
    )
    assert model.machine_class == "hobby"


def test_a_users_file_gets_the_numbers_and_keeps_the_rest(tmp_path):
    path = written(tmp_path, PRINTER)
    model = configured([path]).model
    assert export_into(model, "klipper", [path]).before["position_max"] < 1e-8
    unchanged = path.read_text().splitlines()
    assert [line for line in PRINTER.splitlines() if line not in unchanged] == []
    values = model.values.copy()
    for name, by in (("left.x", -0.4), ("left.rod", 0.3), ("right.rod", -0.2), ("right.z", 0.5)):
        values[model.table.index_of(name)] += by * MM
    done = export_into(model.with_values(values), "klipper", [path])
    assert done.loss["position_max"] < 1e-8
    assert done.before["position_max"] > 0.1 * MM
    stated = dict(
        line.replace(" = ", ": ").split(": ")
        for line in path.read_text().split("[stepper_right]")[1].splitlines()
        if ":" in line or "=" in line
    )
    assert float(stated["arm_length"]) == pytest.approx(216.8, abs=1e-5)
    assert float(stated["arm_x_length"]) == pytest.approx(160, abs=1e-5)
    text = path.read_text()
    assert "arm_length: 217.300000\n" in text
    assert "# measured" in text
    assert "position_max: 200\n" in text
    assert "position_min" not in text
    again = configured([path]).model
    assert export_into(again, "klipper", [path]).before["position_max"] < 1e-8


def bed_moved(model, by):
    values = model.values.copy()
    values[model.table.index_of("bed.q0")] += by * MM
    return model.with_values(values)


@pytest.mark.parametrize("by", [-0.0784, 0.2])
def test_the_range_of_the_bed_moves_with_its_end_stop(by, tmp_path):
    """Klipper refuses an end-stop outside of position_min (0 where it is not stated) to max."""
    path = written(tmp_path, PRINTER)
    export_into(bed_moved(configured([path]).model, by), "klipper", [path])
    assert PRINTER.split("[stepper_y]")[0] == path.read_text().split("[stepper_y]")[0]
    lines = sorted(path.read_text().split("[stepper_y]\n")[1].splitlines())
    ends = (("endstop", by), ("max", 200 + by), ("min", by))
    assert lines == [f"position_{key}: {at:.6f}" for key, at in ends]


def test_a_print_width_that_klipper_refuses_with_the_new_arms_gets_smaller(tmp_path):
    """With cos 5 deg * 217 - 160 = 56.2 mm to each side, 112 mm; shorter arms leave 55 mm."""
    path = written(tmp_path, PRINTER.replace("max_velocity: 500", "print_width: 112 # mine"))
    model = configured([path]).model
    values = model.values.copy()
    for side in ("left", "right"):
        values[model.table.index_of(f"{side}.rod")] -= 0.5 * MM
    done = export_into(model.with_values(values), "klipper", [path])
    assert "print_width: 110 # mine" in path.read_text()
    assert any("print_width becomes 110 in place of 112" in remark for remark in done.remarks)


def test_an_unchanged_model_changes_nothing_and_new_lines_look_like_the_others(tmp_path):
    path = written(tmp_path, PRINTER.replace("endstop = 267.5", "endstop: 267.5"))
    text, model = path.read_text(), configured([path]).model
    export_into(model, "klipper", [path])
    assert path.read_text() == text
    values = model.values.copy()
    values[model.table.index_of("right.rod")] += 0.1 * MM
    export_into(model.with_values(values), "klipper", [path])
    assert "\narm_length: 217.100000\n" in path.read_text()
    assert "right]\nrotation" not in path.read_text()


def test_motors_without_a_length_of_a_step_are_named(tmp_path):
    remarks = configured([written(tmp_path, PRINTER)]).remarks
    missing = "[stepper_right] rotation_distance, [stepper_y] rotation_distance"
    assert f"Klipper does not start without {missing}; the model does not need it" in remarks


def test_what_was_exported_is_read_again(tmp_path):
    done = export(new_model("deltesian"), "klipper", tmp_path)
    assert done.loss["position_max"] < 1e-8
    model = configured(done.paths).model
    assert model.value("left.x") == pytest.approx(-0.15, abs=1e-8)
    assert model.mechanism.joint_limits[2] == pytest.approx((-0.1, 0.1))


def test_leans_that_klipper_cannot_represent_are_reported_as_loss(tmp_path):
    model = new_model("deltesian", {"bed.turn": 2e-3})
    # 2 mrad over the y range of +-0.1 m and the fit's best compromise leave up to 0.2 mm
    assert 0.1 * MM < export(model, "klipper", tmp_path).loss["position_max"] < 0.21 * MM


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("arm_length: 217", "arm_length: 150", r":8: \[stepper_left\] arm_length is '150', expec"),
        ("arm_x_length: 160", "", r"no \[stepper_left\] arm_x_length, expected mm"),
        ("position_max: 200", "position_max: -3", r"position_max is '-3', expected mm, more than"),
        ("endstop: 0", "endstop: -5", r"stepper_y\] position_endstop is '-5', .* \(0 to 200\)"),
        ("endstop = 267.5", "endstop = -1", r"right\] position_endstop is '-1', .* 0 or more"),
        ("rotation_distance: 40", "rotation_distance: 0", r"rotation_distance is '0', expected mm"),
        (
            "max_velocity: 500",
            "print_width: 2000",
            r"print_width is '2000', .* 0 to 112, Klipper's",
        ),
        (
            "deltesian",
            "deltesion",
            r"is 'deltesion', expected delta, rotary_delta, deltesian or winch",
        ),
    ],
)
def test_settings_that_cannot_be_are_named(old, new, message, tmp_path):
    with pytest.raises(ParallelCalError, match=message):
        configured([written(tmp_path, PRINTER.replace(old, new))])
