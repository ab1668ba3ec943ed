"""Smoothieware: `config` and `config-override` of linear and rotary Deltas, and Morgan's SCARA.

A line of `config` is `key value`. The commands in `config-override`, which M500 writes, count
before the keys that state the same.

- Linear: tower i is at arm_radius + its offset, turned by its angle from 210, 330 and 90 degrees.
  When homed, a carriage is where the nozzle on the axis has the height gamma_max + M206 Z - trim.
- Rotary: triangles' sides delta_e and delta_f, as in grblHAL; angles count down from the
  horizontal; the motors' plane is delta_z_offset - delta_ee_offs - delta_tool_offset above z = 0.
  The homing positions are angles if rdelta_homing is true.
- Morgan: when homed, each arm is at its angle for the homing position, less its trim in degrees
  (importing/morgan.py).

Source: Smoothieware/Smoothieware bb41e992, src/modules/robot/Robot.cpp, arm_solutions/
LinearDeltaSolution.cpp and RotaryDeltaSolution.cpp, tools/endstops/Endstops.cpp, and
libs/ConfigSource.cpp.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from parallel_cal.base.units import DEGREE, MM
from parallel_cal.importing import deltas
from parallel_cal.importing.controller_files import ConfiguredRobot
from parallel_cal.importing.deltas import HANGING_ANGLES, SIDE, Delta, Shoulders, Towers
from parallel_cal.importing.gcode import COMMAND, HOME_OFFSETS, parse_settings_line
from parallel_cal.importing.morgan import MorganArms
from parallel_cal.importing.settings import Settings, SourceLine, read_lines
from parallel_cal.model.machine_class import MachineClass
from parallel_cal.model.model import new_model
from parallel_cal.recordings.recording import Array

CONFIGURATION = ("", ".txt")
MACHINE_CLASS: MachineClass = "hobby"  # belts, printed parts, open loop
CODES = ("M92", "M206", "M665", "M666")
AXES = ("alpha", "beta", "gamma")
SOLUTION = "arm_solution"
LINEAR, ROTARY = ("linear_delta", "rostock", "kossel", "delta"), ("rotary_delta",)
MORGAN = ("morgan",)
KINDS = f"{', '.join(LINEAR)}, {ROTARY[0]} or {MORGAN[0]}"
TRIMS = tuple(f"{axis}_trim_mm" for axis in AXES)
OLD_TRIMS = tuple(f"{axis}_trim" for axis in AXES)  # before 718bfc9c
OLD_TRIM = "{0}:{1}: {2} is not used: like the firmware, this reads {2}_mm only. Rename the key"
STEPS = tuple(f"{axis}_steps_per_mm" for axis in AXES)
OFFSETS = tuple(f"delta_tower{i}_offset" for i in (1, 2, 3))
ANGLES = tuple(f"delta_tower{i}_angle" for i in (1, 2, 3))
SIDES = ("delta_e", "delta_f", "delta_re", "delta_rf")
DEPTHS = ("delta_z_offset", "delta_ee_offs", "delta_tool_offset")
MIRROR = "delta_mirror_xy"
ARMS = ("arm1_length", "arm2_length")
PLACE = ("morgan_offset_x", "morgan_offset_y")
SCALING = ("morgan_scaling_x", "morgan_scaling_y")
RATIOS = ("morgan_undefined_max", "morgan_undefined_min")
REAL_SCARA = "real_scara"
HOMING = {LINEAR: "delta_homing", ROTARY: "rdelta_homing", MORGAN: "scara_homing"}
HOMED_BY_JOINTS = "true: otherwise the firmware does not home this kind of machine by its joints"
# Commands that set a key, by the kind of machine.
WORDS = [f"{code} {axis}" for code in ("M666", "M92") for axis in "XYZ"]
SAME = dict(zip((*TRIMS, *STEPS), WORDS, strict=True))
COMMANDS = {
    LINEAR: SAME
    | dict(zip(("arm_length", "arm_radius"), ("M665 L", "M665 R"), strict=True))
    | dict(zip((*OFFSETS, *ANGLES), [f"M665 {w}" for w in "ABCDEH"], strict=True)),
    ROTARY: dict(zip((*SIDES, *DEPTHS), [f"M665 {w}" for w in "ABCDEIH"], strict=True)),
    MORGAN: dict(
        zip((*ARMS, *PLACE, *SCALING, *RATIOS), [f"M665 {w}" for w in "TPXYABED"], strict=True)
    )
    | dict(zip(TRIMS[:2], WORDS[:2], strict=True)),
}
HEIGHT = "M665 Z"  # sets the homing position of axis z of a linear Delta
LINE = re.compile(r"\s*([^\s#]+)[ \t]+([^\s#]+)")
ENDSTOP = re.compile(r"endstop\.(\w+)\.(axis|homing_direction|homing_position)")
LEVER_ASSUMED = (
    "the readings left and right are psi and theta, Smoothieware's beta and alpha. The crank that "
    "is parallel to the forearm has no length in the firmware: a fifth of arm1_length is assumed"
)
REVERSED = deltas.ANGLES_UP.format("Smoothieware")


def recognizes(path: Path) -> bool:
    """Whether a file states an arm solution; logs of other firmwares have the same ending."""
    return any((found := LINE.match(line)) and found[1] == SOLUTION for _, line in read_lines(path))


def configured(paths: Sequence[Path]) -> ConfiguredRobot:
    """Return the machine as configured."""
    stated = settings(paths)
    machine, remarks = kinematics(stated), stated.describe_unused()
    if isinstance(machine, MorganArms):
        model = new_model(machine.mechanism())
        return ConfiguredRobot(model, (LEVER_ASSUMED, *remarks))
    if isinstance(machine, Towers):
        return deltas.make_configured_robot(machine, np.zeros(3), remarks=remarks)
    model = new_model(machine.mechanism())
    return ConfiguredRobot(model, (deltas.NOT_STATED, REVERSED, *remarks), machine)


def settings(paths: Sequence[Path]) -> Settings:
    """Read the last value of each key of `config` and of each word of `config-override`; a file
    that `include` names is read at its place."""
    texts: dict[str, tuple[str, SourceLine]] = {}
    unread, remarks, included = list[str](), list[str](), list[Path]()

    def read(path: Path, opened: tuple[Path, ...]) -> None:
        for place, line in read_lines(path):
            if COMMAND.match(line):
                parse_settings_line(texts, place, line, CODES)
            elif found := LINE.match(line):
                if found[1] in OLD_TRIMS:
                    remarks.append(OLD_TRIM.format(place.path, place.line, found[1]))
                elif found[1] == "include":
                    include(place, found[2], path, opened)
                else:
                    texts[found[1]] = (found[2], place)

    def include(place: SourceLine, name: str, path: Path, opened: tuple[Path, ...]) -> None:
        inner = path.with_name(Path(name).name)  # on the card both lie in one folder
        if not inner.is_file():
            unread.append(name)
        elif inner in opened:
            raise place.error("include", name, "a file that does not include this one")
        else:
            included.append(inner)
            read(inner, (*opened, inner))

    for path in paths:
        if path not in included:
            read(path, (path,))
    return Settings(
        texts, [*paths, *(p for p in included if p not in paths)], tuple(unread), tuple(remarks)
    )


def kind(stated: Settings) -> tuple[str, ...]:
    """Return the names of the arm solution: LINEAR, ROTARY or MORGAN."""
    text, place = stated.text(SOLUTION, KINDS)
    for names in (LINEAR, ROTARY, MORGAN):
        if text in names:
            return names
    raise place.error(SOLUTION, text, KINDS)


def kinematics(stated: Settings) -> Delta | MorganArms:
    names = kind(stated)
    text, place = stated.text(HOMING[names], HOMED_BY_JOINTS)
    if not _is_true(text):
        raise place.error(HOMING[names], text, HOMED_BY_JOINTS)
    if names is MORGAN:
        return _arms(stated)
    return _towers(stated) if names is LINEAR else _shoulders(stated)


def scale(stated: Settings) -> Array | None:
    """Return the steps (3,) of the motors for 1 m of a carriage; None if one is not stated."""
    if any(where(stated, key) not in stated for key in STEPS):
        return None
    return np.array([_number(stated, key, "steps per mm", low=1e-3) / MM for key in STEPS])


def where(stated: Settings, key: str) -> str:
    """Return the field whose value counts for a key: that of a command, if one states it."""
    command = COMMANDS[kind(stated)].get(key, key)
    return command if command in stated else key


def _number(
    stated: Settings, key: str, expected: str, default: float | None = None, low: float = -1e4
) -> float:
    return stated.number(where(stated, key), expected, default, low)


def stop_field(stated: Settings, axis: int) -> str:
    """Return the field that states the position at which an axis (0 to 2) is homed.

    The newer keys `endstop.NAME....` count before those of the older syntax.
    """
    if axis == 2 and kind(stated) is LINEAR and HEIGHT in stated:
        return HEIGHT
    for field, (text, _) in stated.texts.items():
        found = ENDSTOP.fullmatch(field)
        if found and found[2] == "axis" and text.upper() == "XYZ"[axis]:
            direction = stated.texts.get(f"endstop.{found[1]}.homing_direction", ("none",))[0]
            if direction != "none":
                return f"endstop.{found[1]}.homing_position"
    to_max = stated.texts.get(f"{AXES[axis]}_homing_direction", ("",))[0] == "home_to_max"
    return f"{AXES[axis]}_{'max' if to_max else 'min'}"


def _homed(stated: Settings, axis: int, expected: str) -> float:
    """Return the position at which an axis is homed, with its offset of M206."""
    field, direction = stop_field(stated, axis), f"{AXES[axis]}_homing_direction"
    other = f"{AXES[axis]}_max"
    if field not in stated and field == f"{AXES[axis]}_min" and other in stated:
        words = f"home_to_max: otherwise the firmware homes to {field} and does not use {other}"
        stated.text(direction, words)
        raise stated.error(direction, words)
    position = stated.number(field, expected, None, -1e4)
    return position + stated.number(HOME_OFFSETS[axis], "a number", 0.0)


def motor_angles(stated: Settings) -> Array:
    """Return the directions (3,) of the motors, rad about z."""
    mirrored = MIRROR in stated and _is_true(stated.texts[MIRROR][0])
    return np.asarray(HANGING_ANGLES + (np.pi if mirrored else 0.0))


def radius_offsets(stated: Settings) -> Array:
    """Return how much further out (3,) m each tower is than arm_radius."""
    return np.array([_number(stated, key, "mm", 0.0) for key in OFFSETS]) * MM


def _is_true(text: str) -> bool:
    """Return whether the firmware takes a text for true."""
    return bool(set(text) & set("ty1"))


def _towers(stated: Settings) -> Towers:
    if "M665 F" in stated:
        raise stated.error("M665 F", "the angle of tower 3 as M665 H, which M500 writes")
    radius = _number(stated, "arm_radius", "the delta radius in mm", low=1.0)
    rod = _number(stated, "arm_length", "the rods' length in mm, more than arm_radius", low=radius)
    for axis in (0, 1):
        if _homed(stated, axis, "0, x and y of the nozzle when homed"):
            field = stop_field(stated, axis)
            field = HOME_OFFSETS[axis] if stated.number(field, "0") == 0 else field
            raise stated.error(field, "0: a Delta is homed on its axis")
    above = "the nozzle's height in mm when homed, more than 0"
    height = _homed(stated, 2, above)
    if height <= 0:
        raise stated.error(stop_field(stated, 2), above)
    trims = [_number(stated, key, "mm", 0.0) for key in TRIMS]
    return Towers.of(
        radius + radius_offsets(stated) / MM,
        np.full(3, rod),
        [_number(stated, key, "degrees", 0.0, -30) for key in ANGLES],
        height - np.array(trims),
        **deltas.count_steps(scale(stated)),
    )


def _shoulders(stated: Settings) -> Shoulders:
    e, f, rod, arm = (_number(stated, key, "a length in mm", low=0.0) for key in SIDES)
    top, below, tool = (_number(stated, key, "mm") for key in DEPTHS)
    angle = "degrees when homed, from -90 to 90"
    homed = np.array([_homed(stated, axis, angle) for axis in range(3)]) * DEGREE
    for axis in np.flatnonzero(abs(homed) > np.pi / 2)[:1]:
        raise stated.error(stop_field(stated, int(axis)), angle)
    same = np.ones(3)
    hung = Shoulders(
        SIDE * (f - e) * MM,
        (top - below - tool) * MM * same,
        arm * MM * same,
        rod * MM * same,
        motor_angles(stated),
    )
    limits = tuple((-np.pi / 2, -float(angle)) for angle in homed)
    short = stated.error(
        where(stated, "delta_re"), "mm, long enough for the middle of the workspace"
    )
    return deltas.place_below(replace(hung, limits=limits), -homed - deltas.BELOW_HOMED, short)


def _arms(stated: Settings) -> MorganArms:
    if REAL_SCARA in stated and _is_true(stated.texts[REAL_SCARA][0]):
        raise stated.error(REAL_SCARA, "false: two arms on one axis; a serial SCARA is `serial`")
    arms = np.array([_number(stated, key, "a length in mm", low=1.0) for key in ARMS]) * MM
    place = np.array([_number(stated, key, "mm") for key in PLACE]) * MM
    for key in SCALING:
        if _number(stated, key, "1", 1.0) != 1:
            raise stated.error(where(stated, key), "1: a calibration gives the arms their lengths")
    high, low = (_number(stated, key, "a cosine from 0 to 1", 0.95, 0.0) for key in RATIOS)
    machine = MorganArms(arms, place, np.zeros(2), (high, -low))
    at = [_homed(stated, axis, "x or y of the nozzle in mm when homed") for axis in (0, 1)]
    ideal = home_angles(machine, at)
    if np.isnan(ideal).any():
        raise stated.error(where(stated, ARMS[0]), "mm: arms that reach the homing position")
    trims = np.array([_number(stated, key, "degrees", 0.0) for key in TRIMS[:2]]) * DEGREE
    return replace(machine, homed=ideal - trims)


def home_angles(machine: MorganArms, at: Sequence[float]) -> Array:
    """Return theta and psi (2,) rad with the nozzle at a homing position (2,) in mm."""
    return machine.joints(np.array([[at[0], at[1], 0.0]]) * MM)[0]
