"""Drives that bend under inertia: a joint that speeds up stays behind its reading."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from parallel_cal.effects._joints import shift_joints
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter


class AccelerationLag(Effect):
    """q_ideal = q - lag * acceleration for every joint, with a lag (s^2) of its own.

    A transmission of the stiffness k that accelerates the inertia J bends by J / k times the
    acceleration: its lag is J / k. A position loop without acceleration feed-forward lags in the
    same way: its lag is 1 / K_a, where K_a (1/s^2) is its acceleration constant. An error in
    proportion to the velocity is `servo_lag` or `latency`.
    """

    needs = ("acceleration",)
    alike = ("*.lag",)
    physics = "Inertia bends the elastic transmission between motor and arm."
    remedy = "lower the acceleration, set its feed-forward in the drives, or measure at rest"
    source = "1 / (2 pi f)^2, f the natural frequency of drive and arm: 10 Hz 0.25e-3, 30 Hz 28e-6"
    lookalikes = ("servo_lag", "latency")
    separated_by = (
        "the same path at two speeds, one twice the other: the accelerations differ fourfold"
    )
    told_from: ClassVar[Mapping[str, str]] = {
        "latency": "constant speeds in some parts of the path, rising and falling ones in others"
    }

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return [
            Parameter(f"{joint}.lag", "s^2", 0.0, 0.2e-3, low=-2e-3, high=2e-3)
            for joint in mechanism.joints
        ]

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        def error(joint: str, q: Any) -> Any:
            return -e[joint].lag * at["acceleration"][joint]

        return shift_joints(seen, mechanism, mechanism.joints, error)
