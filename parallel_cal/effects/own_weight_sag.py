"""Joints that yield under the weight of the arm's own links."""

from __future__ import annotations

import casadi as ca

from parallel_cal.effects._statics import find_self_loaded_joints, own_weight_torques
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter


class OwnWeightSag(Effect):
    """q_ideal = q + sag * torque / w, for every revolute joint that carries links of the arm.

    `sag` (rad/m^2) is the compliance of the joint times the weight of a metre of link, w (N/m), and
    torque / w (m^2) is the torque of links of one weight per metre, with their centres half-way
    between the frames of the model. Neither masses nor compliances have to be known. Lengths are
    nominal, a prismatic joint adds none.

    The law is approximate where the links' weights per metre differ, or if the arm carries a tool:
    each joint's `sag` is then that of the weight it carries most of. A payload that changes is
    `joint_compliance`.
    """

    physics = "The arm's own links twist shafts and gears between the encoders and the links."
    remedy = "keep the correction in the model; counterweights or stiffer joints reduce the error"
    source = "strain-wave gears 1e-5..1e-4 rad/(N m), links of 5..20 kg/m: 5e-4..2e-2 rad/m^2"
    lookalikes = ("base_compliance", "encoder_eccentricity", "joint_compliance")
    separated_by = "a target on every link, or the same poses with a second, known payload"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return [
            Parameter(f"{joint}.sag", "rad/m^2", 0.0, 5e-3, low=0.0, high=5e-2)
            for joint in find_self_loaded_joints(mechanism)
        ]

    def applies(self, mechanism: Mechanism) -> str:
        if find_self_loaded_joints(mechanism):
            return ""
        return "it is no serial arm with a revolute joint that carries links"

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        torque = own_weight_torques(seen, mechanism)
        sags = [e.get(f"{joint}.sag", 0) * torque[i] for i, joint in enumerate(mechanism.joints)]
        return seen.with_q(seen.q + ca.vertcat(*sags))
