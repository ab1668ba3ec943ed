"""A measuring device whose space is distorted: refracted light, slides that are not straight."""

from __future__ import annotations

from itertools import combinations_with_replacement

import casadi as ca

from parallel_cal.effects._frames import AXES, find_translation_axes
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter


class DeviceField(Effect):
    """r_ideal_i = r_i + sum over j <= k of i_jk s_j s_k, s = r - home's position (m).

    The second order of any smooth error of the device (i_jk in 1/m); the first is `device_axes`.
    """

    of_device = True
    physics = (
        "Air that is warmer at the top bends a beam; slides that are not straight bend an axis."
    )
    remedy = (
        "keep the air temperature even and the beam short; have the device calibrated over "
        "its volume"
    )
    source = "1 K/m bends light by 0.5 um/m^2; slides and cameras by 10-100 um over a metre"
    lookalikes = ("device_axes", "base_compliance")
    separated_by = "the same poses with the device moved sideways or rotated by 90 degrees"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        axes = find_translation_axes(mechanism)
        return [
            Parameter(f"{i}_{j}{k}", "1/m", 0.0, 0.5e-3, low=-5e-3, high=5e-3)
            for i in axes
            for j, k in combinations_with_replacement(axes, 2)
        ]

    def applies(self, mechanism: Mechanism) -> str:
        return (
            ""
            if len(find_translation_axes(mechanism)) > 1
            else "the platform moves along fewer than two axes"
        )

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        away = seen.r - ca.DM(mechanism.home.position)
        s = dict(zip(AXES, ca.vertsplit(away), strict=True))
        bent = [
            sum(e.get(f"{i}_{j}{k}", 0) * s[j] * s[k] for j in AXES for k in AXES) for i in AXES
        ]
        return seen.with_pose(seen.r + ca.vertcat(*bent), seen.R)
