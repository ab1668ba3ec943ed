"""Strain-wave gears that twist under load, and stiffen as they do."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.effects._statics import (
    compliances,
    estimate_joint_loads,
    find_loaded_joints,
    joint_forces,
    masses,
    needs_weight,
)
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter

# of `torque` over the largest recorded load: far above, it is a line
TORQUE_RATIOS = (1 / 4, 1 / 2, 1.0)


class StrainWaveCompliance(Effect):
    """q_ideal = q + e, where e is the twist under which k1 e + k3 e^3 = load.

    The load (N m) is the moment of the weights about a loaded revolute joint. The gear of each such
    joint has the stiffness k1 = 1 / `compliance` under no load (N m/rad), and k3 = k1^3 /
    `torque`^2. In closed form, e = compliance * torque * y with y + y^3 = u, u = load / `torque`,
    so y = 2 / sqrt(3) sinh(asinh(3 sqrt(3) u / 2) / 3). At the load `torque`, the gear twists by
    0.68 of what it would with k1 alone. All joints have the same `torque`: take it from the
    stiffness curve of the gear, or let `scan` find it. Loads far below it twist the gear in
    proportion: that is `joint_compliance`.
    """

    needs = ("payload",)
    fixed = ("mass.*", "torque")
    alike = ("*.compliance",)
    generalizes = ("joint_compliance",)
    physics = (
        "More teeth of a flexspline engage under load, so that the gear is soft at first and then "
        "ever stiffer."
    )
    remedy = "keep the correction in the model and enter the payload; a larger gear twists less"
    source = (
        "Tuttle, MIT AI-TR 1365 (1992); catalogues: the last stiffness is 1.3-2 times the first"
    )
    lookalikes = ("joint_compliance", "rod_compliance", "payload_sag")
    separated_by = "three or more payloads, from none to the largest, in poses that differ in load"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return [
            Parameter("torque", "N m", 20.0, 10.0, low=1e-3, label="load at which it stiffens"),
            *compliances(mechanism, _find_gears(mechanism)),
            *masses(mechanism),
        ]

    def applies(self, mechanism: Mechanism) -> str:
        if why := needs_weight(mechanism):
            return why
        return "" if _find_gears(mechanism) else "no revolute joint carries any of the weight"

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        load, gears = joint_forces(seen, e, at, mechanism), _find_gears(mechanism)
        # y + y^3 = u has the real root 2 / sqrt(3) sinh(asinh(1.5 sqrt(3) u) / 3).
        roots = 2 / np.sqrt(3) * ca.sinh(ca.asinh(1.5 * np.sqrt(3) * load / e.torque) / 3)
        twists = [
            e[joint].compliance * e.torque * roots[i] if joint in gears else 0
            for i, joint in enumerate(mechanism.joints)
        ]
        return seen.with_q(seen.q + ca.vertcat(*twists))

    def scan(
        self, mechanism: Mechanism, recorded: Mapping[str, Any]
    ) -> Iterator[Mapping[str, float]]:
        """Return 1/4, 1/2 and 1 times the largest load that the recorded payload puts on a gear."""
        loads = estimate_joint_loads(mechanism)
        per_kg = max(abs(loads[mechanism.joints.index(gear)]) for gear in _find_gears(mechanism))
        largest = float(np.max(recorded["payload"])) * per_kg
        if largest > 0:
            yield from ({"torque": ratio * largest} for ratio in TORQUE_RATIOS)


def _find_gears(mechanism: Mechanism) -> list[str]:
    """Return the revolute joints that carry weight of the payload."""
    units = dict(zip(mechanism.joints, mechanism.joint_units, strict=True))
    return [joint for joint in find_loaded_joints(mechanism) if units[joint] == "rad"]
