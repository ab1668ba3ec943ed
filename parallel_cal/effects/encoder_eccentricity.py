"""Encoder disc mounted off its axis: a joint error once per turn."""

from __future__ import annotations

from typing import Any

import casadi as ca

from parallel_cal.effects._joints import WAVE, needs_turning, shifted, turning
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter


class EncoderEccentricity(Effect):
    """q_ideal = q + sin * sin q + cos * cos q for every joint that turns (rad)."""

    physics = "An encoder disc off its axis by e at radius r misreads e/r once per turn."
    source = "encoder mounting tolerance: 10-40 um on a 25 mm radius is 0.4-1.6 mrad"
    lookalikes = ("encoder_second_harmonic", "encoder_gain")
    separated_by = "poses that use the whole travel of every joint"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return [
            Parameter(f"{joint}.{part}", "rad", 0.0, 1e-3, low=-10e-3, high=10e-3, label=label)
            for joint in turning(mechanism)
            for part, label in WAVE.items()
        ]

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        def error(joint: str, q: Any) -> Any:
            return e[joint].sin * ca.sin(q) + e[joint].cos * ca.cos(q)

        return shifted(seen, mechanism, turning(mechanism), error)

    def applies(self, mechanism: Mechanism) -> str:
        return needs_turning(mechanism)
