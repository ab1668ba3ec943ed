"""Joints that yield under the weight of the arm's own links."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import casadi as ca

from parallel_cal.effects._statics import (
    compliances,
    find_joints_loaded_by_links,
    find_self_loaded_joints,
    link_forces,
    own_weight_torques,
    twist,
)
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter

TOOLS = (0.0, 0.1, 0.2, 0.4, 0.8, 1.6)  # m; 0.8 m of a link of 10 kg/m weigh 8 kg


class OwnWeightSag(Effect):
    """q_ideal = q + sag * torque / w, for every revolute joint that carries links of the arm.

    `sag` (rad/m^2) is the compliance of the joint (rad/(N m)) times the weight of a metre of link,
    w (N/m). torque / w (m^2) is the torque, in the direction of the reading, of links that all
    weigh w per metre of their nominal length, with their centres half-way between their frames. A
    prismatic joint adds no length. Neither masses nor compliances have to be known.

    A tool that the arm always carries weighs w `tool` at the origin of {P}: `tool` (m) is the
    length of link of the same weight. It is known, or found by `scan`. The law is approximate if
    some links are heavier per metre than others; `tool` then differs from 0 without a tool, too.
    `joint_compliance` describes a payload that changes.

    The closed chain of a file knows the masses of its links. The effect is then q_ideal = q +
    compliance * torque, with the torque (Nm or N) of these masses by virtual work, as in
    `joint_compliance` without a payload. `tool` is then the mass (kg) of a tool at the origin of
    {P}, which the user states.
    """

    fixed = ("tool",)
    physics = "The weight of the robot's own links twists the shafts and gears of its joints."
    remedy = "keep the correction in the model; counterweights or stiffer joints reduce the error"
    source = "strain-wave gears 1e-5..1e-4 rad/(N m), links of 5..20 kg/m: 5e-4..2e-2 rad/m^2"
    lookalikes = ("base_compliance", "encoder_eccentricity", "joint_compliance")
    separated_by = "equal readings of a loaded joint, with the arm behind it bent and straight"
    told_from: ClassVar[Mapping[str, str]] = {
        "base_compliance": "a second target on the base, measured at every pose",
        "joint_compliance": "the same poses with and without the payload",
    }

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        if joints := _find_joints_of_known_links(mechanism):
            tool = Parameter("tool", "kg", 0.0, 1.0, low=0.0, high=1000.0)
            return [tool, *compliances(mechanism, joints)]
        return [
            Parameter("tool", "m", 0.0, 0.2, low=0.0, high=10.0),
            *[
                Parameter(f"{joint}.sag", "rad/m^2", 0.0, 5e-3, low=0.0, high=5e-2)
                for joint in find_self_loaded_joints(mechanism)
            ],
        ]

    def applies(self, mechanism: Mechanism) -> str:
        if find_self_loaded_joints(mechanism) or _find_joints_of_known_links(mechanism):
            return ""
        return (
            "it is no serial arm with a revolute joint that carries links, and no other robot with "
            "links of a known mass"
        )

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        if _find_joints_of_known_links(mechanism):
            return twist(seen, e, link_forces(seen, e.tool, mechanism), mechanism)
        torque = own_weight_torques(seen, mechanism, e.tool)
        sags = [e.get(f"{joint}.sag", 0) * torque[i] for i, joint in enumerate(mechanism.joints)]
        return seen.with_q(seen.q + ca.vertcat(*sags))

    def scan(
        self, mechanism: Mechanism, recorded: Mapping[str, Any]
    ) -> Iterator[Mapping[str, float]]:
        """Return no tool and tools of several weights; nothing to try if the masses are known."""
        if _find_joints_of_known_links(mechanism):
            yield {}
        else:
            yield from ({"tool": tool} for tool in TOOLS)


def _find_joints_of_known_links(mechanism: Mechanism) -> list[str]:
    """Return the joints that carry links with a known mass, of a robot that is no serial arm."""
    return [] if find_self_loaded_joints(mechanism) else find_joints_loaded_by_links(mechanism)
