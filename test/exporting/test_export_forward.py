"""Each firmware finds its point again from its motors with the numbers that an export writes.

A controller solves the forward problem after homing and after each stop. Its formulas for that are
others than those for its motors: they may take another of two solutions, or another length. So each
export is tested by both, written in virtual_firmware from the firmware's published formulas and
with its own type of numbers, and by the pose at which the firmware believes the robot when homed.
"""

from pathlib import Path

import numpy as np
import pytest
import virtual_firmware as vf
from test_export_firmware import MM, ROTARY, TOWERS_APART, off, simulated, told_frame
from test_export_marlin import HEADER

from bench.truth import firmwares
from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.exporting.export import export
from parallel_cal.importing.controller_files import configured
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import new_model
from parallel_cal.virtual import robot as vr

N_POSES = 2000
MAX_DOUBLE_ERROR = 1e-8  # mm, of formulas in double precision
MAX_FLOAT_ERROR = 5e-4  # mm, of formulas in single precision over a workspace of 0.3 m
MAX_HOMED_ERROR = 1.0  # mm, outside the workspace, where the firmware has fewer numbers
EXACT_HOMED_ERROR = 2e-3  # mm, of a robot whose numbers the firmware has: the digits of an angle
LINEAR = ("rrf", "klipper", "linuxcnc", "marlin", "marlin_equal_rods", *TOWERS_APART)
RETRACTING = ("marlin", "marlin_equal_rods", "mk4duo", "richcattell")
NOMINAL = ("delta_nominal", "linear_delta", "delta24")


def robot(name):
    """A nominal robot, one off its nominal, or the thesis' Delta with its identified numbers."""
    if name == "identified":
        return new_model("delta54", vr.TABLE_5_18)
    return off(name.split()[0], 0.1) if " " in name else new_model(name)


def targets(name):
    return LINEAR if name.startswith("linear") else ROTARY


IN_EVERY_RUN = (("delta_nominal", "klipper"), ("identified", "rrf"))


def mark(name, target, kept):
    if (name, target) in IN_EVERY_RUN:
        return ()
    return pytest.mark.wide if name in kept else pytest.mark.slow


def deltas(*kept):
    """Each robot with each target; in `make check`, the kept robots."""
    return [
        pytest.param(name, target, marks=mark(name, target, kept))
        for name in (*NOMINAL, "identified", "delta24 off", "linear_delta off")
        for target in targets(name)
    ]


def exported(model, target, folder):
    """The firmware with the written numbers, and the workspace's points (N, 3) mm in its frame."""
    done = export(model, target, folder)
    origin, axes, _ = told_frame(done.remarks)
    r, R = poses_in_workspace(model.mechanism, N_POSES, np.random.default_rng(1))
    return simulated(target, folder), (r - origin) @ axes / MM, R


@pytest.mark.parametrize(("name", "target"), deltas("identified", "linear_delta off"))
def test_a_firmware_finds_its_point_again_from_its_motors(name, target, tmp_path):
    firmware, points, _ = exported(robot(name), target, tmp_path)
    found = firmware.forward(firmware.motors(points))
    np.testing.assert_allclose(found, points, atol=MAX_DOUBLE_ERROR)
    computed = firmware.forward(firmware.computed_motors(points), firmware.number)
    if firmware.number is np.float32:
        assert computed.dtype == np.float32
        np.testing.assert_allclose(computed, points, atol=MAX_FLOAT_ERROR)


# Of robots as drawn, whose end-stops the firmware has exactly.
@pytest.mark.parametrize(("name", "target"), deltas("delta24", "linear_delta"))
def test_a_firmware_homes_where_the_model_is(name, target, tmp_path):
    model = robot(name)
    done = export(model, target, tmp_path)
    origin, axes, order = told_frame(done.remarks)
    ends = np.array(model.mechanism.joint_limits)
    stops = ends[:, 0] if axes[2, 2] < 0 else ends[:, 1]
    if target.startswith("marlin") or target in (
        "mk4duo",
        "richcattell",
    ):  # which leaves its end-stops when it has found them
        down = np.empty(3)
        down[order] = simulated(target, tmp_path).retracts() * MM
        stops = stops - down
    expected = (Kinematics(model).direct(stops[None]).position[0] - origin) @ axes / MM
    tolerance = EXACT_HOMED_ERROR if name in NOMINAL else MAX_HOMED_ERROR
    firmware = simulated(target, tmp_path)
    np.testing.assert_allclose(firmware.home_position(firmware.number), expected, atol=tolerance)


@pytest.mark.wide
def test_linuxcnc_finds_a_hexapods_pose_again_from_its_struts(tmp_path):
    firmware, points, R = exported(off("stewart42"), "linuxcnc", tmp_path)
    rng = np.random.default_rng(4)
    near = points + rng.uniform(-5, 5, points.shape)
    turned = rotation_matrix(rng.uniform(-0.03, 0.03, points.shape)) @ R
    r, found = firmware.forward_pose(firmware.motors(points, R), near, turned)
    np.testing.assert_allclose(r, points, atol=MAX_DOUBLE_ERROR)
    np.testing.assert_allclose(found, R, atol=1e-11)


@pytest.mark.wide
def test_linuxcnc_homes_a_hexapod_where_the_model_is(tmp_path):
    model = off("stewart42")
    export(model, "linuxcnc", tmp_path)
    firmware = simulated("linuxcnc", tmp_path)
    stops = np.array(model.mechanism.joint_limits)[:, 1]
    expected = Kinematics(model).direct(stops[None])
    r, R = firmware.forward_pose(
        firmware.homed()[None], expected.position / MM + 3.0, expected.rotation
    )
    np.testing.assert_allclose(r, expected.position / MM, atol=1e-3)
    np.testing.assert_allclose(R, expected.rotation, atol=1e-5)


@pytest.mark.wide
def test_a_five_bar_finds_its_tool_again_from_its_cranks(tmp_path):
    model = off("five_bar", 1.0)
    firmware, points, _ = exported(model, "rrf", tmp_path)
    np.testing.assert_allclose(firmware.forward(firmware.motors(points)), points, atol=1e-8)


@pytest.mark.wide
def test_a_hangprinter_finds_its_end_point_again_from_its_motors(tmp_path):
    export(off("cable", 0.1), "rrf", tmp_path)
    firmware = vf.Duet((tmp_path / "config.g").read_text())
    r, _ = poses_in_workspace(new_model("cable").mechanism, 200, np.random.default_rng(1))
    np.testing.assert_allclose(firmware.forward(firmware.motors(r / MM)), r / MM, atol=1e-4)
    np.testing.assert_allclose(firmware.home_position(), 0, atol=1e-9)


@pytest.mark.wide
def test_the_page_on_export_has_the_table_of_its_benchmark():
    """One row of it, computed again; the others are the same code with another robot."""
    name, target = "linear Delta", "marlin"
    row = firmwares.measure(firmwares.robots()[name][0], target)
    page = firmwares.PAGE.read_text(encoding="utf-8")
    lines = page.split(firmwares.BEGIN)[1].split(firmwares.END)[0].strip().splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]
    wanted = [(n, f"`{t}`") for n, (_, targets) in firmwares.robots().items() for t in targets]
    assert [tuple(line[:2]) for line in cells] == wanted
    (shown,) = [line for line in cells if line[:2] == [name, f"`{target}`"]]
    assert [float(word) for word in shown[2].split(" / ")] == pytest.approx(row.stated, rel=1e-2)
    assert [float(word) for word in shown[3].split(" / ")] == pytest.approx(row.reached, rel=1e-2)
    assert row.reached == pytest.approx(row.stated, rel=1e-2)


@pytest.mark.wide
def test_configuration_files_come_back_with_nothing_lost(tmp_path):
    file = tmp_path / "Configuration.h"
    file.write_text(HEADER)
    assert firmwares.configurations(tmp_path) == [[file]]
    lost, lines = firmwares.send_round([file])
    assert lost < 5e-4
    assert lines == 0


# ------------------------------------------------------------------ RepRapFirmware's arm A


def different_arms(text):
    """The configuration with arms as the fit of three lengths would have written them."""
    arm = vf.words(text)["M669 U"][0]
    old = next(word for word in text.split() if word.startswith("U"))
    return text.replace(old, f"U{arm:.4f}:{arm + 0.2:.4f}:{arm - 0.15:.4f}")


def test_reprapfirmware_gets_one_arm_length_because_it_computes_with_that_of_arm_a(tmp_path):
    done = export(robot("identified"), "rrf", tmp_path)
    text = (tmp_path / "config.g").read_text()
    assert np.ptp(vf.words(text)["M669 U"]) == 0
    assert done.remarks[0].startswith("the arms differ, but M669 U has one length for all")
    assert done.loss["position_max"] < 60e-6
    points = np.random.default_rng(3).uniform([-50, -50, 20], [50, 50, 90], (200, 3))
    wrong = vf.Duet(different_arms(text))
    away = np.linalg.norm(wrong.forward(wrong.motors(points)) - points, axis=1)
    assert away.min() > 0.03


def test_a_robot_with_equal_arms_needs_no_remark(tmp_path):
    done = export(new_model("delta_nominal"), "rrf", tmp_path)
    assert not [remark for remark in done.remarks if "arms" in remark]


@pytest.mark.wide
def test_a_configuration_with_different_arms_is_read_with_a_remark(tmp_path):
    export(robot("identified"), "rrf", tmp_path)
    file: Path = tmp_path / "config.g"
    assert not [remark for remark in configured([file]).remarks if "M669 U" in remark]
    file.write_text(different_arms(file.read_text()))
    remarks = configured([file]).remarks
    assert [remark for remark in remarks if remark.startswith("M669 U has different arms")]
