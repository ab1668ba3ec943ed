"""A measuring device whose axes are not exactly square and not exactly to one scale."""

from __future__ import annotations

from itertools import combinations

import casadi as ca

from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter

AXES = "xyz"


class DeviceAxes(Effect):
    """r_ideal = r + E r, E upper triangular: scale_i on the diagonal, square_ij (rad) above it.

    square_ij is the tilt of the device's axis j towards i. The scale of the last axis is the
    standard for the others: a common scale of all axes cannot be distinguished from all lengths and
    the gains of prismatic joints.
    """

    of_device = True
    physics = (
        "The axes of a coordinate measuring machine are not square, and its scales have a "
        "wrong length."
    )
    remedy = (
        "have the device calibrated, or measure once more with the device rotated by 90 degrees"
    )
    source = (
        "10-50 urad and 10-50 um/m for machines in a workshop (ISO 10360 ball plate tests); "
        "to 1e-3 for cameras scaled by a printed target"
    )
    lookalikes = ("encoder_gain", "device_field", "base_compliance")
    separated_by = "the same poses with the device rotated by 90 degrees about the vertical"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        axes = _axes(mechanism)
        entries = [(f"scale_{a}", "1") for a in axes[:-1]]
        entries += [(f"square_{a}{b}", "rad") for a, b in combinations(axes, 2)]
        return [Parameter(name, unit, 0.0, 0.1e-3, low=-1e-3, high=1e-3) for name, unit in entries]

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        E = ca.SX(3, 3)
        for i, a in enumerate(AXES):
            E[i, i] = e.get(f"scale_{a}", 0)
            for j in range(i + 1, 3):
                E[i, j] = e.get(f"square_{a}{AXES[j]}", 0)
        return seen.with_pose(seen.r + E @ seen.r, seen.R)

    def applies(self, mechanism: Mechanism) -> str:
        return "" if len(_axes(mechanism)) > 1 else "the platform moves along fewer than two axes"


def _axes(mechanism: Mechanism) -> list[str]:
    return [a for a in AXES if a in mechanism.moves]
