"""Clearance of ball joints: a rod in tension reaches further than a rod in compression."""

from __future__ import annotations

import casadi as ca

from parallel_cal.effects._statics import lengthen_rods, masses, needs_rods, rod_forces
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter


class BallJointClearance(Effect):
    """L_ideal = L + play * tanh(tension / force) for every rod, with one `play` (m) for all.

    `play` is the clearance of both joints of a rod, from the centre to one side. `force` (N) is
    the tension that seats the joints; it is known, not identified. If every rod is always in
    tension (or compression) well beyond `force`, the clearance cannot be distinguished from the
    rods' lengths.
    """

    needs = ("payload",)
    fixed = ("mass.*", "force")
    physics = (
        "In a ball joint with clearance, the ball rests on the side to which the rod's "
        "force pushes it."
    )
    remedy = "replace or preload the ball joints; springs between paired rods take up the clearance"
    source = "clearance of ball joints, 5-50 um"
    lookalikes = ("rod_compliance", "joint_compliance", "payload_sag")
    separated_by = "small and large payloads that change rods from compression to tension"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return [
            Parameter("play", "m", 0.0, 20e-6, low=0.0, high=0.2e-3),
            Parameter("force", "N", 1.0, 1.0, low=0.1, high=10.0),
            *masses(mechanism),
        ]

    def applies(self, mechanism: Mechanism) -> str:
        return needs_rods(mechanism)

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        tension = rod_forces(seen, e, at, mechanism)
        return lengthen_rods(seen, mechanism, e.play * ca.tanh(tension / e.force))
