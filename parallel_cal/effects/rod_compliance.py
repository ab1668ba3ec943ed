"""Rods that stretch under the weight they carry, with their ball joints."""

from __future__ import annotations

from parallel_cal.effects._statics import lengthen_rods, masses, needs_rods, rod_forces
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter


class RodCompliance(Effect):
    """L_ideal = L + compliance * tension for every rod, one compliance (m/N) for all.

    The tension (N) is the closure's multiplier of the rod's length, see `joint_compliance`.
    """

    needs = ("payload",)
    fixed = ("mass.*",)
    physics = "A rod and its two ball joints are springs: their length changes with the load."
    remedy = "enter the payload in the model; stiffer rods and joints reduce the error"
    source = "l/(EA) + 1/k: steel of 10 mm and 0.24 m 1.5e-8 m/N, ball joints 1e-8..1e-6 m/N"
    lookalikes = ("joint_compliance", "payload_sag", "ball_joint_clearance")
    separated_by = "several payloads at the edge of the workspace, where the rods are most inclined"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        own = Parameter("compliance", "m/N", 0.0, 1e-6, low=0.0, high=1e-5)
        return [own, *masses(mechanism)]

    def applies(self, mechanism: Mechanism) -> str:
        return needs_rods(mechanism)

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        tension = rod_forces(seen, e, at, mechanism)
        return lengthen_rods(seen, mechanism, e.compliance * tension)
