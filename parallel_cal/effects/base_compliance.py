"""A base that tilts under the robot's own weight, which the platform moves from side to side."""

from __future__ import annotations

import casadi as ca
import numpy as np

from parallel_cal.base.rotation import cayley
from parallel_cal.effects._frames import AXES, find_rotation_axes, find_translation_axes, vector
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter


class BaseCompliance(Effect):
    """r_shown = W r, R_shown = W R, W = exp(w), w_i = lean_i (r x g)_i / |g|.

    r x g / |g| (m) is the lever arm of the moving weight on {B}. `lean` (rad/m) is that weight
    times the rotational compliance of the base about axis i. If the weight changes, the tilt
    changes: that is `payload_sag`. Relative to its own base, the robot's poses are correct.

    The device shows the tilt of the base relative to its own stand. `lean` is negative if the base
    tilts away from the weight: the device stands on the same floor or table and tilts further, or
    an active isolation overcompensates.
    """

    of_device = True
    physics = "A light base or stand tilts towards the side to which the robot moves its weight."
    remedy = "bolt the base to something heavier, or move with lower acceleration"
    source = "10 kg on a stand of 1e-7..1e-5 rad/(N m): 1e-5..1e-3 rad/m"
    lookalikes = ("device_field", "device_axes", "payload_sag", "own_weight_sag")
    separated_by = "a second target on the base, measured at every pose"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        axes = _find_leaning_axes(mechanism)
        return [Parameter(f"lean_{a}", "rad/m", 0.0, 0.5e-3, low=-5e-3, high=5e-3) for a in axes]

    def applies(self, mechanism: Mechanism) -> str:
        return "" if _find_leaning_axes(mechanism) else "the platform does not move across gravity"

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        down = ca.DM(mechanism.gravity) / ca.norm_2(ca.DM(mechanism.gravity))
        upright = seen
        for _ in range(2):  # fixed point: the lever arm depends on the pose before tilting
            back = cayley(vector(e, "lean") * ca.cross(upright.r, down)).T
            upright = seen.with_pose(back @ seen.r, back @ seen.R)
        return upright


def _find_leaning_axes(mechanism: Mechanism) -> list[str]:
    """Return the axes about which the moving weight tilts the base and moves the platform."""
    ways = [np.eye(3)[AXES.index(a)] for a in find_translation_axes(mechanism)]
    levers = np.abs(np.cross(np.reshape(ways, (-1, 3)), mechanism.gravity)).sum(axis=0)
    return [
        a
        for a, lever in zip(AXES, levers, strict=True)
        if lever and a in find_rotation_axes(mechanism)
    ]
