"""Encoder disc tilted or out of round: a joint error twice per turn."""

from __future__ import annotations

from typing import Any

import casadi as ca

from parallel_cal.effects._joints import WAVE, needs_turning, shifted, turning
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter


class EncoderSecondHarmonic(Effect):
    """q_ideal = q + sin * sin 2q + cos * cos 2q for every joint that turns (rad)."""

    physics = "An encoder disc or magnet that is tilted or oval misreads twice per turn."
    source = "tilt of 1-2 degrees (tan(tilt)^2 / 4) or a pole ring oval by 20 um: 0.1-0.5 mrad"
    lookalikes = ("encoder_eccentricity", "encoder_gain")
    separated_by = "poses that use the whole travel of every joint"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return [
            Parameter(f"{joint}.{part}", "rad", 0.0, 0.5e-3, low=-5e-3, high=5e-3, label=label)
            for joint in turning(mechanism)
            for part, label in WAVE.items()
        ]

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        def error(joint: str, q: Any) -> Any:
            return e[joint].sin * ca.sin(2 * q) + e[joint].cos * ca.cos(2 * q)

        return shifted(seen, mechanism, turning(mechanism), error)

    def applies(self, mechanism: Mechanism) -> str:
        return needs_turning(mechanism)
