"""A base or measuring device that moves slowly during the session."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from parallel_cal.effects._frames import shift_and_turn, undo_shift_and_turn
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter


class BaseDrift(Effect):
    """r_shown = r + (v + w x r) t, R_shown = exp(w t) R, t (s) since the recording began.

    v (m/s) and w (rad/s) are the motion of {B} as the device sees it, about axes of {B}. Only the
    components that change a coordinate of the platform are parameters.
    """

    needs = ("time",)
    of_device = True
    physics = (
        "A stand, tripod or frame moves slowly relative to the device while it settles and "
        "warms up."
    )
    remedy = "let robot and device warm up, and mount both on one base"
    source = "tens of um in a session of some hours, up to 0.1 um/s while warming up"
    lookalikes = ("thermal_expansion", "zero_shift", "device_bump")
    told_from: ClassVar[Mapping[str, str]] = {
        "thermal_expansion": "Measure the robot cold, then warm from its own work, then cold again."
    }
    separated_by = (
        "a temperature that is not monotone in time, and the first poses measured again at the end"
    )

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return shift_and_turn(mechanism, ("m/s", 1e-7, 1e-6), ("rad/s", 3e-7, 3e-6))

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        return undo_shift_and_turn(seen, e, at.time)
