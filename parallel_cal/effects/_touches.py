"""Shared by effects on touches of a plate: errors of the sensor, not of the robot."""

from __future__ import annotations

from typing import ClassVar

from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named


class Touch(Effect):
    """An error of plate or tip, for sensors that measure the distance between them."""

    of_device = True
    reads: ClassVar[tuple[str, ...]] = ("probe", "plane")

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        return seen


def explain_no_tilt(mechanism: Mechanism) -> str:
    """Return why an effect that needs a tilting platform does not apply; empty if it does."""
    return "" if {"rx", "ry"} & {*mechanism.moves} else "the platform does not tilt"
