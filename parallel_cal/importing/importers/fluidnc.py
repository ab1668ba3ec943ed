"""FluidNC: the configuration (`config.yaml`) of a ParallelDelta or a WallPlotter, and Maslow's with
the log of its calibration.

A ParallelDelta (`parallel_delta:`) has equal chains and counts its angles down from the horizontal.
Its sizes are sides of triangles, as in grblHAL. When homed, all arms are at up_degrees, and the
position is then mpos_mm. Source: bdring/FluidNC e952f33f, FluidNC/src/Kinematics/ParallelDelta.cpp
(group, motors_to_cartesian, set_homed_mpos) and .h (defaults); importing/wall_lines.py for the
others, whose numbers have no range. The keys before release 4.0: ParallelDelta.cpp in 049719e2.

A Maslow (version 4) pulls its four belts tight at each waypoint of a calibration and lists them as
`CLBM:[{bl:2960.58, br:3150.08, tr:3067.72, tl:3049.85},...]`: lengths in the plane from the anchors
to the middle of the sled, mm. Two belts more than it needs determine the anchors. Source:
BarbourSmith/FluidNC 10d7de0b, FluidNC/src/Maslow/Maslow.cpp (measurementToXYPlane,
print_calibration_data).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.units import DEGREE, MM
from parallel_cal.importing import deltas
from parallel_cal.importing.controller_files import ConfiguredRobot
from parallel_cal.importing.deltas import HANGING_ANGLES, SIDE, Shoulders
from parallel_cal.importing.settings import Settings, SourceLine, read_lines, sha256
from parallel_cal.importing.wall_lines import MaslowBelts, PlotterLines
from parallel_cal.model.machine_class import MachineClass
from parallel_cal.model.model import new_model
from parallel_cal.recordings.dataset import Dataset

CONFIGURATION = (".yaml", ".yml")
MACHINE_CLASS: MachineClass = "hobby"  # belts, printed parts, open loop
LINE = re.compile(r"(\s*)([\w/-]+)\s*:\s*([^#]*)")
TAB = re.compile(r" *\t")
DELTA, PLOTTER = "kinematics/parallel_delta", "kinematics/wallplotter"
# What its source and documents call it, but not what the firmware reads.
MISNAMED, NAME = (
    "kinematics/paralleldelta/",
    "the section parallel_delta: the firmware has no other",
)
EFFECTOR_MM = 86.603  # the firmware's default
SIZES = ("crank_mm", "linkage_mm", "base_triangle_mm", "end_effector_triangle_mm")
UP, UP_DEGREES = f"{DELTA}/up_degrees", -30.0
# The firmware takes the nearer end of the range for a number outside.
RANGES = {f"{DELTA}/{key}": (20.0, 500.0) for key in SIZES}
RANGES |= {f"{DELTA}/crank_mm": (50.0, 500.0), UP: (-90.0, 0.0)}
BEFORE_4_0 = tuple(f"{DELTA}/{key}" for key in ("homing_mpos_radians", "soft_limits", "max_z_mm"))
KEYS_OF_4_0 = (
    "the keys of FluidNC 4.0, which has none of this name: the origin of earlier releases is on "
    "the motors' axes, and they are not read. Update the firmware, delete the key, and state "
    "up_degrees (degrees) and mpos_mm"
)
HOMED_AT = tuple(f"axes/{axis}/homing/mpos_mm" for axis in "xyz")
ANCHORS = ("left_anchor_x", "left_anchor_y", "right_anchor_x", "right_anchor_y")
CORNERS = tuple(f"/maslow_{corner}{axis}" for corner in ("tl", "tr", "bl", "br") for axis in "xy")
# From the end of a belt to its arm, and from there to the middle of the sled.
EXTENSION, ARM = "/maslow_beltendextension", "/maslow_armlength"
EXTENSION_MM, ARM_MM = 30.0, 123.4
KINDS = "parallel_delta, WallPlotter, or the anchors Maslow_tlX ... Maslow_brY"
REVERSED = deltas.ANGLES_UP.format("FluidNC")
LEFT_IS_REVERSED = (
    "the model's readings are the lengths of the left and the right line that are let out from the "
    "origin; FluidNC's motor of the left line counts the other way (factor: -1 in a column map)"
)
IN_THE_PLANE = (
    "the model's readings are lengths of belt in the plane: sqrt(belt^2 - height^2), with the "
    "height Maslow_tlZ ... + z of each belt. They are those of the belts {}, in this order"
)
BELTS = "tl, tr, bl, br"
WAYPOINT = re.compile(r"\{([^{}]*)\}")
NO_WAYPOINTS = (
    "{}: no waypoints, expected lines 'CLBM:[{{bl:2960.58, br:3150.08, tr:3067.72, tl:3049.85}},"
    "...]' of a calibration, as the serial log of the web page has them"
)


def samples(paths: Sequence[Path]) -> Dataset:
    """Read the belts at the waypoints of a calibration, and where a belt is measured from.

    A log lists waypoints again as the calibration goes on; equal ones are taken once.
    """
    setups = [path for path in paths if path.suffix.lower() in CONFIGURATION]
    logs = [path for path in paths if path not in setups]
    offset, found = read_belt_offset(_read(setups)), list[tuple[float, ...]]()
    for path in logs:
        for place, line in read_lines(path):
            if "CLBM:" in line:
                found += [_belts(place, each) for each in WAYPOINT.findall(line)]
    if not found:
        raise DatasetError(NO_WAYPOINTS.format(", ".join(map(str, logs or paths))))
    q = np.array([*dict.fromkeys(found)]) * MM - offset
    return Dataset.from_arrays(
        [f"line{i}" for i in range(1, 5)],
        q,
        np.zeros((len(q), 3)),
        measured=np.zeros(6, bool),
        source=", ".join(map(str, paths)),
        sha256=sha256(paths),
        joint_units=("m",) * 4,
    )


def _belts(place: SourceLine, text: str) -> tuple[float, ...]:
    """Return the belts (4,) mm of a waypoint, in the order of BELTS."""
    words = dict(re.findall(r"(\w+)\s*:\s*([^,\s]+)", text))
    names = BELTS.split(", ")
    if {*words} != {*names}:
        raise place.error("a waypoint", text, f"the four belts {BELTS}")
    expected = "a length in mm, more than 0"
    return tuple(place.number(name, words[name], expected, 1.0, 1e5) for name in names)


def read_belt_offset(stated: Settings) -> float:
    """Return how far (m) the end of a belt is from the middle of the sled."""
    return (stated.number(EXTENSION, "mm", EXTENSION_MM) + stated.number(ARM, "mm", ARM_MM)) * MM


def recognizes(path: Path) -> bool:
    """Whether a file has the kinematics of FluidNC; other YAML files have the same ending."""
    stated = _read([path])
    return any(field.startswith(("kinematics/", "/maslow_tl")) for field in stated.texts)


def configured(paths: Sequence[Path]) -> ConfiguredRobot:
    """Return the machine as configured."""
    stated = settings(paths)
    machine = kinematics(stated)
    if isinstance(machine, PlotterLines):
        return ConfiguredRobot(machine.model(), (LEFT_IS_REVERSED, *stated.describe_unused()))
    if isinstance(machine, MaslowBelts):
        remarks = [IN_THE_PLANE.format(BELTS), *stated.describe_unused()]
        return ConfiguredRobot(machine.model(), tuple(remarks))
    remarks = [deltas.NOT_STATED, REVERSED]
    if any(stated.number(field, "mm", 0.0) for field in HOMED_AT[:2]):
        remarks.append(f"x and y of the model count from the motors' axis, without {HOMED_AT[0]}")
    remarks += stated.describe_unused()
    return ConfiguredRobot(new_model(machine.mechanism()), tuple(remarks), machine)


def settings(paths: Sequence[Path]) -> Settings:
    """Read the configuration; DatasetError for tabs, at which the firmware stops."""
    for place, line in (each for path in paths for each in read_lines(path)):
        if TAB.match(line):
            raise place.error("the indentation", line.replace("\t", "\\t"), "spaces, no tabs")
    return _read(paths)


def _read(paths: Sequence[Path]) -> Settings:
    """Read `key: value` by the sections and the key in lower case, such as `axes/x/steps_per_mm`
    or, without a section, `/board`. The last of two equal ones counts."""
    texts: dict[str, tuple[str, SourceLine]] = {}
    for path in paths:
        sections: list[tuple[int, str]] = []
        for place, line in read_lines(path):
            if not (found := LINE.match(line)):
                continue
            indent, key, text = len(found[1]), found[2].lower(), found[3].strip()
            sections = [each for each in sections if each[0] < indent]
            if text:
                field = "/".join(name for _, name in sections) + f"/{key}"
                texts[field] = (text, place)
            else:
                sections.append((indent, key))
    return Settings(texts, paths)


def kinematics(stated: Settings) -> Shoulders | PlotterLines | MaslowBelts:
    """Return the machine that a configuration describes."""
    for field in (field for field in stated.texts if field.startswith(MISNAMED)):
        raise stated.error(field, NAME)
    if any(field.startswith(f"{DELTA}/") for field in stated.texts):
        return _shoulders(stated)
    if any(field.startswith(f"{PLOTTER}/") for field in stated.texts):
        places = [stated.number(f"{PLOTTER}/{key}", "mm") for key in ANCHORS]
        anchors = np.array(places).reshape(2, 2) * MM
        if anchors[0, 0] >= anchors[1, 0]:
            raise stated.error(f"{PLOTTER}/left_anchor_x", "mm, left of the right anchor")
        return PlotterLines(anchors)
    stated.text(CORNERS[0], KINDS)
    corners = np.array([stated.number(key, "mm") for key in CORNERS]).reshape(4, 2) * MM
    return MaslowBelts(corners, read_belt_offset(stated))


def _shoulders(stated: Settings) -> Shoulders:
    for field in (field for field in BEFORE_4_0 if field in stated):
        raise stated.error(field, KEYS_OF_4_0)
    arm, rod, base, effector = (
        _ranged(stated, f"{DELTA}/{key}", "a length in mm") * MM for key in SIZES
    )
    up = _ranged(stated, UP, "degrees", UP_DEGREES)
    same, homed = np.ones(3), np.full(3, -up * DEGREE)
    limits = ((-np.pi / 2, float(homed[0])),) * 3
    hung = Shoulders(SIDE * (base - effector), 0 * same, arm * same, rod * same, HANGING_ANGLES)
    hung = replace(hung, limits=limits)
    at = stated.number(HOMED_AT[2], "mm", 0.0) * MM
    above = deltas.heights_on_axis(hung, homed)[0]
    short = stated.error(f"{DELTA}/linkage_mm", "mm that reach the axis of the motors")
    if np.isnan(above):
        raise short
    hung = replace(hung, heights=hung.heights + at - above)
    return deltas.place_below(hung, homed - deltas.BELOW_HOMED, short)


def _ranged(stated: Settings, field: str, unit: str, default: float | None = None) -> float:
    low, high = RANGES[field]
    return stated.number(field, f"{unit} from {low:g} to {high:g}", default, low, high)
