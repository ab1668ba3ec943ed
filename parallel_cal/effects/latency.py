"""Poses stamped later than they were measured: in motion, the joints have moved on."""

from __future__ import annotations

from typing import Any

from parallel_cal.effects._joints import shift_joints
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter


class Latency(Effect):
    """q_ideal = q - delay * velocity for every joint, with one delay (s) for all.

    A pose stamped t was measured at t - delay; if the delay is negative, the joints are late.
    """

    needs = ("velocity",)
    physics = "A device that stamps poses on arrival reports where the robot was a moment before."
    remedy = "stamp poses when they are measured, or measure at rest; the robot is not the cause"
    source = "1 ms at 0.2 m/s is 200 um; trackers and cameras over a network take 1-20 ms"
    lookalikes = ("backlash", "hysteresis", "servo_lag", "acceleration_lag")
    separated_by = "the same path at two speeds, and poses at rest"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return [Parameter("delay", "s", 0.0, 5e-3, low=-50e-3, high=50e-3)]

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        def error(joint: str, q: Any) -> Any:
            return -e.delay * at["velocity"][joint]

        return shift_joints(seen, mechanism, mechanism.joints, error)
