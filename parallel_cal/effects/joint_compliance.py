"""Drives that deflect under load: shafts and gears twist, spindles are compressed."""

from __future__ import annotations

from parallel_cal.effects._statics import (
    compliances,
    find_loaded_joints,
    joint_forces,
    masses,
    needs_weight,
    twist,
)
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter


class JointCompliance(Effect):
    """q_ideal = q + compliance * torque, the torque (Nm or N) of the weights on the joint.

    The payload and `mass.platform` act at the origin of {P}. With phi(q, x, p) = 0 the torque is
    -(dphi/dq)^T lambda, (dphi/dx)^T lambda = the wrench of the weights; parts act on q and x.

    A leg that is shortened by the weight it carries is the same. That it sags under its own weight
    shortens its chord by 8 sag^2 / (3 length), far less: 0.24 um if a leg of 1 m sags by 0.3 mm.
    """

    needs = ("payload",)
    fixed = ("mass.*",)
    alike = ("*.compliance",)
    physics = "Between encoder and arm, a shaft twists in proportion to its torque."
    remedy = (
        "keep the correction in the model and enter the payload; a stiffer shaft or belt "
        "reduces the error"
    )
    source = "harmonic drives 1e-5..1e-4 rad/Nm, belts and thin shafts to 1e-3; screws 1e-8 m/N"
    lookalikes = ("rod_compliance", "payload_sag", "ball_joint_clearance", "own_weight_sag")
    separated_by = "several payloads in poses all over the workspace, including its edges"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return [*compliances(mechanism, find_loaded_joints(mechanism)), *masses(mechanism)]

    def applies(self, mechanism: Mechanism) -> str:
        return needs_weight(mechanism)

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        return twist(seen, e, joint_forces(seen, e, at, mechanism), mechanism)
