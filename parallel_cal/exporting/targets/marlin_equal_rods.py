"""Marlin without the rods' trims A, B and C in M665: older versions, which take B for a radius."""

from __future__ import annotations

from parallel_cal.exporting.projection import Projection, Refinement
from parallel_cal.exporting.targets.marlin import HOLDS, adapt, firmware, make_projection, settings
from parallel_cal.model.model import Model

__all__ = ["HOLDS", "adapt", "firmware", "project", "settings"]


def project(model: Model, present: Refinement | None = None) -> Projection:
    return make_projection(model, present, equal_rods=True)
