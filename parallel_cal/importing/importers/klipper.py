"""Klipper: `printer.cfg` of linear and rotary Deltas, with the results of DELTA_CALIBRATE, of
deltesian printers and of cable winches.

A stored position counts a motor's steps from its end-stop, so it stays valid if the configuration
changes. A stored height is the nozzle's height above the bed at this position. Sources: Klipper
documentation, "Configuration reference", "Delta calibration", "Rotation distance".
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.units import DEGREE, MM
from parallel_cal.importing import deltas
from parallel_cal.importing.controller_files import ConfiguredRobot
from parallel_cal.importing.deltas import Delta, Shoulders, Towers, are_counter_clockwise
from parallel_cal.importing.deltesian import MIN_ANGLE, DeltesianArms
from parallel_cal.importing.drives import make_drive
from parallel_cal.importing.klipper_config import settings
from parallel_cal.importing.klipper_mesh import DEFAULT, choose_mesh, read_mesh
from parallel_cal.importing.settings import Settings
from parallel_cal.importing.touch_samples import (
    PrintedEnds,
    find_visits,
    join_ends,
    make_joint_samples,
    make_printed_ends,
)
from parallel_cal.importing.winches import Winches
from parallel_cal.model.drive import Drive
from parallel_cal.model.machine_class import MachineClass
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_sensor
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.recording import Array
from parallel_cal.recordings.samples import READING

CONFIGURATION = (".cfg",)
MACHINE_CLASS: MachineClass = "hobby"  # belts, printed parts, open loop
TOUCHES = "[delta_calibrate]"
STEPPERS = [f"[stepper_{a}]" for a in "abc"]
ROTATION_DISTANCE, GEAR_RATIO = "rotation_distance", "gear_ratio"
STEP_DISTANCE = "step_distance"
# The bed is near 0; a block on it may be of any height that a printer reaches.
MAX_HEIGHTS_MM = {"height": 50.0, "manual_height": 500.0}
LINEAR_OR_ROTARY = ("delta", "rotary_delta")
KINDS = " or ".join(LINEAR_OR_ROTARY)
KINEMATICS, DELTESIAN, WINCH = "[printer] kinematics", "deltesian", "winch"
LINES = [f"[stepper_{chr(code)}]" for code in range(ord("a"), ord("z") + 1)]
MIN_LINES, ANCHOR = 3, "{} anchor_{}"
SIDES = [f"[stepper_{side}]" for side in ("left", "right")]
BED = "[stepper_y]"
ENDSTOP, BED_RANGE = f"{BED} position_endstop", (f"{BED} position_min", f"{BED} position_max")
WIDTH = "[printer] print_width"
HEIGHT_EXPECTED = "the nozzle's height in mm, 0 or more"  # the low end of Klipper's range
LEANS_NOT_STATED = (
    "the leans of the rails and the direction of the bed have no number in the firmware: they have "
    "the mechanism's nominal values"
)
TOWERS, SHOULDERS = (210.0, 330.0, 90.0), (30.0, 150.0, 270.0)  # degrees, the defaults


def samples(
    paths: Sequence[Path],
    printed_x: Sequence[float] = (),
    printed_y: Sequence[float] = (),
    mesh: str = DEFAULT,
) -> Dataset:
    """Read the heights and the distances of [delta_calibrate], and the touches of a bed `mesh`.

    Manual heights are not used if the probe has an offset. A warning says so.
    """
    stated = settings(paths)
    machine, step = delta(stated), _steps(stated)
    found, heights, warnings = [], [], list[str]()
    for name, limit in MAX_HEIGHTS_MM.items():
        if (
            name == "manual_height"
            and bool(np.any(_probe(stated)))
            and f"{TOUCHES} {name}0" in stated
        ):
            warnings.append("manual heights are heights of the nozzle, not of the probe: not used")
            continue
        for k in range(_count(stated, name, "height", warnings)):
            within = f"the nozzle's height in mm, from {-limit:g} to {limit:g}"
            height = stated.number(f"{TOUCHES} {name}{k}", within, None, -limit, limit)
            heights.append(height * MM)
            found.append(machine.homed - _stable(stated, f"{TOUCHES} {name}{k}_pos") * step)
    numbers = deltas.end_stops(machine)
    if (used := choose_mesh(stated, mesh, bool(found), warnings)) is not None:
        height = stated.number(f"{_kind_of_probe(stated)} z_offset", "mm", 0.0) * MM
        nozzle = read_mesh(stated, used, _probe(stated) + [0.0, 0.0, height])
        q = machine.joints(nozzle)
        if np.isnan(q).any():
            raise stated.error(f"[bed_mesh {used}] points", "points within reach of the rods")
        found += [*q]
        heights += [height] * len(q)
        # Its positions depend on every number of the configuration.
        numbers |= {key: float(number) for key, number in machine.nominal.items()}
    if not found:
        stated.text(f"{TOUCHES} height0", "what DELTA_CALIBRATE and SAVE_CONFIG store")
    parts = _read_parts(stated, warnings)
    printed = join_ends(
        [make_printed_ends(machine, printed_x, printed_y), *([parts.ends] if parts else [])]
    )
    q = np.array(found)
    visits = find_visits(machine, q, step)
    touched = make_joint_samples(
        machine,
        q,
        np.array(heights),
        paths,
        step,
        visits,
        warnings=[*stated.describe_unused(), *warnings],
        printed=printed,
    )
    return replace(touched, configuration=numbers)


def _count(stated: Settings, name: str, what: str, warnings: list[str]) -> int:
    """Return how many of `height0`, `height1`, ... Klipper reads; it stops where one is missing."""
    read = next(k for k in itertools.count() if f"{TOUCHES} {name}{k}" not in stated)
    numbered = re.compile(re.escape(f"{TOUCHES} {name}") + r"\d+")
    if more := len([field for field in stated.texts if numbered.fullmatch(field)]) - read:
        warnings.append(
            f"{name}{read} is missing: like Klipper, this import stops there, and omits "
            f"{more} {what}{'s' if more > 1 else ''} behind it"
        )
    return read


def _stable(stated: Settings, field: str) -> Array:
    """Return the steps (3,) of the motors from their end-stops."""
    text, place = stated.text(field, "steps of motors a, b, c from their end-stops")
    words = text.split(",")
    if len(words) != 3:
        raise place.error(field, text, "three numbers of steps")
    return np.array([place.number(field, word, "three numbers of steps") for word in words])


@dataclass(frozen=True)
class _Parts:
    """Distances of printed parts: joints at their ends with readings, and their directions."""

    ends: PrintedEnds
    directions: tuple[float, ...]


def _read_parts(stated: Settings, warnings: list[str]) -> _Parts | None:
    """Return the distances that DELTA_ANALYZE stored; None if there are none.

    Directions and middles are those of the nozzle as the printer is configured.
    """
    n = _count(stated, "distance", "distance", warnings)
    if not n:
        return None
    machine, step = delta(stated), _steps(stated)
    fields = [f"{TOUCHES} distance{k}" for k in range(n)]
    measured = np.array([stated.number(f, "mm above 0", None, 1e-3) * MM for f in fields])
    places = [f"{field}_pos{end}" for field in fields for end in (1, 2)]
    q = np.array([machine.homed - _stable(stated, place) * step for place in places])
    at = deltas.compute_positions(machine, q, np.zeros_like(q))
    for k in np.flatnonzero(np.isnan(at).any(axis=1))[:1]:
        raise stated.error(
            places[k],
            "steps at which the configured rods meet: if the steppers were exchanged or geared "
            "otherwise, delete the distances, or measure them again",
        )
    first, second = at[::2, :2], at[1::2, :2]
    across = second - first
    angles = np.arctan2(across[:, 1], across[:, 0])
    middle = np.einsum(
        "ni,ni->n", (first + second) / 2, np.column_stack([np.cos(angles), np.sin(angles)])
    )
    readings = {}
    for k, (length, centre) in enumerate(zip(measured, middle, strict=True)):
        column = readings[f"{READING}distance{k}"] = np.full(len(q), np.nan)
        column[2 * k : 2 * k + 2] = centre - length / 2, centre + length / 2
    return _Parts(PrintedEnds(q, readings), tuple(map(float, angles)))


def configured(paths: Sequence[Path]) -> ConfiguredRobot:
    """Return the printer as configured, with the drives of its carriages or lines."""
    stated = settings(paths)
    printer = kinematics(stated)
    found = _make_robot(stated, printer)
    if not isinstance(printer, Shoulders):
        found.model.mechanism.drives = _read_drives(stated, printer)
    return found


def _make_robot(stated: Settings, printer: Delta | DeltesianArms | Winches) -> ConfiguredRobot:
    """Return a printer with its sensors, and what its configuration does not state."""
    probe = _probe(stated)
    parts = _read_parts(stated, []) if isinstance(printer, (Towers, Shoulders)) else None
    remarks = [*_describe_missing_steps(stated, printer), *stated.describe_unused()]
    if isinstance(printer, DeltesianArms):
        return ConfiguredRobot(new_model(printer.mechanism()), (LEANS_NOT_STATED, *remarks))
    if isinstance(printer, Winches):
        try:
            lines = printer.model()
        except ModelError as error:
            raise stated.error(ANCHOR.format(LINES[0], "x"), f"other anchors: {error}") from None
        return ConfiguredRobot(lines, (*printer.describe_mirror(), *remarks))
    if isinstance(printer, Shoulders):
        deltas.check_reach(printer, stated, "[printer] shoulder_height")
    found = deltas.make_configured_robot(printer, probe, remarks=remarks)
    if parts is None:
        return found
    sensor = load_sensor("distances", directions=parts.directions)
    return replace(found, model=found.model.with_sensors((*found.model.sensors, sensor)))


def _describe_missing_steps(
    stated: Settings, printer: Delta | DeltesianArms | Winches
) -> list[str]:
    """Name steppers without the length of a step, without which Klipper does not start."""
    steppers = _list_steppers(printer)
    key = GEAR_RATIO if isinstance(printer, Shoulders) else ROTATION_DISTANCE
    fields = [
        f"{stepper} {key}" for stepper in steppers if f"{stepper} {STEP_DISTANCE}" not in stated
    ]
    missing = ", ".join(field for field in fields if field not in stated)
    return [f"Klipper does not start without {missing}; the model does not need it"] * bool(missing)


def _list_steppers(printer: Delta | DeltesianArms | Winches) -> list[str]:
    """Return the sections of the steppers in the order of the joints."""
    if isinstance(printer, Winches):
        return LINES[: len(printer.anchors)]
    return [*SIDES, BED] if isinstance(printer, DeltesianArms) else STEPPERS


def _read_drives(
    stated: Settings, printer: Delta | DeltesianArms | Winches
) -> tuple[Drive | None, ...]:
    """Return the drives of carriages or lines, None where the configuration states no turn.

    A rotation_distance is the travel per turn of the pulley, screw or spool, behind all gears.
    """
    found = list[Drive | None]()
    for stepper in _list_steppers(printer):
        field = f"{stepper} {ROTATION_DISTANCE}"
        if field not in stated:
            found.append(None)
            continue
        turn = stated.number(field, "mm a turn", low=1e-3) * MM
        gear = _gear(stated, f"{stepper} {GEAR_RATIO}")
        winds = isinstance(printer, Winches)
        found.append(Drive("spool", turn / gear, gear=gear) if winds else make_drive(turn, gear))
    return tuple(found)


def _kind_of_probe(stated: Settings) -> str:
    """Return the section of the probe, of whatever kind, such as `[bltouch]`."""
    depths = (field for field in stated.texts if field.endswith("] z_offset"))
    return next(depths, "[probe] z_offset").removesuffix(" z_offset")


def _probe(stated: Settings) -> Array:
    """Return the probe's tip (3,) beside the nozzle in m; stored heights are the nozzle's."""
    kind = _kind_of_probe(stated)
    beside = [stated.number(f"{kind} {a}_offset", "mm", 0.0) * MM for a in "xy"]
    return np.array([*beside, 0.0])


def _read_stepper_values(
    stated: Settings,
    key: str,
    expected: str,
    defaults: Sequence[float] | None = None,
    low: float = -1e4,
) -> Array:
    """Read a key of the three steppers (3,); b and c default to the value of a, or `defaults`."""
    values: list[float] = []
    for i, stepper in enumerate(STEPPERS):
        default = defaults[i] if defaults else values[0] if values else None
        values.append(stated.number(f"{stepper} {key}", expected, default, low))
    return np.array(values)


def _steps(stated: Settings) -> Array:
    """Return the length of a microstep (3,) in m or rad.

    Until 2021, a configuration stated it as `step_distance`.
    """
    found = []
    linear = _kind(stated) == "delta"
    for stepper in STEPPERS:
        turn, old = 2 * np.pi, f"{stepper} {STEP_DISTANCE}"
        if old in stated and f"{stepper} {ROTATION_DISTANCE}" not in stated:
            expected = "mm a microstep" if linear else "rad a microstep"
            found.append(stated.number(old, expected, low=1e-9) * (MM if linear else 1.0))
            continue
        if linear:
            field = f"{stepper} {ROTATION_DISTANCE}"
            turn = stated.number(field, "mm a turn", low=1e-3) * MM
        full = stated.number(f"{stepper} full_steps_per_rotation", "steps", 200.0, 1)
        micro = stated.number(f"{stepper} microsteps", "microsteps per step", low=1)
        found.append(turn / (full * micro * _gear(stated, f"{stepper} {GEAR_RATIO}")))
    return np.array(found)


def _find_steps(stated: Settings) -> Array | None:
    """The `_steps`; None if the configuration is not whole and does not state them."""
    keys = ["microsteps"] + [ROTATION_DISTANCE] * (_kind(stated) == "delta")
    for stepper in STEPPERS:
        is_stated = all(f"{stepper} {key}" in stated for key in keys)
        if not is_stated and f"{stepper} {STEP_DISTANCE}" not in stated:
            return None
    return _steps(stated)


def scale(stated: Settings) -> Array | None:
    """Return the turns (3,) of the motors for 1 m of a carriage; None if they are not stated."""
    fields = [f"{stepper} {ROTATION_DISTANCE}" for stepper in STEPPERS]
    if any(field not in stated for field in fields):
        return None
    turns = [stated.number(field, "mm a turn", low=1e-3) * MM for field in fields]
    return gears(stated) / np.array(turns)


def gears(stated: Settings) -> Array:
    """Return the turns (3,) of the motors for one turn of their pulleys."""
    return np.array([_gear(stated, f"{stepper} {GEAR_RATIO}") for stepper in STEPPERS])


def _gear(stated: Settings, field: str) -> float:
    """Return the product of ratios such as `57:11, 2:1`."""
    if field not in stated:
        return 1.0
    text, place = stated.text(field, "")
    ratio = 1.0
    for pair in filter(str.strip, text.split(",")):
        teeth = pair.split(":")
        if len(teeth) != 2:
            raise place.error(field, text, "ratios such as 57:11, 2:1")
        driven, driving = (place.number(field, t, "ratios such as 57:11, 2:1", 1e-6) for t in teeth)
        ratio *= driven / driving
    return ratio


def _kind(stated: Settings) -> str:
    text, place = stated.text(KINEMATICS, KINDS)
    if text not in LINEAR_OR_ROTARY:
        raise place.error(KINEMATICS, text, KINDS)
    return text


def kinematics(stated: Settings) -> Delta | DeltesianArms | Winches:
    """Return the printer that a configuration describes."""
    expected = f"{KINDS.replace(' or', ',')}, {DELTESIAN} or {WINCH}"
    text, place = stated.text(KINEMATICS, expected)
    if text in LINEAR_OR_ROTARY:
        return delta(stated)
    if text == WINCH:
        return _winches(stated)
    if text != DELTESIAN:
        raise place.error(KINEMATICS, text, expected)
    widths = _read_pair(stated, "arm_x_length", "mm", 1e-3)
    rods = _read_pair(stated, "arm_length", "mm, longer than arm_x_length", 1e-3)
    for side in (side for side, ok in zip(SIDES, rods > widths, strict=True) if not ok):
        given = side if f"{side} arm_length" in stated else SIDES[0]
        raise stated.error(f"{given} arm_length", "mm, longer than arm_x_length")
    heights = _read_pair(stated, "position_endstop", HEIGHT_EXPECTED, 0.0)
    low = stated.number(BED_RANGE[0], "mm", 0.0)
    high = stated.number(BED_RANGE[1], "mm, more than position_min", low=low)
    within = f"mm from position_min to position_max ({low:g} to {high:g})"
    at = stated.number(ENDSTOP, within, None, low, high) * MM
    for field in (f"{stepper} {ROTATION_DISTANCE}" for stepper in (*SIDES, BED)):
        stated.number(field, "mm a turn, more than 0", 1.0, 1e-3)
    tops = heights * MM + np.sqrt(rods**2 - widths**2) * MM
    arms = DeltesianArms(widths * MM, rods * MM, np.append(tops, at), (low * MM, high * MM))
    widest = max_print_width(stated, arms)
    stated.number(WIDTH, f"mm from 0 to {widest:g}, Klipper's limit with these arms", 0, 0, widest)
    return arms


def _winches(stated: Settings) -> Winches:
    """Return the winches; as in Klipper, the first stepper without a section ends their list."""
    anchors = []
    for i, line in enumerate(LINES):
        if i >= MIN_LINES and not any(field.startswith(f"{line} ") for field in stated.texts):
            break
        anchors.append([stated.number(ANCHOR.format(line, axis), "mm") for axis in "xyz"])
    return Winches(np.array(anchors) * MM)


def max_print_width(stated: Settings, arms: DeltesianArms) -> float:
    """Return the largest print_width in mm that Klipper accepts with these arms."""
    angle = stated.number("[printer] min_angle", "degrees from 0 to 90", MIN_ANGLE, 0.0, 90.0)
    return arms.max_print_width(angle)


def _read_pair(stated: Settings, key: str, expected: str, low: float = -1e4) -> Array:
    """Read a key of the left and the right stepper (2,); the right one has the left one's value."""
    left = stated.number(f"{SIDES[0]} {key}", expected, None, low)
    return np.array([left, stated.number(f"{SIDES[1]} {key}", expected, left, low)])


def delta(stated: Settings) -> Delta:
    return _towers(stated) if _kind(stated) == "delta" else _shoulders(stated)


def _angles(stated: Settings, defaults: Sequence[float]) -> Array:
    """Return the steppers' angles (3,) in degrees; DatasetError unless counter-clockwise.

    Klipper's forward kinematics is valid for this order only. With another order it returns the
    mirror image of the nozzle above the joints, homes there, and moves the arms out of reach.
    """
    angles = _read_stepper_values(stated, "angle", "degrees", defaults)
    if are_counter_clockwise(angles * DEGREE):
        return angles
    cure = "correct the angles"
    if are_counter_clockwise(-angles * DEGREE):
        cure = (
            f"set the angle in {STEPPERS[1]} and {STEPPERS[2]}, then exchange the "
            "names of these two sections everywhere"
        )
    found = ", ".join(f"{angle:g}" for angle in angles)
    field = next(f"{s} angle" for s in reversed(STEPPERS) if f"{s} angle" in stated)
    raise stated.error(
        field,
        "steppers a, b, c counter-clockwise seen from above, but they are at "
        f"{found} degrees: Klipper cannot compute the nozzle position with these "
        f"angles; {cure}",
    )


def _towers(stated: Settings) -> Towers:
    radius = stated.number("[printer] delta_radius", "mm", low=1.0)
    angles = _angles(stated, TOWERS)
    return Towers.of(
        radius,
        _read_stepper_values(stated, "arm_length", "mm, longer than the delta radius", low=radius),
        angles - np.array(TOWERS),
        _read_stepper_values(stated, "position_endstop", HEIGHT_EXPECTED, low=0.0),
        reach=stated.number("[printer] print_radius", "mm", 0.6 * radius, 1.0) * MM,
        scale=scale(stated),
        step=_find_steps(stated),
    )


def _shoulders(stated: Settings) -> Shoulders:
    """Return the rotary Delta; an end-stop is where the nozzle on the axis has its height."""
    height = stated.number("[printer] shoulder_height", "mm", low=1.0) * MM
    rotary = Shoulders(
        stated.number("[printer] shoulder_radius", "mm", low=1e-3) * MM,
        np.full(3, height),
        _read_stepper_values(stated, "upper_arm_length", "mm", low=1.0) * MM,
        _read_stepper_values(stated, "lower_arm_length", "mm", low=1.0) * MM,
        _angles(stated, SHOULDERS) * DEGREE,
        step=_find_steps(stated),
    )
    heights = _read_stepper_values(stated, "position_endstop", HEIGHT_EXPECTED, low=0.0) * MM
    tops = np.diag(rotary.joints(np.column_stack([np.zeros((3, 2)), heights])))
    for stepper in (s for s, top in zip(STEPPERS, tops, strict=True) if np.isnan(top)):
        given = stepper if f"{stepper} position_endstop" in stated else STEPPERS[0]
        raise stated.error(f"{given} position_endstop", "a height in mm that the arms reach")
    return replace(rotary, limits=tuple((-np.pi / 2, float(top)) for top in tops))
