"""LinuxCNC: a probe log of a linear Delta, and the files that configure its own kinematics.

Its own kinematics are lineardeltakins, rotarydeltakins, genhexkins, pentakins and tripodkins. Their
pins are set in a HAL file; the .ini file has their unit (LINEAR_UNITS), where the joints are homed
(HOME_OFFSET: the position of a joint at its switch), their range (MIN_LIMIT, MAX_LIMIT), their
counts or steps per unit (SCALE), and the range of the end point ([AXIS_Z] MIN_LIMIT).

A log that (PROBEOPEN) opened contains X Y Z A B C U V W of each touch, one touch per line, in the
program's coordinates and units. So no offsets may be active while probing. Sources: LinuxCNC
documentation, "G-codes" (G38.x, Probe Logging), "Kinematics", "INI configuration" and the manual
pages lineardeltakins(9) and kins(9).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import DatasetError, ModelError
from parallel_cal.base.units import DEGREE, MM, UNITS
from parallel_cal.importing import deltas, sections
from parallel_cal.importing.cnc_travel import HOMED, strut_limits, with_arm_travel, with_rails
from parallel_cal.importing.controller_files import ConfiguredRobot
from parallel_cal.importing.deltas import Shoulders, Towers
from parallel_cal.importing.settings import Settings, SourceLine, read_lines
from parallel_cal.importing.struts import CLOSED_M, Hexapod, Pentapod, Struts, Tripod
from parallel_cal.importing.touch_samples import make_printed_ends, make_touch_samples
from parallel_cal.model.model import new_model
from parallel_cal.recordings.dataset import Dataset

CONFIGURATION = (".hal", ".ini")
AXES = "XYZABCUVW"
KINS, HEXAPOD, ROTARY = "lineardeltakins.", "genhexkins", "rotarydeltakins"
PENTAPOD, TRIPOD = "pentakins", "tripodkins"
ANY = f"pins of {HEXAPOD}, {PENTAPOD}, {TRIPOD}, lineardeltakins or {ROTARY}"
TRIPOD_PINS = {(1, 0): f"{TRIPOD}.Bx", (2, 0): f"{TRIPOD}.Cx", (2, 1): f"{TRIPOD}.Cy"}
ROTARY_PINS = {"platformradius": "R", "thighlength": "U", "shinlength": "L", "footradius": "E"}
HOME = "[JOINT_{}] HOME"  # where the joint goes when it is homed
SCALE = "[JOINT_{}] SCALE"  # counts or steps per unit of the joint's position
UNIT = "[TRAJ] LINEAR_UNITS"
LINEAR_UNITS = {"mm": "mm", "metric": "mm", "inch": "in", "in": "in", "imperial": "in"}
INI_VALUE = re.compile(r"\[(\w+)\]\(?(\w+)\)?")  # in a .hal file
BEYOND_LIMITS = (
    "at HOME a strut is outside MIN_LIMIT and MAX_LIMIT: the robot cannot have its home pose "
    "at these lengths; correct the joint limits or home in the model file"
)
NO_HOME = (
    "struts of the lengths {} and so on do not meet near X0 Y0 Z0 A0 B0, so home of the model is "
    "there, where they are {} long: correct HOME or the pins, if one of them is wrong"
)
OFFSETS = (f"{HEXAPOD}.spindle-offset", f"{HEXAPOD}.tool-offset", f"{PENTAPOD}.tool-offset")
NO_PROBE = np.zeros(3)


def samples(
    paths: Sequence[Path],
    unit: str,
    step: float = 1e-6,
    printed_x: Sequence[float] = (),
    printed_y: Sequence[float] = (),
) -> Dataset:
    """Read the touches of logs, with a .hal file, both in `unit`; `step` (m) is a motor's step."""
    logs = [path for path in paths if path.suffix not in CONFIGURATION]
    if unit not in ("m", "mm", "in"):
        raise DatasetError(f"unit={unit}: expected mm, in or m, the unit of the program")
    delta = towers(settings([path for path in paths if path not in logs]), unit)
    nozzle, places = [], []
    for path in logs:
        for place, line in read_lines(path):
            if words := line.split():
                if len(words) != len(AXES):
                    raise place.error("the line", line.strip(), f"nine numbers: {' '.join(AXES)}")
                axes = [
                    place.number(axis, word, "a number", -1e6, 1e6)
                    for axis, word in zip(AXES, words, strict=True)
                ]
                nozzle.append(np.array(axes[:3]) * UNITS[unit])
                places.append(place)
    printed = make_printed_ends(delta, printed_x, printed_y)
    return make_touch_samples(delta, nozzle, places, paths, step, printed=printed)


def configured(paths: Sequence[Path]) -> ConfiguredRobot:
    """Return the machine that the pins of LinuxCNC's own kinematics describe."""
    stated = settings(paths)
    remarks = list[str]()
    if UNIT not in stated:
        remarks.append("no LINEAR_UNITS (the .ini file): lengths are assumed to be in mm")
    machine = kinematics(stated)
    unit = length_unit(stated)
    if isinstance(machine, Towers):
        rails, more = with_rails(machine, stated, unit)
        bed = rails.box.low[2] if rails.box else 0.0
        remarks += [*more, *stated.describe_unused()]
        found = deltas.make_configured_robot(rails, NO_PROBE, remarks=remarks, bed=bed)
        if not bed:
            return found
        anywhere = {"probe.plate.z": float(np.ptp(found.model.mechanism.joint_limits))}
        return replace(found, model=replace(found.model, tolerances=anywhere))
    if isinstance(machine, Shoulders):
        arms, more = with_arm_travel(machine, stated, unit, _short_shins(stated))
        remarks += [*more, deltas.ANGLES_UP.format("LinuxCNC"), *stated.describe_unused()]
        return ConfiguredRobot(new_model(arms.mechanism()), (deltas.NOT_STATED, *remarks), arms)
    if stated.number(f"{HEXAPOD}.screw-lead", "a length", 0.0):
        remarks.append(f"{HEXAPOD}.screw-lead: the correction of the struts' lengths is not used")
    for pin in OFFSETS:
        if stated.number(pin, "a length", 0.0):
            remarks.append(f"{pin} is not used: poses in the model are those with {pin} 0")
    home = _joints_at(stated, HOME, len(machine.base), unit, machine.switches)
    shortest = (HOME if HOME.format(0) in stated else HOMED).format(int(home.argmin()))
    if (home <= 0).any():
        raise stated.error(shortest, "the length of a strut, more than 0")
    limits, more = strut_limits(stated, home, machine.switches, unit)
    remarks += more
    try:
        mechanism = machine.mechanism(home, limits)
    except ModelError as error:
        raise stated.error(shortest, f"lengths at which the struts meet: {error}") from None
    at_home = np.array(mechanism.home.joints)
    if isinstance(machine, Pentapod) and np.abs(at_home - home).max() > CLOSED_M:
        at = ", ".join(f"{length / unit:.4f}" for length in at_home)
        remarks.append(NO_HOME.format(HOME.format(0), at))
    if ((at_home < limits[:, 0]) | (at_home > limits[:, 1])).any():
        remarks.append(BEYOND_LIMITS)
    return ConfiguredRobot(new_model(mechanism), (*remarks, *stated.describe_unused()))


def length_unit(stated: Settings) -> float:
    """Return what a length of 1 is in m: LINEAR_UNITS in the .ini file, or else mm."""
    if UNIT not in stated:
        return MM
    text, place = stated.text(UNIT, "")
    if text.lower() not in LINEAR_UNITS:
        raise place.error(UNIT, text, f"one of {', '.join(LINEAR_UNITS)}")
    return UNITS[LINEAR_UNITS[text.lower()]]


def kinematics(stated: Settings) -> Towers | Shoulders | Struts:
    """Return the kinematics whose pins are set."""
    unit = length_unit(stated)
    if f"{KINS}R" in stated:
        return towers(stated, "in" if unit == UNITS["in"] else "mm")

    def pin(name: str, low: float = -1e5) -> float:
        return stated.number(name, f"setp {name}, a length", None, low, 1e5) * unit

    if f"{ROTARY}.thighlength" in stated:
        size = {short: pin(f"{ROTARY}.{name}", 0.0) for name, short in ROTARY_PINS.items()}
        radius, homed = size["R"] - size["E"], 0.0 - _joints_at(stated, HOMED, 3, DEGREE)
        return deltas.hang_shoulders(radius, size["U"], size["L"], homed, _short_shins(stated))
    if any(field.startswith(f"{TRIPOD}.") for field in stated.texts):
        return _tripod(stated, unit)
    pentapod = any(field.startswith(f"{PENTAPOD}.") for field in stated.texts)
    name = PENTAPOD if pentapod else HEXAPOD
    stated.text(f"{name}.base.0.x", "setp, a length" if pentapod else ANY)
    n = 5 if name == PENTAPOD else 6

    def ends(which: str, axes: str) -> np.ndarray:
        return np.array([[pin(f"{name}.{which}.{k}.{a}") for a in axes] for k in range(n)])

    base, homed, scale = ends("base", "xyz"), _joints_at(stated, HOMED, n, unit), _scale(stated, n)
    scale = None if scale is None else scale / unit
    if name == HEXAPOD:
        return Hexapod(base, homed, scale, ends("platform", "xyz"))
    radii, heights = ends("effector", "rz").T
    return Pentapod(base, homed, scale, radii, heights)


def _tripod(stated: Settings, unit: float) -> Tripod:
    base = np.zeros((3, 3))
    for (row, column), field in TRIPOD_PINS.items():
        base[row, column] = stated.number(field, "setp, a length", None, -1e5, 1e5) * unit
    for i, field in ((0, f"{TRIPOD}.Bx"), (1, f"{TRIPOD}.Cy")):
        if not base[1 + i, i]:
            raise stated.error(field, "a length other than 0: three base points not on one line")
    scale = _scale(stated, 3)
    return Tripod(base, _joints_at(stated, HOMED, 3, unit), None if scale is None else scale / unit)


def _short_shins(stated: Settings) -> DatasetError:
    return stated.error(f"{ROTARY}.shinlength", "a length that reaches the middle")


def _scale(stated: Settings, n: int) -> np.ndarray | None:
    """Return SCALE of the joints (n,), counts per unit, or None if a joint has none."""
    fields = [SCALE.format(i) for i in range(n)]
    if not all(field in stated for field in fields):
        return None
    scale = np.array([stated.number(field, "counts per unit of the joint") for field in fields])
    for field in (fields[int(i)] for i in np.flatnonzero(scale == 0)):
        raise stated.error(field, "counts per unit of the joint, not 0")
    return scale


def _joints_at(
    stated: Settings, field: str, n: int, unit: float, default: np.ndarray | None = None
) -> np.ndarray:
    """Return a position of each joint (n,) in the .ini file, in m or rad."""
    usual = np.zeros(n) if default is None else default / unit
    expected = "a position of the joint, in the unit of LINEAR_UNITS or degrees"
    values = [stated.number(field.format(i), expected, float(usual[i])) for i in range(n)]
    return np.array(values) * unit


def towers(stated: Settings, unit: str) -> Towers:
    """Return the Delta of lineardeltakins: R, L, J0off, J1off, J2off, and HOME_OFFSET in the .ini.

    Joint 0 stands along y. LinuxCNC takes 0 for a HOME_OFFSET that the .ini does not state. Without
    the .ini, a carriage is assumed to be homed three rods above z = 0.
    """
    size = UNITS[unit]
    radius = stated.number(f"{KINS}R", f"setp, the radius in {unit}", low=1e-3) * size
    expected = f"setp, the rods' length in {unit}, more than R"
    rods = np.full(3, stated.number(f"{KINS}L", expected, low=radius / size) * size)
    zero = [stated.number(f"{KINS}J{i}off", unit, 0.0) * size for i in range(3)]
    has_joints = any(field.startswith("[JOINT_0]") for field in stated.texts)
    top = 0.0 if has_joints else 3 * rods[0] / size
    tops = [stated.number(HOMED.format(i), unit, top) for i in range(3)]
    return Towers(
        np.full(3, radius),
        rods,
        np.zeros(3),
        np.array(tops) * size,
        first=90 * DEGREE,
        zero=(zero[0], zero[1], zero[2]),
    )


def settings(paths: Sequence[Path]) -> Settings:
    """Read the values of pins in .hal files by name, and of .ini files by `[section] key`.

    A pin's value comes from `setp`, or from `sets` of the signal that `net` connects to it. A value
    such as `[MACHINE]RADIUS` is that of the .ini file. Versions before 2.8 call a joint an axis.
    `source FILE` is read at its place, relative to the file with it.
    """
    setups = [path for path in paths if path.suffix == ".ini"]
    setup = sections.settings(setups)
    stated = setup.texts
    texts = {re.sub(r"^\[AXIS_(?=\d)", "[JOINT_", field): value for field, value in stated.items()}
    texts |= stated
    signals: dict[str, tuple[str, SourceLine]] = {}
    nets: dict[str, str] = {}
    read, unread = list[Path](), [*setup.unread]
    for path in paths:
        for place, line in () if path in (*setups, *read) else _hal_lines(path, read, unread):
            if found := re.match(r"\s*(setp|sets)\s+([\w.-]+)\s*=?\s*([^\s#]*)", line):
                named = INI_VALUE.fullmatch(found[3])
                value = stated.get(f"[{named[1]}] {named[2]}") if named else None
                into = texts if found[1] == "setp" else signals
                into[found[2]] = value or (found[3], place)
            elif found := re.match(r"\s*net\s+([\w.-]+)([^#]*)", line):
                nets |= dict.fromkeys(found[2].split(), found[1])
    connected = {pin: signals[name] for pin, name in nets.items() if name in signals}
    included = [path for path in (*setup.paths, *read) if path not in paths]
    return Settings(connected | texts, [*paths, *included], tuple(unread))


def _hal_lines(path: Path, read: list[Path], unread: list[str]) -> Iterator[tuple[SourceLine, str]]:
    """Yield the lines of a .hal file, and at its place those of each file that it runs."""
    read.append(path)
    for place, line in read_lines(path):
        found = re.match(r"\s*source\s+([^\s#]+)", line)
        file = path.parent / Path(found[1]).expanduser() if found else None
        if not found or not file:
            yield place, line
        elif not file.is_file():
            unread.append(found[1])
        elif file not in read:
            yield from _hal_lines(file, read, unread)
