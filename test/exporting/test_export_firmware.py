"""Firmwares' numbers: written as documented, and what they lose is what independent firmwares show.

The loss is measured with the numbers as they are written, read by somebody else's reader, on robots
that share nothing with the package.
"""

import importlib
import json
import re
from functools import cache

import numpy as np
import pytest
import virtual_firmware as vf
import virtual_small as small
from test_import_damaged import damaged
from virtual_cable import Line, WoundCable

from parallel_cal.base.errors import ModelError, ParallelCalError
from parallel_cal.cli.main import main
from parallel_cal.exporting.export import export, export_into
from parallel_cal.importing.controller_files import configured
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import read_model, write_model
from parallel_cal.model.mechanism import Home, poses_in_workspace
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_mechanism
from parallel_cal.virtual import robot as vr
from parallel_cal.virtual import stewart
from parallel_cal.virtual.linear_delta import LinearDelta

MM, DEGREE = 1e-3, np.pi / 180
# Firmwares with a radius for each tower of a linear Delta.
TOWERS_APART = ("smoothieware", "mk4duo", "richcattell")
ROTARY = ("rrf", "klipper", "grblhal", "linuxcnc", "smoothieware", "fluidnc")
UPSIDE_DOWN = np.diag([1.0, -1.0, -1.0])


@cache
def off(name, tolerances=0.3, seed=1):
    """A robot off its nominal."""
    model = new_model(name)
    table, rng = model.table, np.random.default_rng(seed)
    values = table.nominal + tolerances * table.tolerance * rng.standard_normal(len(table))
    return model.with_values(np.where(model.fixed, table.nominal, values))


def simulated(target, folder):
    """The firmware that reads what was written."""
    files = [path for path in folder.rglob("*") if path.suffix != ".csv" and path.is_file()]
    text = {path.name: path.read_text() for path in files}
    if target == "linuxcnc":
        return vf.LinuxCnc(text["machine.hal"], text["machine.ini"])
    kinds = {"klipper": vf.Klipper, "rrf": vf.Duet, "grblhal": vf.GrblHal}
    kinds |= {"smoothieware": vf.Smoothie, "mk4duo": vf.mk4duo, "richcattell": vf.richcattell}
    kinds |= {"fluidnc": vf.FluidNcDelta}
    return kinds.get(target, vf.Marlin)(next(iter(text.values())))


def told_frame(remarks):
    """Origin (m) and axes that a remark tells, and the motors' order."""
    origin, axes, order = np.zeros(3), np.eye(3), [0, 1, 2]
    for remark in remarks:
        if remark.startswith("frame of the firmware"):
            numbers = np.array([w.strip(",") for w in remark.split() if _is_number(w)], float)
            origin, x, z = numbers[:3] * MM, numbers[3:6], numbers[6:9]
            axes = np.column_stack([x, np.cross(z, x), z])
        if remark.startswith("the firmware's motors"):
            order = [int(w.strip(",")[-1]) - 1 for w in remark.split() if w.startswith("joint")]
    return origin, axes, order


def _is_number(word):
    try:
        float(word.strip(","))
    except ValueError:
        return False
    return True


def first(name, *others):
    """One of several in every run, the others in the wide one."""
    return [name, *(pytest.param(other, marks=pytest.mark.wide) for other in others)]


@pytest.mark.parametrize("target", first(*ROTARY))
def test_the_loss_of_a_rotary_delta_is_what_rods_and_points_show(target, tmp_path):
    model = new_model("delta54", vr.TABLE_5_18)
    done = export(model, target, tmp_path)
    firmware = simulated(target, tmp_path)
    origin, axes, order = told_frame(done.remarks)
    r, _ = poses_in_workspace(model.mechanism, 2000, np.random.default_rng(1))
    motors = firmware.motors((r - origin) @ axes / MM) - firmware.homed()
    # z of {B} points down: arms up is a falling reading, their upper ends are the lower limits
    sense = -1.0 if target in ("rrf", "klipper") else 1.0
    q = np.empty_like(motors)
    q[:, order] = -30 * DEGREE + sense * motors * DEGREE
    reached, _ = vr.MOCK_UP.forward(q)
    error = np.linalg.norm(reached - r, axis=1)
    assert error.mean() == pytest.approx(done.loss["position_mean"], rel=0.01)
    assert error.max() == pytest.approx(done.loss["position_max"], rel=0.01)
    assert np.linalg.norm(r[error.argmax()] - done.loss["position_worst_at"]) < 1e-9
    worst = {"klipper": 100e-6, "rrf": 60e-6, "linuxcnc": 300e-6}
    assert error.max() < worst.get(target, 400e-6)


@pytest.mark.parametrize(
    "target",
    first("klipper", "rrf", "linuxcnc", "marlin", "marlin_equal_rods", *TOWERS_APART),
)
def test_the_loss_of_a_linear_delta_is_what_rods_and_points_show(target, tmp_path):
    model = off("linear_delta", 0.1)
    done = export(model, target, tmp_path)
    firmware = simulated(target, tmp_path)
    origin, axes, order = told_frame(done.remarks)
    r, _ = poses_in_workspace(model.mechanism, 2000, np.random.default_rng(1))
    r = r[:400]
    motors = (firmware.motors((r - origin) @ axes / MM) - firmware.homed()) * MM
    q = np.empty_like(motors)
    q[:, order] = 0.6 + motors
    robot = LinearDelta(model.table.mapping(model.values))
    start = (r, np.broadcast_to(np.eye(3), (len(r), 3, 3)))
    error = np.linalg.norm(robot.forward(q, start)[0] - r, axis=1)
    assert error.mean() == pytest.approx(done.loss["position_mean"], rel=0.1)
    assert error.max() <= done.loss["position_max"] + 1e-6
    assert error.max() > 0.5 * done.loss["position_max"]


def test_the_loss_of_a_hexapod_is_what_its_struts_show(tmp_path):
    model = off("stewart42")
    done = export(model, "linuxcnc", tmp_path)
    firmware = simulated("linuxcnc", tmp_path)
    r, R = poses_in_workspace(model.mechanism, 2000, np.random.default_rng(1))
    robot = stewart.Stewart(model.table.mapping(model.values))
    q = 0.2 + (firmware.motors(r / MM, R) - firmware.homed()) * MM  # its legs are homed far out
    assert np.abs(q - robot.inverse(r, R)[0]).max() < 20e-9
    assert done.loss["position_max"] < 20e-9
    assert done.loss["orientation_max"] < 1e-7


def test_a_five_bar_loses_only_digits(tmp_path):
    """M669 K9 has a number for each of its ten: the angle at the switch for an encoder's offset."""
    model = off("five_bar", 1.0)
    done = export(model, "rrf", tmp_path)
    firmware = simulated("rrf", tmp_path)
    r, _ = poses_in_workspace(model.mechanism, 500, np.random.default_rng(1))
    q = np.array([np.pi, 0.0]) + np.radians(firmware.motors(r / MM) - firmware.homed())
    robot = small.FiveBar(model.table.mapping(model.values))
    error = np.linalg.norm(robot.forward(q)[0] - r, axis=1)
    assert error.max() <= done.loss["position_max"] + 1e-9
    assert error.mean() == pytest.approx(done.loss["position_mean"], rel=0.1)
    assert done.loss["position_max"] < 0.2e-6
    plain = export(new_model("five_bar"), "rrf", tmp_path)
    text = (tmp_path / "config.g").read_text().replace("-0.0000", "0.0000")
    assert text == (
        "M669 K9 X-50.0000:50.0000 Y0.0000:0.0000 L2 P100.0000:100.0000 D150.0000:150.0000:0:0 "
        "B180.00000:0.00000 C60.000:180.000:0.000:120.000\n"
    )
    again = configured(plain.paths).model
    assert again.mechanism.switches == pytest.approx([np.pi, 0])
    found = Kinematics(again).inverse([0.01, 0.19, 0.0])
    assert found.joints == pytest.approx(
        Kinematics(new_model("five_bar")).inverse([0.01, 0.19, 0]).joints
    )
    inward = new_model("five_bar")
    inward.mechanism.home = Home((0.6, 2.5), (0.0, 0.19842, 0.0))
    with pytest.raises(ModelError, match="no work mode for a left crank"):
        export(inward, "rrf", tmp_path)


@pytest.mark.wide
def test_a_hangprinters_lines_agree_with_wound_ones_to_the_stated_loss(tmp_path):
    """Line of 0.5 mm on spools 8 mm wide; the loss at 1000 other poses, of real windings."""
    section, width = np.pi * 0.25e-3**2, 8e-3
    model = new_model("cable", {"spool_buildup.Q": section / np.pi / width}, ["spool_buildup"])
    names = [n for n in model.table.names if n.endswith(("A_x", "A_y", "A_z", ".R"))]
    rng, values = np.random.default_rng(5), model.table.mapping(model.values)
    values |= {name: values[name] + 5e-3 * rng.standard_normal() for name in names}
    model = new_model("cable", values, ["spool_buildup"])
    done = export(model, "rrf", tmp_path)
    text = (tmp_path / "config.g").read_text()
    assert "M669 K6 N4 A" in text
    assert " U2:2:2:4 O1:1:1:1 L20:20:20:20 H255:255:255:255" in text
    firmware = vf.Duet(text)
    r, _ = poses_in_workspace(model.mechanism, 1000, np.random.default_rng(9))
    robot = WoundCable(values, Line(section=section, width=width))
    lines = np.radians(firmware.motors(r / MM)) - robot.motors(r)
    lines *= model.mechanism.winds
    assert np.abs(lines).max() < 1.1 * done.loss["line_max"] + 1e-8
    assert np.abs(lines).mean() == pytest.approx(done.loss["line_mean"], abs=2e-8)
    assert done.loss["line_max"] < 1e-6
    assert done.remarks == ["the loss includes what its numbers cannot represent of spool_buildup"]


def test_lines_that_start_at_another_length_are_lost_and_reported(tmp_path):
    """The firmware has no number for the line's length at reading zero."""
    model = off("cable")
    done = export(model, "rrf", tmp_path)
    firmware = simulated("rrf", tmp_path)
    r, _ = poses_in_workspace(model.mechanism, 1000, np.random.default_rng(1))
    robot = small.Cable(model.table.mapping(model.values))
    upright = np.broadcast_to(np.eye(3), (1000, 3, 3))
    lines = np.radians(firmware.motors(r / MM)) - robot.inverse(r, upright)[0]
    lines = np.abs(lines * model.mechanism.winds)
    assert lines.mean() == pytest.approx(done.loss["line_mean"], rel=0.05)
    assert done.loss["line_max"] > 1e-3
    assert "M666 Q must be at least 0.002" in done.remarks[0]
    assert "no number for the offset of the lines" in done.remarks[1]


def test_the_fifth_anchor_has_the_letter_that_its_firmware_reads(tmp_path):
    anchors = [[1, 0, -0.1], [0, 1, -0.1], [-1, 0, -0.1], [0, -1, -0.1], [0, 0, 2.3]]
    model = new_model(load_mechanism("cable", anchors=anchors, spools=[1, 2, 3, 4, 5]))
    done = export(model, "rrf", tmp_path)
    firmware = simulated("rrf", tmp_path)
    assert firmware.w["M669 I"] == pytest.approx([0, 0, 2300], abs=1)
    robot = small.Cable(model.table.mapping(model.values), spools=(1, 2, 3, 4, 5))
    r, _ = poses_in_workspace(model.mechanism, 100, np.random.default_rng(1))
    wanted = robot.inverse(r, np.broadcast_to(np.eye(3), (100, 3, 3)))[0]
    off = np.abs(np.radians(firmware.motors(r / MM)) - wanted) * model.mechanism.winds
    assert off.max() <= done.loss["line_max"] + 1e-9
    assert len(configured(done.paths).model.joints) == 5
    six = load_mechanism("cable", anchors=[*anchors, [1, 1, 1]], radius=0.075)
    with pytest.raises(ModelError, match=r"6 lines .* expected 4 to 5 and whole numbers"):
        export(new_model(six), "rrf", tmp_path)


# ------------------------------------------------------------------ numbers worked by hand


def plain_delta():
    """Towers 150 mm from the middle, rods 250: carriages at 600 stand 200 above the nozzle."""
    values = {f"chain{i}.{n}": v for i in (1, 2, 3) for n, v in (("D_x", 0.15), ("Lb", 0.25))}
    mechanism = new_model("linear_delta").mechanism
    mechanism.options = {"direction": 210 * DEGREE}
    mechanism.direction = 210 * DEGREE
    return new_model(mechanism, values)


@pytest.mark.parametrize(
    ("target", "lines"),
    [
        (
            "klipper",
            [
                "delta_radius = 150.000000",
                "arm_length = 250.000000",
                "angle = 330.000000",
                "position_endstop = 400.000000",
            ],
        ),
        (
            "rrf",
            [
                "M665 L250.0000:250.0000:250.0000 R150.0000 H400.0000 X0.00000 Y0.00000 Z0.00000",
                "M666 X0.0000 Y0.0000 Z0.0000 A0.00000 B0.00000",
            ],
        ),
        (
            "linuxcnc",
            [
                "setp lineardeltakins.R 150.00000",
                "setp lineardeltakins.L 250.00000",
                "[JOINT_2]",
                "HOME_OFFSET = 600.000000",
            ],
        ),
    ],
)
def test_a_linear_delta_has_the_numbers_of_its_drawing(target, lines, tmp_path):
    export(plain_delta(), target, tmp_path)
    written = [line for path in tmp_path.rglob("*.*") for line in path.read_text().splitlines()]
    assert not set(lines) - {line.replace("-0.00000", "0.00000") for line in written}


@pytest.mark.parametrize(
    ("target", "numbers"),
    [
        # motors in z = 0 at 76 mm; -30 degrees of {B}, whose z points down, are 30 up; bed at z 275
        (
            "klipper",
            {
                "shoulder_radius": 76,
                "shoulder_height": 275,
                "upper_arm_length": 120,
                "lower_arm_length": 240,
            },
        ),
        ("rrf", {"M669 U": 120, "M669 L": 240, "M669 H": 275, "M669 R": 76, "M666 X": 0}),
        ("grblhal", {641: 240, 642: 120, 643: 2 * 3**0.5 * 76, 644: 0, 646: -30}),
        (
            "linuxcnc",
            {"platformradius": 76, "thighlength": 120, "shinlength": 240, "footradius": 0},
        ),
    ],
)
def test_a_rotary_delta_has_the_numbers_of_its_drawing(target, numbers, tmp_path):
    export(new_model("delta_nominal"), target, tmp_path)
    firmware = simulated(target, tmp_path)
    found = {
        "klipper": lambda key: {**firmware.printer, **firmware.steppers[1]}[key],
        "rrf": lambda key: firmware.w[key][0],
        "grblhal": lambda key: firmware.s[key],
        "linuxcnc": lambda key: firmware.pins[f"rotarydeltakins.{key}"],
    }[target]
    for key, number in numbers.items():
        assert float(found(key)) == pytest.approx(number, abs=1e-3)
    if target == "rrf":
        assert firmware.w["M669 A"][1] == pytest.approx(30, abs=1e-5)
    if target == "linuxcnc":
        np.testing.assert_allclose(firmware.homed(), -30, atol=1e-5)


# ------------------------------------------------------------------ the user's own files

CONFIG = """\
; my Kossel, do not lose this
M92 X160 Y160 Z160            ; steps per mm
M665 L250.000 R100 B65 H300 ; rods
M666 X-0.5 Y0.25 (mine) Z0.25
G31 P500 X0 Y0 Z0.1
"""
PRINTER = """\
# my printer
[printer]
kinematics: delta
#delta_radius: 140   # measured
print_radius = 80
[stepper_a]
position_endstop: 300
arm_length: 250 # carbon
[stepper_b]
microsteps: 16
[stepper_c]
microsteps: 16

#*# <---------------------- SAVE_CONFIG ---------------------->
#*# DO NOT EDIT THIS BLOCK OR BELOW. The contents are auto-generated.
#*#
#*# [printer]
#*# delta_radius = 150.000000
#*#
#*# [stepper_b]
#*# position_endstop = 299.500000
"""
HAL, INI = (
    "loadrt lineardeltakins\nsetp lineardeltakins.R 150 # here\nsetp lineardeltakins.L 250\n"
    "setp lineardeltakins.J1off 0.5\n",
    "[TRAJ]\nLINEAR_UNITS = mm\n[JOINT_0]\nHOME_OFFSET = 400.0\nTYPE = LINEAR\n[JOINT_1]\n"
    "HOME_OFFSET = 400.0\nTYPE = LINEAR\n[JOINT_2]\nHOME_OFFSET = 400.0\n",
)
OWN = {
    "rrf": {"config.g": CONFIG},
    "klipper": {"printer.cfg": PRINTER},
}


def moved(model):
    """The printer as it turns out: a longer rod, a tower further out, its angle, its end-stop."""
    rng = np.random.default_rng(3)
    free = ~model.fixed & (np.arange(len(model.table)) < len(model.mechanism.parameters))
    change = 0.1 * model.table.tolerance * rng.standard_normal(len(model.table))
    return model.with_values(model.values + np.where(free, change, 0))


@pytest.mark.parametrize("target", first("rrf", "klipper"))
def test_a_users_file_keeps_all_but_its_numbers_and_the_old_one_stays(target, tmp_path):
    [(name, text)] = OWN[target].items()
    file = tmp_path / name
    file.write_bytes(text.replace("\n", "\r\n").encode())
    model = moved(configured([file]).model)
    done = export_into(model, target, [file])
    export_into(model, target, [file])  # writes nothing new, and so loses nothing old
    assert (tmp_path / f"{name}.previous").read_bytes() == text.replace("\n", "\r\n").encode()
    written = file.read_bytes().decode()
    assert written.count("\r\n") == written.count("\n")
    number = r"[-+]?\d+\.?\d*(:[\d.]+)*"
    own, now = (
        [re.sub(number, "#", line).split() for line in t.splitlines()] for t in (text, written)
    )
    kept = [line for line in now if line in own]
    added = [w for line in now for w in line if not any(w in o for o in own)]
    assert len(own) - len(kept) <= 2  # commands that got words they did not have
    assert {w[0] for w in added} <= {"X", "Y", "Z", "A", "B", "#"} or target == "klipper"
    for comment in ("; rods", "(mine)", "; my Kossel", "# measured", "# carbon", "DO NOT EDIT"):
        assert (comment in text) == (comment in written)
    # what the firmware now computes is what was promised, and far better than before
    again = configured([file]).model
    assert done.loss["position_mean"] < 0.5 * done.before["position_mean"]
    assert export_into(again, target, [file]).loss["position_max"] < 0.2e-6
    assert export_into(again, target, [file]).before["position_max"] < 0.2e-6


def test_the_frame_of_the_previous_numbers_is_no_error_of_the_robot(tmp_path):
    """A turn of all towers and another homed height move the frame and leave the shape."""
    file = tmp_path / "config.g"
    file.write_text(CONFIG)
    model = moved(configured([file]).model)
    export_into(model, "rrf", [file])
    same = export_into(model, "rrf", [file]).before["without_frame"]
    words = vf.words(file.read_text())
    height, angles = words["M665 H"][0], [words[f"M665 {axis}"][0] for axis in "XYZ"]
    text = file.read_text().replace(f"H{height:.4f}", f"H{height + 1:.4f}")
    for axis, angle in zip("XYZ", angles, strict=True):
        text = text.replace(f"{axis}{angle:.5f}", f"{axis}{angle + 0.5:.5f}")
    file.write_text(text)
    done = export_into(model, "rrf", [file])
    assert done.before["position_mean"] > 1e-3
    before = done.before["without_frame"]
    assert before["position_max"] == pytest.approx(same["position_max"], abs=2e-6)
    turn, shift = before["turn"] - same["turn"], before["shift"] - same["shift"]
    assert turn == pytest.approx([0, 0, -0.5 * DEGREE], abs=20e-6)
    assert shift[2] == pytest.approx(-1e-3, abs=10e-6)
    assert done.loss["without_frame"]["position_mean"] <= done.loss["position_mean"]


def test_of_a_word_that_stands_twice_the_first_one_counts_and_comments_do_not(tmp_path):
    file = tmp_path / "config.g"
    file.write_text(CONFIG.replace("L250.000 R100", "L250 R100 L260 (not L250)"))
    model = moved(configured([file]).model)
    done = export_into(model, "rrf", [file])
    line = file.read_text().splitlines()[2]
    number = r"[-\d.:]+"
    words = "M665 L# R# L260 X# Y# Z# \\(not L250\\) B65 H# ; rods".replace("#", number)
    assert re.fullmatch(words, line)
    assert done.loss["position_mean"] < 0.1 * done.before["position_mean"]


def test_a_linuxcnc_machine_has_its_numbers_in_two_files(tmp_path):
    hal, ini = tmp_path / "my.hal", tmp_path / "my.ini"
    hal.write_text(HAL)
    ini.write_text(INI)
    model = moved(configured([hal, ini]).model)
    with pytest.raises(ModelError, match=r"belong in machine.ini"):
        export_into(model, "linuxcnc", [hal])
    assert hal.read_text() == HAL
    done = export_into(model, "linuxcnc", [hal, ini])
    firmware = vf.LinuxCnc(
        "\n".join(hal.read_text().splitlines()[1:]).replace("# here", ""), ini.read_text()
    )
    assert firmware.pin("lineardeltakins.L") != 250
    assert firmware.pin("lineardeltakins.J1off") == 0  # which today's version does not know
    assert len(firmware.homed()) == 3
    assert "# here" in hal.read_text()
    assert ini.read_text().count("TYPE = LINEAR") == 2
    assert done.loss["position_mean"] < done.before["position_mean"]


def test_a_signal_that_leads_to_a_pin_is_set(tmp_path):
    hal, ini = tmp_path / "my.hal", tmp_path / "my.ini"
    hal.write_text(HAL.replace("setp lineardeltakins.R", "net R lineardeltakins.R\nsets R"))
    ini.write_text(INI)
    done = export_into(moved(configured([hal, ini]).model), "linuxcnc", [hal, ini])
    assert re.search(r"\nsets R 149\.[0-9]+ # here\n", hal.read_text())
    assert done.loss["position_mean"] < done.before["position_mean"]
    hal.write_text("loadrt [KINS]KINEMATICS\n")
    with pytest.raises(ParallelCalError, match=r"no genhexkins.base.0.x, expected pins of"):
        export_into(new_model("linear_delta"), "linuxcnc", [hal, ini])


def test_what_a_target_cannot_hold_is_refused_and_targets_that_can_are_named(tmp_path):
    for name, target, can in (
        ("stewart42", "klipper", "c, cpp, linuxcnc, moveit, ros2_control, table can represent it"),
        (
            "linear_delta",
            "grblhal",
            "c, cpp, klipper, linuxcnc, marlin, marlin_equal_rods, mk4duo, moveit, repetier, "
            "richcattell, ros2_control, rrf, smoothieware, table, ucnc can",
        ),
        ("argos27", "rrf", "c, cpp, linuxcnc, moveit, ros2_control, table can represent it"),
    ):
        with pytest.raises(ModelError) as error:
            export(new_model(name), target, tmp_path)
        assert f"{target} has no numbers for {name}, only for" in str(error.value)
        assert can in str(error.value)
    (tmp_path / "printer.cfg").write_text(PRINTER)
    with pytest.raises(ModelError, match="configured for another kind of machine"):
        export_into(new_model("delta24"), "klipper", [tmp_path / "printer.cfg"])
    leaning = new_model(load_mechanism("linear_delta", inclination=0.3))
    with pytest.raises(
        ModelError, match=r"its rails are inclined by 17.2 degrees, .* c and table can"
    ):
        export(leaning, "klipper", tmp_path)
    with pytest.raises(ModelError, match="option 'x=1': rrf has none"):
        export(new_model("linear_delta"), "rrf:x=1", tmp_path)
    assert (tmp_path / "printer.cfg").read_text() == PRINTER


OF_ONES_OWN = """\
from parallel_cal.exporting.targets import grblhal
from parallel_cal.exporting.targets.grblhal import firmware, settings

HOLDS = ("delta24",)


def project(model):
    return grblhal.project(model)
"""


def test_a_users_own_firmware_is_found_by_its_python_path(tmp_path, monkeypatch):
    (tmp_path / "own_workshop").mkdir()
    file = tmp_path / "own_workshop" / "own_firmware.py"
    file.write_text(OF_ONES_OWN)
    monkeypatch.syspath_prepend(str(tmp_path))
    model = off("delta24")
    done = export(model, "own_workshop.own_firmware", tmp_path / "out")
    same = export(model, "grblhal", tmp_path / "out")
    assert done.loss["position_max"] == pytest.approx(same.loss["position_max"])
    file.with_name("broken.py").write_text(OF_ONES_OWN.replace("grblhal.project(model)", "1 / 0"))
    importlib.invalidate_caches()  # a second file in a folder that was just looked at
    with pytest.raises(ParallelCalError, match=r"division by zero \(broken.py:8\)"):
        export(model, "own_workshop.broken", tmp_path / "out")


def test_the_frame_is_that_of_the_plan_however_towers_turn_out(tmp_path):
    """What is a tower's identified angle must not turn the robot's coordinates."""
    table = new_model("delta24").table
    theta = np.array([name.endswith(".theta") for name in table.names])
    turned = new_model("delta24").with_values(table.nominal + 0.5 * DEGREE * theta)
    frames = [export(m, "rrf", tmp_path).remarks for m in (turned, new_model("delta24"))]
    assert frames[0] == frames[1]
    assert simulated("rrf", tmp_path).xyz("M669") == pytest.approx(np.zeros(3), abs=1e-4)
    export(turned, "rrf", tmp_path)
    assert simulated("rrf", tmp_path).xyz("M669") == pytest.approx(np.full(3, -0.5), abs=1e-4)


def test_a_leaning_bed_is_the_firmwares_zero(tmp_path):
    """Touches say how the plate lies; on it the firmware's height is zero."""
    (tmp_path / "config.g").write_text(CONFIG.replace("Z0.25\n", "Z0.25 A0.3 B-0.2\n"))
    model = configured([tmp_path / "config.g"]).model
    done = export(model, "rrf", tmp_path / "new")
    firmware = simulated("rrf", tmp_path / "new")
    assert firmware.w["M666 A"] == pytest.approx(0.3, abs=1e-4)
    assert firmware.w["M666 B"] == pytest.approx(-0.2, abs=1e-4)
    xy = np.array([[30.0, 10.0], [-40.0, 20.0], [0.0, -50.0]]) * MM
    flat = firmware.motors(np.column_stack([xy / MM, np.zeros(3)])) - firmware.homed()
    tops = np.array(model.mechanism.joint_limits)[:, 1]
    touched = Kinematics(model).direct(tops + flat * MM).position
    np.testing.assert_allclose(touched[:, 2], xy @ [0.003, -0.002], atol=0.2e-6)
    assert done.loss["position_max"] < 0.2e-6
    assert done.remarks[0].startswith(
        "frame of the firmware in {B}: origin x 0 y 0 z 0 mm, x-axis 1 0 0.003, "
        "y-axis 0 1 -0.002, z-axis 0 0 1. The axes are not orthogonal"
    )


def test_the_command_line_reports_what_is_lost(tmp_path, capsys):
    (tmp_path / "config.g").write_text(CONFIG)
    write_model(moved(configured([tmp_path / "config.g"]).model), tmp_path / "m.yaml")
    command = [
        "export",
        str(tmp_path / "m.yaml"),
        "--to",
        "rrf",
        "--into",
        str(tmp_path / "config.g"),
    ]
    with pytest.raises(SystemExit) as ended:
        main([*command, "--json"])
    document = json.loads(capsys.readouterr().out)
    assert ended.value.code == 0
    assert document["loss"]["position_mean"] < document["before"]["position_mean"]
    assert document["files"] == [str(tmp_path / "config.g")]
    with pytest.raises(SystemExit):
        main(command)
    said = capsys.readouterr().out
    assert "error that the firmware's simpler model leaves: mean " in said
    assert "error with the previous numbers: mean " in said
    assert "the frame of the previous numbers was off by x " in said
    assert "mrad; without this rigid motion the error with the previous numbers is mean " in said
    assert read_model(tmp_path / "m.yaml").mechanism.name == "linear_delta"
    with pytest.raises(SystemExit) as ended:
        main(command[:4])
    assert ended.value.code == 2


@pytest.mark.wide
@pytest.mark.parametrize("target", OWN)
def test_a_damaged_file_is_refused_in_one_line_or_edited_well(target, tmp_path):
    [(name, text)] = OWN[target].items()
    file = tmp_path / name
    file.write_text(text)
    model = moved(configured([file]).model)
    rng, refused, lost = np.random.default_rng(8), [], []
    for _ in range(25):
        broken = damaged(text, rng)
        file.write_text(broken, encoding="utf-8")
        try:
            lost.append(export_into(model, target, [file]).loss["position_mean"])
        except ParallelCalError as error:
            refused.append(str(error))
            assert file.read_text(encoding="utf-8") == broken
    assert len(refused) > 3
    assert not [line for line in refused if "\n" in line]
    assert np.ptp(lost) < 1e-6  # the numbers that are written are the same in each
