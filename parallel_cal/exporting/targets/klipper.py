"""Klipper: the numbers of `kinematics: delta`, `rotary_delta`, `deltesian` and `winch`.

The steppers of a Delta may be at any angle, but must be counter-clockwise seen from above. Only
then does Klipper's forward kinematics find the lower of the two points where the rods meet
(klippy/mathutil.py, trilateration). The axes are those of {B}, turned by 180 degrees about x if z
of {B} points down. Sources: Klipper documentation, "Configuration reference" and "Delta
calibration"; importing/winches.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.units import DEGREE, MM
from parallel_cal.exporting.deltas import (
    LINEAR,
    ROTARY,
    complete_towers,
    express_gain,
    shoulders,
    towers,
)
from parallel_cal.exporting.editing import format_number
from parallel_cal.exporting.projection import (
    Firmware,
    Frame,
    Machine,
    Projection,
    Refinement,
    fit_numbers,
)
from parallel_cal.importing.deltas import Shoulders
from parallel_cal.importing.deltesian import DeltesianArms
from parallel_cal.importing.importers import klipper
from parallel_cal.importing.importers.klipper import STEPPERS
from parallel_cal.importing.settings import Settings
from parallel_cal.importing.winches import Winches
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import Model

HOLDS = (*LINEAR, *ROTARY, klipper.DELTESIAN, "cable")
FILE = "printer.cfg"
DECIMALS = 6  # of mm and degrees, as SAVE_CONFIG writes them
START = (
    "Klipper takes the point to be at the origin when it starts and at G28: move it there first. "
    "With the settings of the recording, the steppers are at {} mm there"
)


def settings(paths: Sequence[Path], texts: Mapping[Path, str] | None = None) -> Settings:
    return klipper.settings(paths, texts)


def firmware(stated: Settings) -> Firmware:
    return klipper.kinematics(stated)


def complete(read: Firmware, model: Model) -> Firmware:
    return complete_towers(read, model, None)


def project(
    model: Model, present: Refinement | None = None, stated: Settings | None = None
) -> Projection:
    if model.mechanism.name == klipper.DELTESIAN:
        return _deltesian(model, stated)
    if model.mechanism.name == "cable":
        return _winches(model)
    remarks, scale = list[str](), None
    if model.mechanism.name in LINEAR:
        has_scale = stated is not None and klipper.scale(stated) is not None
        tall, c = towers(model, None, tilted=False, present=present, has_scale=has_scale)
        kind, heights = "delta", tall.heights
        printer = {"delta_radius": tall.radius[0] / MM}
        angles = tall.first + np.arange(3) * 120 * DEGREE + tall.trim
        each = {"arm_length": tall.rods / MM}
        if tall.scale is not None and stated is not None:
            each[klipper.ROTATION_DISTANCE] = klipper.gears(stated) / tall.scale / MM
        scale = tall.scale
    else:
        turned, c = shoulders(model, places=None, equal_heights=True, present=present)
        kind, heights, angles = "rotary_delta", end_stop_heights(turned), turned.angles
        printer = {"shoulder_radius": turned.radius / MM}
        printer |= {"shoulder_height": turned.heights[0] / MM}
        each = {"upper_arm_length": turned.arms / MM, "lower_arm_length": turned.rods / MM}
    each |= {"angle": np.round(angles / DEGREE, DECIMALS) % 360, "position_endstop": heights / MM}
    found = {"[printer] kinematics": kind}
    found |= {f"[printer] {key}": f"{number:.{DECIMALS}f}" for key, number in printer.items()}
    for i, stepper in enumerate(STEPPERS):
        found |= {f"{stepper} {key}": f"{three[i]:.{DECIMALS}f}" for key, three in each.items()}
    if stated is not None:  # rotation_distance is per turn of the pulley
        ratios = (f"{stepper} {klipper.GEAR_RATIO}" for stepper in STEPPERS)
        found |= {field: stated.texts[field][0] for field in ratios if field in stated}
    if moved := [(STEPPERS[i], model.joints[k]) for i, k in enumerate(c.frame.order) if i != k]:
        pins = " and ".join(f"the pins of {joint} in {stepper}" for stepper, joint in moved)
        remarks.append(
            "Klipper requires its steppers in counter-clockwise order, seen from above. "
            f"Enter {pins}"
        )
    made = Projection({FILE: found}, c.frame, c.stops, tuple(remarks))
    if model.mechanism.name in LINEAR:
        made = express_gain(model, made, scale, klipper.ROTATION_DISTANCE)
    return made


def end_stop_heights(delta: Shoulders) -> np.ndarray:
    """Return the nozzle's heights (3,) in m on the axis with one arm at its end-stop."""
    out = delta.radius + delta.arms * np.cos(delta.homed)
    if (out > delta.rods).any():
        raise ModelError("with the arms at their end-stops no rod reaches the middle")
    return np.asarray(
        delta.heights + delta.arms * np.sin(delta.homed) - np.sqrt(delta.rods**2 - out**2)
    )


def _deltesian(model: Model, stated: Settings | None) -> Projection:
    """Fit widths, rods and end-stops of left and right, and the end-stop of the bed."""
    sides = ("left", "right")
    tops = [high for _, high in model.mechanism.joint_limits]
    stops = np.array(getattr(model.mechanism, "switches", None) or tops)
    x, z, rods = (np.array([model.value(f"{s}.{n}") for s in sides]) for n in ("x", "z", "rod"))
    homed = stops + [*z, model.value("bed.q0")]
    frame = Frame((0, 1, 2), np.ones(3))

    def machine(v: np.ndarray) -> Machine:
        return Machine(DeltesianArms(v[:2], v[2:4], v[4:], (0.0, 0.0)), frame, stops)

    start = np.array([-x[0], x[1], *rods, *homed])
    arms = machine(fit_numbers(model, start, machine)).firmware
    assert isinstance(arms, DeltesianArms)
    keys = ("arm_x_length", "arm_length", "position_endstop")
    found = {"[printer] kinematics": klipper.DELTESIAN}
    for k, side in enumerate(klipper.SIDES):
        numbers = (arms.widths[k], arms.rods[k], arms.heights[k])
        for key, number in zip(keys, numbers, strict=True):
            found[f"{side} {key}"] = f"{number / MM:.{DECIMALS}f}"
    found[klipper.ENDSTOP] = f"{arms.homed[2] / MM:.{DECIMALS}f}"
    ends = np.array(model.mechanism.joint_limits)[2] + arms.homed[2] - stops[2]
    for field, end in zip(klipper.BED_RANGE, ends, strict=True):
        found[field] = f"{end / MM:.{DECIMALS}f}"
    remarks = list[str]()
    if stated is not None and klipper.WIDTH in stated:
        width, widest = stated.number(klipper.WIDTH, "mm"), klipper.max_print_width(stated, arms)
        if width > widest:
            found[klipper.WIDTH] = f"{widest:g}"
            remarks.append(
                f"{klipper.WIDTH} becomes {widest:g} in place of {width:g}: it is the largest "
                "that Klipper accepts with the new arms"
            )
    return Projection({FILE: found}, frame, stops, tuple(remarks))


def _winches(model: Model) -> Projection:
    """Fit the anchors; the steppers count from the origin, where the robot reads what it reads."""
    cable: Any = model.mechanism
    n = len(model.joints)
    if len(cable.moves) != 3 or cable.spools or any(cable.moving_pulleys) or not cable.whole:
        raise ModelError(
            "klipper: expected a cable robot in space whose readings are whole lengths of line "
            "from the anchors (option zero: anchors, no spools) and whose lines end at the point. "
            "rrf has the spools of a Hangprinter"
        )
    if n > len(klipper.LINES):
        raise ModelError(f"klipper: {n} lines, expected {klipper.MIN_LINES} to 26")
    start = np.array([[model.value(f"line{i + 1}.A_{a}") for a in "xyz"] for i in range(n)])
    stops = Kinematics(model).inverse(np.zeros((1, 3))).joints[0]

    def machine(v: np.ndarray) -> Machine:
        return Machine(Winches(v.reshape(n, 3)), Frame(tuple(range(n)), np.ones(n)), stops)

    found = Winches(fit_numbers(model, start.ravel(), machine).reshape(n, 3))
    numbers = {klipper.KINEMATICS: klipper.WINCH}
    for line, anchor in zip(klipper.LINES, found.anchors, strict=False):
        for axis, value in zip("xyz", anchor, strict=True):
            numbers[klipper.ANCHOR.format(line, axis)] = format_number(value / MM, DECIMALS)
    lengths = ", ".join(f"{length / MM:.3f}" for length in stops)
    remarks = (START.format(lengths), *found.describe_mirror())
    return Projection({FILE: numbers}, Frame(tuple(range(n)), np.ones(n)), stops, remarks)


def adapt(stated: Settings, numbers: Mapping[str, str]) -> dict[str, str]:
    """Move the range of a deltesian's bed in the file along with its end-stop.

    Klipper refuses an end-stop outside of the range.
    """
    found = {field: text for field, text in numbers.items() if field not in klipper.BED_RANGE}
    if klipper.ENDSTOP not in numbers:
        return found
    by = float(numbers[klipper.ENDSTOP]) - stated.number(klipper.ENDSTOP, "mm")
    ends = (stated.number(field, "mm", 0.0) + by for field in klipper.BED_RANGE)
    return found | {
        field: format_number(end, DECIMALS)
        for field, end in zip(klipper.BED_RANGE, ends, strict=True)
    }
