"""Marlin without the rods' trims A, B and C in M665: older versions, which take B for a radius."""

from __future__ import annotations

from parallel_cal.exporting.projection import Projection, Refinement
from parallel_cal.exporting.targets.marlin import (
    HOLDS,
    adapt,
    complete,
    firmware,
    make_projection,
    settings,
)
from parallel_cal.importing.settings import Settings
from parallel_cal.model.model import Model

__all__ = ["HOLDS", "adapt", "complete", "firmware", "project", "settings"]


def project(
    model: Model, present: Refinement | None = None, stated: Settings | None = None
) -> Projection:
    return make_projection(model, present, stated, equal_rods=True)
