"""Friction that grows with the load: the more a drive carries, the further it stays behind."""

from __future__ import annotations

import casadi as ca

from parallel_cal.effects._statics import find_loaded_joints, joint_forces, masses, needs_weight
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter

# unit: unit of the lag per load, tolerance, and upper bound of real drives
SIZE = {"rad": ("rad/(N m)", 2e-4, 2e-3), "m": ("m/N", 2e-7, 2e-6)}


class LoadFriction(Effect):
    """q_ideal = q - lag * |torque| * direction for every joint that carries weight.

    The direction is that of the joint's last motion. The torque (N m or N) is computed as in
    `joint_compliance`. A drive of the compliance c whose gear has the friction mu * |torque| has
    the lag c mu. Friction that does not depend on the load winds the drive up equally far at every
    load. Its error has the form of `backlash` or, after short moves, of `hysteresis`. For a drive
    with both kinds of friction, add both effects.
    """

    needs = ("direction", "payload")
    fixed = ("mass.*",)
    alike = ("*.lag",)
    generalizes = ("backlash",)  # which it is if the load hardly changes
    physics = (
        "Teeth, screws and bearings press harder under load, so that their friction holds an "
        "elastic drive further back."
    )
    remedy = (
        "balance the weight, approach all poses from one side, or keep the correction in the model "
        "and enter the payload"
    )
    source = "friction of 5-20 % of the load (arXiv 2410.08650), times the compliance of the drive"
    lookalikes = ("backlash", "hysteresis")
    separated_by = "the same poses approached from both directions under two or more payloads"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        units = dict(zip(mechanism.joints, mechanism.joint_units, strict=True))
        sizes = [(joint, *SIZE[units[joint]]) for joint in find_loaded_joints(mechanism)]
        return [
            *[
                Parameter(
                    f"{joint}.lag", unit, 0.0, tolerance, low=0.0, high=most, label="lag per load"
                )
                for joint, unit, tolerance, most in sizes
            ],
            *masses(mechanism),
        ]

    def applies(self, mechanism: Mechanism) -> str:
        return needs_weight(mechanism)

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        load = ca.fabs(joint_forces(seen, e, at, mechanism))
        lags = [
            e.get(f"{joint}.lag", 0) * load[i] * at["direction"][joint]
            for i, joint in enumerate(mechanism.joints)
        ]
        return seen.with_q(seen.q - ca.vertcat(*lags))
