"""Marlin: M665 and M666 of its linear Delta, or the same numbers in Configuration.h.

Marlin computes no rotary Delta. Its rods are L, plus a trim for each tower (A, B, C). A carriage
that touched its end-stop goes down by the distance of M666, and the nozzle is then H above the
bed. It does not go down by less than a few motor steps. Source: Marlin documentation, "M665",
"M666", and Marlin/src/module/motion.cpp.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from parallel_cal.base.units import DEGREE, MM
from parallel_cal.exporting.deltas import (
    LINEAR,
    TOWERS,
    complete_towers,
    express_gain,
    towers,
)
from parallel_cal.exporting.editing import format_number
from parallel_cal.exporting.projection import Firmware, Projection, Refinement
from parallel_cal.exporting.tower_words import split_heights
from parallel_cal.importing.importers import marlin
from parallel_cal.importing.settings import Settings
from parallel_cal.model.model import Model

HOLDS = LINEAR
FILE = "marlin.gcode"
DECIMALS = 4  # of mm and degrees
STEPS_DECIMALS = 5  # of steps per mm
STORE = (
    "send M500 after these commands, or they are lost when the printer is switched off. After a "
    "change of Configuration.h, build and flash the firmware, then send M502 and M500"
)
TRIMS = (
    "A, B and C of M665 are trims of the rods, which older versions do not have: they take B for "
    "the radius of G33. If M503 shows no A and C, use the target marlin_equal_rods"
)


def settings(paths: Sequence[Path]) -> Settings:
    return marlin.settings(paths)


def firmware(stated: Settings) -> Firmware:
    return marlin.towers(stated)


def complete(read: Firmware, model: Model) -> Firmware:
    return complete_towers(read, model, TOWERS)


def project(
    model: Model, present: Refinement | None = None, stated: Settings | None = None
) -> Projection:
    return make_projection(model, present, stated, equal_rods=False)


def make_projection(
    model: Model, present: Refinement | None, stated: Settings | None, equal_rods: bool
) -> Projection:
    """Return the numbers of M665 and M666, with the trims A, B and C unless rods are equal."""
    has_scale = stated is not None and marlin.towers(stated).scale is not None
    delta, c = towers(
        model, TOWERS, tilted=False, present=present, equal_rods=equal_rods, has_scale=has_scale
    )
    rod, (homed, retract) = delta.rods.mean(), split_heights(delta)
    found = {"M665 L": rod / MM, "M665 R": delta.radius[0] / MM, "M665 H": homed / MM}
    found |= {f"M665 {t}": a for t, a in zip("XYZ", delta.trim / DEGREE, strict=True)}
    if not equal_rods:
        found |= {f"M665 {t}": a for t, a in zip("ABC", (delta.rods - rod) / MM, strict=True)}
    found |= {f"M666 {t}": -a for t, a in zip("XYZ", retract / MM, strict=True)}
    written = {field: format_number(v, DECIMALS) for field, v in found.items()}
    if delta.scale is not None:
        steps = zip(marlin.STEPS_FIELDS, delta.scale * MM, strict=True)
        written |= {field: f"{value:.{STEPS_DECIMALS}f}" for field, value in steps}
    remarks = (STORE,) if equal_rods else (STORE, TRIMS)
    made = Projection({FILE: written}, c.frame, c.stops, remarks)
    return express_gain(model, made, delta.scale, "M92")


def adapt(stated: Settings, numbers: Mapping[str, str]) -> dict[str, str]:
    """Return settings by the names of the files: those of Configuration.h, commands, or both."""
    if marlin.DEFINED not in stated:
        return dict(numbers)
    commands = {field.split()[0] for field in stated.texts}
    found = {field: value for field, value in numbers.items() if field.split()[0] in commands}
    for name, fields in marlin.DEFINITIONS.items():
        values = [numbers[field] for field in fields if field in numbers]
        if name not in stated and not any(float(value) for value in values):
            continue  # zeros are what the firmware has without the definition
        if len(values) == 1:
            found[name] = values[0]
        elif values:
            found[name] = f"{{ {', '.join(values)} }}"
    if marlin.STEPS_FIELDS[0] in numbers:
        steps = [numbers[field] for field in marlin.STEPS_FIELDS]
        extruders = marlin.read_steps(stated)[len(steps) :]
        found[marlin.STEPS_DEFINED] = f"{{ {', '.join([*steps, *extruders])} }}"
    if marlin.RADIUS_TRIM in stated:  # the fit has one radius for all towers
        found[marlin.RADIUS_TRIM] = "{ 0.0, 0.0, 0.0 }"
    return found
