"""grblHAL: settings $641 to $646 of its symmetric rotary Delta.

Only the difference of the sides $643 and $644 counts, so $644 is 0. Their meaning and their source
are in the importer.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from parallel_cal.base.units import DEGREE, MM
from parallel_cal.exporting.deltas import ROTARY, describe_unequal_stops, fit_equal_shoulders
from parallel_cal.exporting.projection import Firmware, Projection, Refinement
from parallel_cal.importing.deltas import HANGING_ANGLES, SIDE
from parallel_cal.importing.importers import grblhal
from parallel_cal.importing.settings import Settings
from parallel_cal.model.model import Model

HOLDS = ROTARY
FILE = "settings.txt"


def settings(paths: Sequence[Path]) -> Settings:
    return grblhal.settings(paths)


def firmware(stated: Settings) -> Firmware:
    return grblhal.shoulders(stated)


def project(model: Model, present: Refinement | None = None) -> Projection:
    delta, found = fit_equal_shoulders(model, HANGING_ANGLES, one_stop=True, present=present)
    numbers = (delta.rods[0] / MM, delta.arms[0] / MM, delta.radius / MM / SIDE, 0.0)
    written = {f"${641 + k}": f"{number:.3f}" for k, number in enumerate(numbers)}
    written["$646"] = f"{-delta.homed[0] / DEGREE:.3f}"
    remarks = describe_unequal_stops(model, HANGING_ANGLES)
    return Projection({FILE: written}, found.frame, found.stops, remarks)
