"""Drives that follow late: in motion, every joint is behind its reading by its own time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from parallel_cal.effects._joints import shift_joints
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter


class ServoLag(Effect):
    """q_ideal = q - lag * velocity for every joint, with a lag (s) of its own.

    The reading is the commanded position, or a position ahead of an elastic drive. A position loop
    of the gain K_v (1/s) follows a ramp with the lag 1 / K_v. A lag that all joints have in common
    is `latency`. The acceleration's share, qdd / K_a, is `acceleration_lag`.
    """

    needs = ("velocity",)
    alike = ("*.lag",)
    physics = "A position loop without feed-forward follows a moving command late."
    remedy = "set the velocity feed-forward of the drives, record encoders, or measure at rest"
    source = "position loops of drives: K_v of 20-200 1/s, a lag of 5-50 ms; with feed-forward 1 ms"
    lookalikes = ("latency", "backlash", "hysteresis", "acceleration_lag")
    separated_by = "the same path at two speeds in both directions, and poses at rest"
    told_from: ClassVar[Mapping[str, str]] = {
        "latency": "paths on which single joints move while the others stand still"
    }

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return [
            Parameter(f"{joint}.lag", "s", 0.0, 5e-3, low=-100e-3, high=100e-3)
            for joint in mechanism.joints
        ]

    def applies(self, mechanism: Mechanism) -> str:
        return "" if len(mechanism.joints) > 1 else "it has one joint: latency describes it"

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        def error(joint: str, q: Any) -> Any:
            return -e[joint].lag * at["velocity"][joint]

        return shift_joints(seen, mechanism, mechanism.joints, error)
