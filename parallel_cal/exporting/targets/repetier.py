"""Repetier-Firmware: commands M206 that store the numbers of a linear Delta in the EEPROM.

Each tower has a radius, an angle and a rod of its own. The firmware cuts rods off to whole steps,
so a rod is written half a step longer. The meaning of the numbers and their source are in the
importer.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.units import DEGREE, MM
from parallel_cal.exporting.deltas import LINEAR, TOWERS, complete_towers, express_gain, towers
from parallel_cal.exporting.editing import format_number
from parallel_cal.exporting.projection import Firmware, Projection, Refinement
from parallel_cal.importing.importers import repetier
from parallel_cal.importing.importers.repetier import (
    ALPHAS,
    COATING,
    HEIGHT,
    RADII,
    RADIUS,
    ROD,
    RODS,
    STEPS,
    STOPS,
)
from parallel_cal.importing.settings import Settings
from parallel_cal.model.model import Model

HOLDS = LINEAR
FILE = "repetier.gcode"
DECIMALS = 4  # of mm and degrees
NO_SCALE = (
    "repetier: the offsets of the end-stops are in steps, and neither a file nor the model states "
    "the steps per mm: state the option scale of linear_delta (steps per m) in the model file. new "
    "--from a report of M205 does"
)
EDITED = (
    "M206 T... P...: the numbers of Repetier's EEPROM are changed by these commands, not in a "
    "report or in Configuration.h, over which the EEPROM counts. Export without --into, and send "
    "the file"
)


def settings(paths: Sequence[Path]) -> Settings:
    stated = repetier.settings(paths)
    for field, (text, place) in stated.texts.items():
        line = place.path.read_text(encoding="utf-8").splitlines()[place.line - 1]
        if not repetier.COMMAND.match(line.strip()):
            raise place.error(field, text, EDITED)
    return stated


def firmware(stated: Settings) -> Firmware:
    return repetier.towers(stated)


def complete(read: Firmware, model: Model) -> Firmware:
    return complete_towers(read, model, TOWERS)


def project(
    model: Model, present: Refinement | None = None, stated: Settings | None = None
) -> Projection:
    delta, c = towers(model, TOWERS, tilted=False, present=present, equal_radii=False)
    per_mm = _steps_per_mm(model, stated)
    own_radii, own_rods, coating = np.zeros(3), np.zeros(3), 0.0
    if stated is not None:  # of all ways to state the same, the one with the file's corrections
        own_radii, own_rods = (
            np.array([stated.number(field, "mm", 0.0) for field in fields])
            for fields in (RADII, RODS)
        )
        coating = stated.number(COATING, "mm", 0.0)
    rods = (np.round(delta.rods / MM * per_mm) + 0.5) / per_mm
    radius, rod = delta.radius.mean() / MM - own_radii.mean(), rods.mean() - own_rods.mean()
    down = np.round((delta.heights - delta.heights.min()) / MM * per_mm)
    height = float(np.mean(delta.heights / MM - down / per_mm)) + coating
    found = {ROD: rod, RADIUS: radius, HEIGHT: height}
    for fields, values in (
        (RADII, delta.radius / MM - radius),
        (RODS, rods - rod),
        (ALPHAS, delta.trim / DEGREE + repetier.DIRECTIONS),
    ):
        found |= dict(zip(fields, values, strict=True))
    written = {field: format_number(value, DECIMALS) for field, value in found.items()}
    written[STEPS] = f"{per_mm:.{DECIMALS}f}"
    written |= {field: f"{steps:.0f}" for field, steps in zip(STOPS, down, strict=True)}
    made = Projection({FILE: written}, c.frame, c.stops)
    return express_gain(model, made, None, "M206 T3 P11 (steps per mm)")


def _steps_per_mm(model: Model, stated: Settings | None) -> float:
    """Return the steps per mm that all motors have; ModelError if neither file nor model states
    them."""
    if stated is not None and STEPS in stated:
        return stated.number(STEPS, "steps per mm", low=1.0)
    scale = getattr(model.mechanism, "scale", None)
    if scale is None:
        raise ModelError(NO_SCALE)
    if np.ptp(scale) > 1e-6 * max(scale):
        raise ModelError(
            f"repetier: the model's motors have {', '.join(f'{s * MM:g}' for s in scale)} steps "
            "per mm, but this firmware has one number for all three"
        )
    return float(scale[0]) * MM
