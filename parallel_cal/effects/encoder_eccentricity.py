"""Encoder disc mounted off its axis: a joint error once per turn."""

from __future__ import annotations

import casadi as ca

from parallel_cal.effect import Effect, Seen
from parallel_cal.mechanism import Mechanism
from parallel_cal.parameters import Named, Parameter


class EncoderEccentricity(Effect):
    """q_ideal = q + sin * sin q + cos * cos q for every joint (rad)."""

    physics = "An encoder disc off its axis by e at radius r misreads e/r once per turn."
    source = "encoder mounting tolerance: 10-40 um on a 25 mm radius is 0.4-1.6 mrad"
    lookalikes = ("encoder_second_harmonic", "encoder_gain")
    separated_by = "poses that use the whole travel of every joint"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return [
            Parameter(f"{joint}.{part}", unit, 0.0, 1e-3)
            for joint, unit in zip(mechanism.joints, mechanism.joint_units, strict=True)
            for part in ("sin", "cos")
        ]

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        q = seen.q
        rows = [
            q[i] + e[joint].sin * ca.sin(q[i]) + e[joint].cos * ca.cos(q[i])
            for i, joint in enumerate(mechanism.joints)
        ]
        return seen.with_q(ca.vertcat(*rows))
