"""Universal joints whose two axes do not meet: the strut stands off the fixed axis."""

from __future__ import annotations

from typing import Any

import casadi as ca

from parallel_cal.effects._struts import FIXED_AXES, find_axes, list_axes, needs_struts
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter

STEPS = 4  # each reduces the error by the factor offset / length


class UniversalJointOffset(Effect):
    """q_ideal = q + |H - F| - |H - h - F - f| for every strut from foot F to head H.

    f = foot * unit(u - (u . b) b) and h = head * unit(u - (u . a) a), with the direction u of the
    strut and the fixed axes b and a of its joints (`base` in {B}, `platform` in {P}). `foot` and
    `head` (m) are the distances between the two axes of a joint, positive if the axis next to the
    strut is nearer to the strut's middle. By default the fixed axes are horizontal and
    perpendicular to the strut at home.
    """

    fixed = FIXED_AXES
    physics = "The two axes of a universal joint do not meet, so it has no fixed centre."
    remedy = "keep the correction in the model, or replace the joint"
    source = "Bem, Ude, Nemec 2025 (PMC12899874): to 0.1 mm by machining, 1-20 mm by design"
    lookalikes = ("encoder_crosstalk", "strut_rotation")
    separated_by = "poses that tilt every strut to both sides of its fixed axes"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return [
            *[
                Parameter(f"{joint}.{end}", "m", 0.0, 1e-3, low=-20e-3, high=20e-3)
                for joint in mechanism.joints
                for end in ("foot", "head")
            ],
            *list_axes(mechanism),
        ]

    def applies(self, mechanism: Mechanism) -> str:
        return needs_struts(mechanism)

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        rows = []
        for i, (foot, head) in enumerate(mechanism.struts(seen.r, seen.R, seen.p)):
            own = e[mechanism.joints[i]]
            b, a = find_axes(seen, own)
            straight = strut = head - foot
            for _ in range(STEPS):  # fixed point: the strut's direction depends on the offsets
                strut = straight - own.foot * _across(strut, b) - own.head * _across(strut, a)
            rows.append(seen.q[i] + (ca.norm_2(straight) - ca.norm_2(strut)))
        return seen.with_q(ca.vertcat(*rows))


def _across(strut: Any, axis: Any) -> Any:
    """Return the unit vector along the part of the strut that is perpendicular to the axis."""
    part = strut - ca.dot(strut, axis) * axis
    return part / ca.norm_2(part)
