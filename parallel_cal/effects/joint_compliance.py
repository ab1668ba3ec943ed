"""Drives that deflect under load: shafts and gears twist, spindles are compressed."""

from __future__ import annotations

import casadi as ca

from parallel_cal.effects._statics import find_loaded_joints, joint_forces, masses, needs_weight
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter

# unit: unit of the compliance, tolerance, and upper bound of real drives
SIZE = {"rad": ("rad/(N m)", 1e-3, 1e-2), "m": ("m/N", 1e-6, 1e-5)}


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
        units = dict(zip(mechanism.joints, mechanism.joint_units, strict=True))
        sizes = [(joint, *SIZE[units[joint]]) for joint in find_loaded_joints(mechanism)]
        return [
            *[
                Parameter(f"{joint}.compliance", unit, 0.0, tolerance, low=0.0, high=most)
                for joint, unit, tolerance, most in sizes
            ],
            *masses(mechanism),
        ]

    def applies(self, mechanism: Mechanism) -> str:
        return needs_weight(mechanism)

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        torque = joint_forces(seen, e, at, mechanism)
        twists = [
            e.get(f"{joint}.compliance", 0) * torque[i] for i, joint in enumerate(mechanism.joints)
        ]
        return seen.with_q(seen.q + ca.vertcat(*twists))
