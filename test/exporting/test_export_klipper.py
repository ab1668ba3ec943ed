"""Klipper finds the nozzle again from its motors with the numbers that an export writes.

The forward problem and the homed pose are those of an independent reader (virtual_firmware), which
chooses between the two points where the rods meet as Klipper does.
"""

from pathlib import Path

import numpy as np
import pytest
import virtual_firmware as vf
from test_export_firmware import MM, PRINTER, first, moved, off, told_frame
from test_import_klipper import LINEAR, ROTARY

from parallel_cal.base.errors import DatasetError
from parallel_cal.exporting.export import export, export_into
from parallel_cal.exporting.targets import klipper
from parallel_cal.importing.controller_files import configured, samples
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism

ROOT = Path(__file__).parents[2]
NOMINAL = (
    "delta_nominal",
    "linear_delta",
    "delta24",
    "delta54",
    "linear_delta at 90 degrees",
    "config/delta_mockup_nominal.yaml",
    "bags/models/delta24.yaml",
    "bags/models/delta54_fine.yaml",
)
OFF_NOMINAL = (
    "delta24 off nominal",
    "delta54 off nominal",
    "linear_delta off nominal",
    "config/delta24_mockup_identified.yaml",
    "config/delta_mockup_identified.yaml",
)
MAX_HOMED_ERROR = 0.3  # mm, where the firmware has fewer numbers than the model


def delta(name):
    if name.endswith(".yaml"):
        return read_model(ROOT / name)
    if name.endswith(" off nominal"):
        return off(name.split()[0], 0.1)
    if name == "linear_delta at 90 degrees":
        return new_model(load_mechanism("linear_delta", direction=np.pi / 2))
    return new_model(name)


def exported(model, folder):
    """The firmware that reads what was written, and its frame as the remarks say."""
    remarks = export(model, "klipper", folder).remarks
    return vf.Klipper((folder / "printer.cfg").read_text()), told_frame(remarks)


def homed_pose(model, axes):
    """Where the model has the nozzle (3,) m in {B} with its joints at the end-stops."""
    upside_down = axes[2, 2] < 0
    stops = np.array(model.mechanism.joint_limits)[:, 0 if upside_down else 1]
    return Kinematics(model).direct(stops[None]).position[0]


@pytest.mark.parametrize("name", first(*NOMINAL, *OFF_NOMINAL))
def test_klipper_finds_the_nozzle_again_from_its_motors(name, tmp_path):
    model = delta(name)
    firmware, (origin, axes, _) = exported(model, tmp_path)
    r, _ = poses_in_workspace(model.mechanism, 500, np.random.default_rng(1))
    points = (r - origin) @ axes / MM
    np.testing.assert_allclose(firmware.forward(firmware.motors(points)), points, atol=1e-8)


@pytest.mark.parametrize("name", first(*NOMINAL, *OFF_NOMINAL))
def test_klipper_homes_where_the_model_is_and_moves_down_to_the_bed(name, tmp_path):
    model = delta(name)
    firmware, (origin, axes, _) = exported(model, tmp_path)
    home = firmware.home_position()
    expected = (homed_pose(model, axes) - origin) @ axes / MM
    np.testing.assert_allclose(home, expected, atol=1e-5 if name in NOMINAL else MAX_HOMED_ERROR)
    down = np.column_stack([np.tile(home[:2], (200, 1)), np.linspace(home[2], 0, 200)])
    motors = firmware.motors(down)
    assert np.isfinite(motors).all()
    np.testing.assert_allclose(motors[0], firmware.homed(), atol=1e-6)
    np.testing.assert_allclose(firmware.forward(motors), down, atol=1e-8)


def test_steppers_in_the_other_order_are_homed_at_the_mirrored_point(tmp_path):
    """What the order is for: with b and c exchanged the nozzle is believed above the elbows."""
    firmware, _ = exported(new_model("delta_nominal"), tmp_path)
    assert firmware.home_position() == pytest.approx([0, 0, 176.1677], abs=1e-4)
    clockwise = vf.Klipper(exchanged((tmp_path / "printer.cfg").read_text()))
    home = clockwise.home_position()
    assert home == pytest.approx([0, 0, 493.8323], abs=1e-4)
    down = np.column_stack([np.zeros((200, 2)), np.linspace(home[2], 0, 200)])
    assert np.isnan(clockwise.motors(down)).any()


def exchanged(text):
    """With the names of the sections of stepper_b and stepper_c exchanged, everywhere."""
    text = text.replace("[stepper_b]", "[stepper_?]").replace("[stepper_c]", "[stepper_b]")
    return text.replace("[stepper_?]", "[stepper_c]")


def test_an_export_says_which_joint_each_stepper_drives(tmp_path):
    done = export(new_model("delta_nominal"), "klipper", tmp_path)
    assert done.remarks == [
        "Klipper requires its steppers in counter-clockwise order, seen from above. Enter the pins "
        "of joint3 in [stepper_b] and the pins of joint2 in [stepper_c]",
        "frame of the firmware in {B}: origin x 0 y 0 z 275 mm, x-axis 1 0 0, z-axis 0 0 -1",
        "the firmware's motors are joint1, joint3, joint2, in this order",
    ]
    text = (tmp_path / "printer.cfg").read_text()
    assert [line for line in text.splitlines() if line.startswith("angle")] == [
        "angle = 0.000000",
        "angle = 120.000000",
        "angle = 240.000000",
    ]
    assert export(new_model("linear_delta"), "klipper", tmp_path).remarks == []


@pytest.mark.parametrize("name", first("linear_delta off nominal", "delta54 off nominal"))
def test_what_was_exported_is_read_back_and_exported_the_same_again(name, tmp_path):
    export(delta(name), "klipper", tmp_path)
    file = tmp_path / "printer.cfg"
    text = file.read_text()
    done = export(configured([file]).model, "klipper", tmp_path / "again")
    assert not [remark for remark in done.remarks if "drives" in remark or "motors" in remark]
    assert done.loss["position_max"] < 0.2e-6
    then, now = (vf.Klipper(t) for t in (text, (tmp_path / "again/printer.cfg").read_text()))
    points = np.random.default_rng(2).uniform([-40, -40, 20], [40, 40, 90], (100, 3))
    np.testing.assert_allclose(now.motors(points), then.motors(points), atol=1e-4)


def turned(angles):
    """A user's linear Delta whose steppers stand at these angles (degrees)."""
    text = PRINTER
    for name, angle in zip("abc", angles, strict=True):
        text = text.replace(f"[stepper_{name}]\n", f"[stepper_{name}]\nangle: {angle}\n", 1)
    return text


USERS = {
    "linear from the rear": (turned((90, 210, 330)), (90, 210, 330)),
    "linear as documented": (PRINTER, (210, 330, 90)),
    "linear, turned by half a turn": (turned((30, 150, 270)), (30, 150, 270)),
    "rotary as documented": (ROTARY, (30, 150, 271)),
    "rotary from the front": (
        ROTARY.replace("angle: 271", "angle: 30")
        .replace("[stepper_a]", "[stepper_a]\nangle: 150")
        .replace("[stepper_b]", "[stepper_b]\nangle: 270"),
        (150, 270, 30),
    ),
}


@pytest.mark.parametrize("name", first(*USERS))
def test_a_users_steppers_stay_where_they_are(name, tmp_path):
    """Each stepper keeps its joint and its place, and the coordinates are not turned."""
    text, angles = USERS[name]
    file = tmp_path / "printer.cfg"
    file.write_text(text)
    model = configured([file]).model
    done = export_into(moved(model), "klipper", [file])
    assert not [remark for remark in done.remarks if not remark.startswith("what")]
    firmware = vf.Klipper(file.read_text())
    away = (np.degrees(firmware.around) - angles + 180) % 360 - 180
    assert np.abs(away).max() < 1
    assert done.loss["position_mean"] < 0.5 * done.before["position_mean"]
    home = firmware.home_position()
    assert firmware.forward(firmware.homed()[None])[0] == pytest.approx(home)
    assert home == pytest.approx([0, 0, firmware.each("position_endstop").mean()], abs=3)


CLOCKWISE = {
    "rotary": ROTARY.replace("angle: 271", "angle: 150").replace(
        "[stepper_b]", "[stepper_b]\nangle: 270"
    ),
    "linear": LINEAR.replace("angle = 331.0", "angle = 91.0")
    .replace("[stepper_c]", "[stepper_c]\nangle: 330")
    .partition("#*# distance0 = ")[0],
}


@pytest.mark.parametrize("name", CLOCKWISE)
def test_clockwise_steppers_are_refused_with_the_cure_and_the_cure_helps(name, tmp_path):
    file = tmp_path / "printer.cfg"
    file.write_text(CLOCKWISE[name])
    model = new_model("linear_delta" if name == "linear" else "delta24")
    for act in (
        lambda: configured([file]),
        lambda: samples("klipper", [file]),
        lambda: export_into(model, "klipper", [file]),
    ):
        with pytest.raises(DatasetError) as error:
            act()
        message = str(error.value)
        assert "[stepper_c] angle is '" in message
        assert "expected steppers a, b, c counter-clockwise seen from above" in message
        assert "set the angle in [stepper_b] and [stepper_c], then exchange the names" in message
    assert file.read_text() == CLOCKWISE[name]
    file.write_text(exchanged(CLOCKWISE[name]))
    done = export_into(moved(configured([file]).model), "klipper", [file])
    assert not [remark for remark in done.remarks if "drives" in remark]
    firmware = vf.Klipper(file.read_text())
    assert firmware.home_position()[2] == pytest.approx(
        firmware.each("position_endstop").mean(), abs=2
    )


def test_a_model_with_clockwise_joints_has_its_second_and_third_exchanged(tmp_path):
    """z of {B} points up here: it is the joints' order that Klipper cannot have."""
    file = tmp_path / "printer.cfg"
    file.write_text(ROTARY)
    mechanism = configured([file]).model.mechanism
    angles = {"chain2.theta": np.radians(271), "chain3.theta": np.radians(150)}
    mechanism.parameters = mechanism.parameters.with_nominal(angles)
    model = new_model(mechanism)
    firmware, (_, _, order) = exported(model, tmp_path / "out")
    assert order == [0, 2, 1]
    assert np.degrees(firmware.around) == pytest.approx([30, 150, 271])


def test_steppers_in_one_line_are_refused(tmp_path):
    file = tmp_path / "printer.cfg"
    file.write_text(ROTARY.replace("angle: 271", "angle: 150"))
    with pytest.raises(DatasetError, match=r"they are at 30, 150, 150 degrees: .* correct the ang"):
        klipper.firmware(klipper.settings([file]))
