"""Play between encoder and arm: the arm lags behind, on the side it came from."""

from __future__ import annotations

import casadi as ca

from parallel_cal.effect import Effect, Seen
from parallel_cal.mechanism import Mechanism
from parallel_cal.parameters import Named, Parameter


class Backlash(Effect):
    """q_ideal = q - width / 2 * direction for every joint, direction of the last motion."""

    needs = ("direction",)
    physics = "A gear with play leaves the arm half the play behind the motor's encoder."
    source = "gearbox play, 0.03-0.3 mrad for precision gears"
    lookalikes = ("hysteresis", "latency")
    separated_by = "the same poses approached from both directions, at rest"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        joints = zip(mechanism.joints, mechanism.joint_units, strict=True)
        return [Parameter(f"{j}.width", unit, 0.0, 0.3e-3, low=0.0) for j, unit in joints]

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        rows = [
            seen.q[i] - e[joint].width / 2 * at["direction"][joint]
            for i, joint in enumerate(mechanism.joints)
        ]
        return seen.with_q(ca.vertcat(*rows))
