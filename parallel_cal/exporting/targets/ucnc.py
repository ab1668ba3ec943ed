"""uCNC: settings $106, $107 and $132 of its linear Delta, whose towers and rods are all alike.

Their meaning and their source are in the importer.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from parallel_cal.base.units import MM
from parallel_cal.exporting.deltas import (
    LINEAR,
    complete_towers,
    describe_unequal_stops,
    express_gain,
    fit_equal_towers,
)
from parallel_cal.exporting.projection import Firmware, Projection, Refinement
from parallel_cal.importing.importers import ucnc
from parallel_cal.importing.importers.ucnc import HEIGHT, RADIUS, ROD
from parallel_cal.importing.settings import Settings
from parallel_cal.model.model import Model

HOLDS = LINEAR
FILE = "settings.txt"
DECIMALS = 3  # of mm, as $$ lists them
PLACES = ucnc.FIRST + np.radians([0.0, 120.0, 240.0])
INVERT = (
    "$132 is the height after homing only if $23 inverts the direction of Z (bit 2), and after "
    "pulling off by $27: the model's upper limits of the joints are taken for these places"
)


def settings(paths: Sequence[Path]) -> Settings:
    return ucnc.settings(paths)


def firmware(stated: Settings) -> Firmware:
    return ucnc.towers(stated)


def complete(read: Firmware, model: Model) -> Firmware:
    return complete_towers(read, model, PLACES)


def project(model: Model, present: Refinement | None = None) -> Projection:
    tall, found = fit_equal_towers(model, PLACES, present, one_stop=True)
    numbers = {ROD: tall.rods[0], RADIUS: tall.radius[0], HEIGHT: tall.heights[0]}
    written = {field: f"{size / MM:.{DECIMALS}f}" for field, size in numbers.items()}
    remarks = (INVERT, *describe_unequal_stops(model, PLACES))
    made = Projection({FILE: written}, found.frame, found.stops, remarks)
    return express_gain(model, made, None, "$100 to $102")
