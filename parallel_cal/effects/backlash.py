"""Backlash between encoder and arm: the arm lags behind on the side from which it came."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from parallel_cal.effects._joints import shift_joints, sizes
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter

SIZE = {"rad": (0.3e-3, 3e-3), "m": (20e-6, 0.2e-3)}  # tolerance and upper bound of real drives


class Backlash(Effect):
    """q_ideal = q - width / 2 * direction for every joint; direction of the last motion."""

    needs = ("direction",)
    alike = ("*.width",)
    physics = "Backlash in a gear: the arm stops half the backlash short of the motor's encoder."
    remedy = "preload or replace the gear; until then, approach all poses from one side"
    source = "backlash of gearboxes: 0.03-0.3 mrad for precision gears; 5-20 um for ball screws"
    lookalikes = ("hysteresis", "latency")
    separated_by = "the same poses approached from both directions, measured at rest"
    told_from: ClassVar[Mapping[str, str]] = {
        "hysteresis": "Approach each pose twice from the same side: once by a short move, just "
        "longer than the backlash (twice the lag of a hysteresis), once by a long one."
    }

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return [
            Parameter(f"{joint}.width", unit, 0.0, tolerance, low=0.0, high=most, label="width")
            for joint, unit, (tolerance, most) in sizes(mechanism, SIZE)
        ]

    def least_travel(self, e: Named, joint: str) -> float:
        return abs(float(e[joint].width))

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        def error(joint: str, q: Any) -> Any:
            return -e[joint].width / 2 * at["direction"][joint]

        return shift_joints(seen, mechanism, mechanism.joints, error)
