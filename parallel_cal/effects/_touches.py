"""What the effects on touches of a plate share: they are the sensor's, not the robot's."""

from __future__ import annotations

from typing import ClassVar

from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named


class Touch(Effect):
    """An error of plate or tip, where a sensor reads how far they are apart."""

    of_device = True
    reads: ClassVar[tuple[str, ...]] = ("probe", "plane")

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        return seen


def explain_no_tilt(mechanism: Mechanism) -> str:
    """What `Effect.applies` answers for an effect that only a platform that tilts can show."""
    return "" if {"rx", "ry"} & {*mechanism.moves} else "the platform does not tilt"
