"""Klipper's stored touches and configuration become samples and a model; or one clear line."""

import re

import numpy as np
import pytest

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.importing.controller_files import configured, samples
from parallel_cal.importing.deltas import compute_positions
from parallel_cal.importing.importers import klipper
from parallel_cal.importing.klipper_config import settings
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.drive import Drive
from parallel_cal.model.shelf import load_effect
from parallel_cal.recordings.info import info_of
from parallel_cal.reporting.blocks import as_text
from parallel_cal.reporting.recorded import describe_info

MM, DEGREE = 1e-3, np.pi / 180
LINEAR = """\
[printer]
kinematics: delta
#delta_radius: 140   # mm
print_radius = 120

[stepper_a]
rotation_distance: 40
microsteps: 16
position_endstop: 300
arm_length: 250
homing_speed: 50
[stepper_b]
rotation_distance: 40
microsteps: 16
[stepper_c]
rotation_distance: 40
microsteps: 16
gear_ratio: 2:1
[gcode_macro X]
gcode:
    G28
    M117 a=b
[delta_calibrate]
radius: 70

#*# <---------------------- SAVE_CONFIG ---------------------->
#*# DO NOT EDIT THIS BLOCK OR BELOW. The contents are auto-generated.
#*#
#*# [printer]
#*# delta_radius = 150.000000
#*#
#*# [stepper_b]
#*# angle = 331.000000
#*# position_endstop = 299.500000
#*#
#*# [delta_calibrate]
#*# height0 = 0.2
#*# height0_pos = 24000.000,23960.000,48000.000
#*# height1 = 0.0
#*# height1_pos = 24016.000,23976.000,48032.000
#*# manual_height0 = 0.1
#*# manual_height0_pos = 24000.000,23960.000,48000.000
#*# distance0 = 55.1
#*# distance0_pos1 = 20000.0,20000.0,40000.0
#*# distance0_pos2 = 20100.0,20000.0,40000.0
"""
ROTARY = """\
[printer]
kinematics: rotary_delta
shoulder_radius: 50
shoulder_height: 200
[stepper_a]
gear_ratio: 107.000:16, 60:16
microsteps: 16
full_steps_per_rotation: 400
position_endstop: 50
upper_arm_length: 100
lower_arm_length: 250
[stepper_b]
microsteps: 16
gear_ratio: 107.000:16, 60:16
[stepper_c]
microsteps: 16
gear_ratio: 107.000:16, 60:16
angle: 271
[delta_calibrate]
height0: 0
height0_pos: 1000,2000.5,-300
"""
POINTS = np.array([[20, -35, 8], [-50, 10, 3], [5, 60, 40]]) * MM


@pytest.fixture
def file(tmp_path):
    """file(text): its path."""

    def write(text):
        (tmp_path / "printer.cfg").write_text(text)
        return [tmp_path / "printer.cfg"]

    return write


def test_steps_count_from_the_end_stops(file):
    """A rod of 250 reaches 200 up over 150: carriages at 500, 499.5 and 500 mm, 300 mm above bed;
    a step is 12.5 um, behind the gear 6.25 um."""
    data = samples("klipper", file(LINEAR))
    np.testing.assert_allclose(data.q[0], np.array([200, 200, 200]) * MM, atol=1e-12)
    np.testing.assert_allclose(data.q[1], np.array([199.8, 199.8, 199.8]) * MM, atol=1e-12)
    np.testing.assert_array_equal(
        data.conditions["reading.probe"][:3], np.array([0.2, 0, 0.1]) * MM
    )
    np.testing.assert_allclose(data.joint_sigma * 12**0.5, np.array([12.5, 12.5, 6.25]) * 1e-6)
    assert not data.warnings
    assert len(data) == 5  # with the two ends of a distance
    model = configured(file(LINEAR)).model
    at = Kinematics(model).direct(data.q[:1] + 0.05).position
    np.testing.assert_allclose(at, [[0, 0, 0.05]], atol=1e-9)
    np.testing.assert_allclose(
        [high for _, high in model.mechanism.joint_limits], [0.5, 0.4995, 0.5], atol=1e-12
    )
    assert model.value("chain2.D_y") == pytest.approx(0.15 * np.sin(DEGREE))


def test_touches_at_one_place_are_its_visits_however_far_their_heights_are_apart(file):
    """Two places, a millimetre apart, each probed five times: heights scatter by 1 mm, and steps
    are whole. By its joints, a touch may be nearer to one of the other place."""
    plain = re.sub(r"#\*# (manual_)?(height|distance).*\n", "", LINEAR)
    machine = configured(file(plain)).formula
    rng, lines = np.random.default_rng(4), []
    xy = np.repeat([[30, 40], [31, 40]], 5, axis=0) * MM
    for k, place in enumerate(xy):
        q = machine.joints(np.array([[*place, rng.normal(0, 1) * MM]]))[0]
        steps = np.round((machine.homed - q) / np.array([12.5, 12.5, 6.25]) / 1e-6)
        words = ",".join(f"{count:.3f}" for count in steps)
        lines += [f"#*# height{k} = 0.0", f"#*# height{k}_pos = {words}"]
    data = samples("klipper", file(plain + "\n".join(lines) + "\n"))
    np.testing.assert_array_equal(data.pose_id, np.repeat(data.pose_id[[0, 5]], 5))
    assert data.pose_id[0] != data.pose_id[5]


@pytest.mark.parametrize("old", ["rotation_distance: 40", "rotation_distance: 40\nmicrosteps: 16"])
def test_a_step_distance_of_an_old_configuration_is_read(file, old):
    """40 mm a turn of 3200 microsteps are 12.5 um a microstep."""
    # Its distances are steps of the geared motor.
    plain = re.sub(r"#\*# distance0.*\n", "", LINEAR).replace("gear_ratio: 2:1\n", "")
    text = plain.replace(old, "step_distance: .0125")
    assert text.count("step_distance: .0125") == 3
    expected = samples("klipper", file(plain))
    found = samples("klipper", file(text))
    np.testing.assert_allclose(found.q, expected.q, atol=1e-12)
    np.testing.assert_allclose(found.joint_sigma, expected.joint_sigma)
    assert configured(file(text)).model.mechanism.scale is None
    with pytest.raises(ParallelCalError, match="step_distance is '0', expected mm a microstep"):
        samples("klipper", file(text.replace(".0125", "0")))


def test_a_block_on_the_bed_may_be_half_a_metre_high(file):
    data = samples("klipper", file(LINEAR.replace("manual_height0 = 0.1", "manual_height0 = 50.8")))
    assert data.conditions["reading.probe"][2] == pytest.approx(0.0508)
    for height, limit in (("manual_height0", 500), ("height1", 50)):
        text = re.sub(rf"\b{height} = .*", f"{height} = {limit + 1}", LINEAR)
        message = (
            f"{height} is '{limit + 1}', expected the nozzle's height in mm, from -{limit} to "
        )
        message += str(limit)
        with pytest.raises(ParallelCalError, match=message):
            samples("klipper", file(text))


def test_touches_behind_a_gap_are_counted(file):
    """Klipper reads height0, height1, ... until one is missing."""
    more = LINEAR.replace("height1", "height2")
    more = more.replace(
        "#*# manual", "#*# height3 = 0.1\n#*# height3_pos = 1.0,2.0,3.0\n#*# manual", 1
    )
    data = samples("klipper", file(more))
    assert len(data) == 4
    assert "height1 is missing" in data.warnings[0]
    assert data.warnings[0].endswith("omits 2 heights behind it")


def test_heights_that_klipper_might_have_stored_are_not_looked_for(file, monkeypatch):
    """A printer with a measured bed took 4 s to read: each of its heights was compared with 999
    keys, in case it was misspelt."""
    read = []
    monkeypatch.setattr(klipper, "settings", lambda paths: read.append(settings(paths)) or read[-1])
    samples("klipper", file(LINEAR))
    assert len(read[0].asked) < 60


def test_a_nozzle_beside_its_probe_takes_no_part_in_its_touches(file):
    data = samples("klipper", file("[probe]\nz_offset: 2\nx_offset: -20\n" + LINEAR))
    assert len(data) == 4
    assert data.warnings[0].startswith("manual heights")
    for kind in ("[bltouch]", "[smart_effector]", "[probe_eddy_current my_coil]"):
        model = configured(file(f"{kind}\nz_offset: 2\ny_offset: 7\n" + LINEAR)).model
        assert model.sensors[0].tip == (0.0, 0.007, 0.0)


def test_an_included_file_that_was_not_read_is_named(file, tmp_path):
    path = file(LINEAR.replace("[printer]", "[include delta.cfg]\n[printer]", 1))
    (remark,) = [text for text in configured(path).remarks if "delta.cfg" in text]
    assert remark.startswith("the included file delta.cfg was not found and not read: if a value o")
    head, body = LINEAR.split("[stepper_a]")
    body, saved = body.split("\n#*# <", 1)
    path = file("[include macros/*.cfg]\n[include delta.cfg]\n" + head + "\n#*# <" + saved)
    with pytest.raises(ParallelCalError) as error:
        configured(path)
    assert "the included files macros/*.cfg, delta.cfg were not found and not" in str(error.value)
    elsewhere = tmp_path / "download" / "delta.cfg"
    elsewhere.parent.mkdir()
    elsewhere.write_text("[stepper_a]" + body)
    remarks = configured([*path, elsewhere]).remarks
    assert any("the included file macros/*.cfg was not found" in text for text in remarks)


def test_the_rotary_model_is_the_firmwares_formula(file):
    """(dx, dy) from a shoulder to the nozzle, |elbow| = upper arm, |nozzle - elbow|^2 + across^2
    = lower arm squared, solved here by bisection of the arm's angle."""
    model = configured(file(ROTARY)).model
    angles = []
    for point in POINTS:
        for a in np.radians([30, 150, 271]):
            out, across = point[:2] @ [np.cos(a), np.sin(a)], point[:2] @ [-np.sin(a), np.cos(a)]
            x, y = out - 0.05, point[2] - 0.2

            def long(t, x=x, y=y, across=across):
                return np.hypot(np.hypot(0.1 * np.cos(t) - x, 0.1 * np.sin(t) - y), across) - 0.25

            low, high = np.arctan2(-y, -x) - np.pi, np.arctan2(-y, -x)  # folded out to stretched
            for _ in range(60):
                middle = (low + high) / 2
                low, high = (middle, high) if long(middle) < 0 else (low, middle)
            angles.append(low)
    pose = Kinematics(model).direct(np.reshape(angles, (-1, 3)))
    np.testing.assert_allclose(pose.position, POINTS, atol=1e-9)


def test_an_end_stop_that_no_arm_reaches_is_named(file):
    with pytest.raises(ParallelCalError) as error:
        configured(file(ROTARY.replace("position_endstop: 50", "position_endstop: 900")))
    assert "cfg:9: [stepper_a] position_endstop is '900', expected a height" in str(error.value)


def test_steps_of_a_rotary_delta_are_angles(file):
    data = samples("klipper", file(ROTARY))
    model = configured(file(ROTARY)).model
    top = Kinematics(model).inverse(np.array([[0, 0, 0.05]])).joints[0]
    a_step = 2 * np.pi / 16 / (107 / 16 * 60 / 16)
    steps = np.array([1000 / 400, 2000.5 / 200, -300 / 200])
    np.testing.assert_allclose(data.q[0], top - a_step * steps, atol=1e-9)


BROKEN = {
    "kinematics": ("kinematics: delta", "kinematics: corexy", "cfg:2: [printer] kinematics is 'co"),
    "no kinematics": ("kinematics: delta", "", "no [printer] kinematics, expected delta or"),
    "no section": ("[printer]\nkin", "kin", "cfg:1: the line is 'kinematics: delta', expected [s"),
    "no pair": ("microsteps: 16", "microsteps 16", "cfg:8: the line is 'microsteps 16', expected"),
    "radius": ("150.000000", "15O", "cfg:30: [printer] delta_radius is '15O', expected mm"),
    "short arm": ("arm_length: 250", "arm_length: 25", "cfg:10: [stepper_a] arm_length is '25'"),
    "no arm": ("arm_length: 250", "", "no [stepper_a] arm_length, expected mm, longer"),
    "no distance": (
        "[stepper_b]\nrotation_distance: 40",
        "[stepper_b]",
        "no [stepper_b] rotation_distance, expected mm a turn",
    ),
    "gear": ("2:1", "2", "cfg:18: [stepper_c] gear_ratio is '2', expected ratios such as"),
    "gears": ("2:1", "2:x", "cfg:18: [stepper_c] gear_ratio is 'x', expected ratios"),
    "endstop": ("299.500000", "nan", "cfg:34: [stepper_b] position_endstop is 'nan'"),
    "height": ("height0 = 0.2", "height0 = high", "cfg:37: [delta_calibrate] height0 is 'high'"),
    "position": ("24000.000,23960.000,", "24000.000,", "cfg:38: [delta_calibrate] height0_pos is"),
    "step": ("23976.000", "2397o", "cfg:40: [delta_calibrate] height1_pos is '2397o', expected"),
    "no position": ("height1_pos", "height1_at", "no [delta_calibrate] height1_pos, expected ste"),
    "no touches": ("height", "weight", "no [delta_calibrate] height0, expected what DELTA_CALI"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_file_is_named_with_line_and_field(file, name):
    old, new, message = BROKEN[name]
    assert old in LINEAR
    with pytest.raises(ParallelCalError) as error:
        samples("klipper", file(LINEAR.replace(old, new)))
    assert message in str(error.value)
    assert "printer.cfg" in str(error.value)
    assert "\n" not in str(error.value)


def test_motors_that_no_place_explains_have_none():
    class Bowl:
        def joints(self, r, R=None):
            return r**2 + 1e-4

    found = compute_positions(Bowl(), np.array([[0.0] * 3, [2e-4] * 3]), np.full((2, 3), 0.009))
    assert np.isnan(found[0]).all()
    np.testing.assert_allclose(found[1], 0.01, rtol=1e-6)


def test_a_carriage_moves_by_its_rotation_distance_per_turn_of_its_pulley(file):
    """40 mm a turn of each pulley; the third motor turns twice for it. 8 mm are a screw's."""
    text = LINEAR.replace("[stepper_b]\nrotation_distance: 40", "[stepper_b]\nrotation_distance: 8")
    text = re.sub(r"#\*# distance0.*\n", "", text)
    drives = configured(file(text)).model.mechanism.drives
    assert drives == (
        Drive("belt", per_rev=40 * MM),
        Drive("screw", per_rev=8 * MM),
        Drive("belt", per_rev=20 * MM, gear=2.0),
    )
    assert [drive.lead for drive in drives] == pytest.approx([40 * MM, 8 * MM, 40 * MM])
    assert configured(file(ROTARY)).model.mechanism.drives == ()


def test_a_diagnosis_tries_the_turns_of_a_pulley_and_of_the_motor_behind_its_gear_alone(file):
    model = configured(file(LINEAR)).model
    recorded = {joint: np.linspace(0.2, 0.5, 9) for joint in model.joints}
    tried = load_effect("screw_pitch_error").scan(model.mechanism, recorded)
    assert [one["lead"] for one in tried] == pytest.approx([40 * MM, 20 * MM])


def test_a_stepper_without_a_turn_has_no_drive(file):
    text = LINEAR.replace("[stepper_b]\nrotation_distance: 40\n", "[stepper_b]\n")
    text = re.sub(r"#\*# distance0.*\n", "", text)
    _, second, third = configured(file(text)).model.mechanism.drives
    assert second is None
    assert third is not None


def test_angles_of_joints_are_shown_of_a_printer_that_has_some(file):
    """Carriages have none: they are no `revolute` joints that a reader has to judge."""
    linear, rotary = (
        as_text(describe_info(info_of(samples("klipper", file(text))))) for text in (LINEAR, ROTARY)
    )
    assert "revolute" not in linear + rotary
    assert not re.search(r"to .* deg\b", linear)
    assert re.search(r"to .* deg\b", rotary)
