"""Struts with a screw that is free to turn: their length changes as their joints turn them."""

from __future__ import annotations

import casadi as ca

from parallel_cal.effects._struts import FIXED_AXES, find_axes, list_axes, needs_struts
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter


class StrutRotation(Effect):
    """q_ideal = q - lead / (2 pi) * twist for every strut, lead positive for a right-hand thread.

    Universal joints hold both ends of a strut. Each has one axis that is fixed: `base` in {B},
    `platform` in {P}. The twist is the angle about u from the one to the other:
    sin(twist) = n3 . n2, n1 = b x u, n3 = unit(u x n1), n2 = unit((R a) x u), with the axes b and a
    and the unit vector u from foot to head. By default both axes are horizontal and perpendicular
    to the strut at home. A strut whose nut cannot turn has the lead 0.
    """

    depends_on_class = False
    fixed = FIXED_AXES
    physics = "Universal joints twist a tilting strut, which turns its screw within the nut."
    remedy = "keep the correction in the model, or guide the struts so that they cannot twist"
    source = "LinuxCNC genhexkins; Huang et al., Mech. Sci. 12 (2021) 1027: ball screws, lead 5 mm"
    lookalikes = ("universal_joint_offset", "screw_pitch_error", "encoder_crosstalk")
    separated_by = (
        "poses that turn the platform far about the vertical, both ways, and poses that only "
        "move it"
    )

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return [Parameter("lead", "m", 0.0, 5e-3, low=-50e-3, high=50e-3), *list_axes(mechanism)]

    def applies(self, mechanism: Mechanism) -> str:
        if why := needs_struts(mechanism):
            return why
        if {drive.kind for drive in mechanism.drives if drive} <= {"screw"}:
            return ""
        return "no screw moves its struts: the model file states other drives"

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        rows = []
        for i, (foot, head) in enumerate(mechanism.struts(seen.r, seen.R, seen.p)):
            b, a = find_axes(seen, e[mechanism.joints[i]])
            strut = head - foot
            u = strut / ca.norm_2(strut)
            across = ca.cross(u, ca.cross(b, u))  # b without its part along the strut
            twist = ca.atan2(ca.dot(across, ca.cross(a, u)), ca.dot(across, a))
            rows.append(seen.q[i] - e.lead / (2 * ca.pi) * twist)
        return seen.with_q(ca.vertcat(*rows))
