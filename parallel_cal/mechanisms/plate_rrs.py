"""Plate on three cranks with hinged rods and ball joints (3-RRS), 39 parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import rot_x, rot_y, rot_z
from parallel_cal.base.units import DEGREE
from parallel_cal.mechanisms._size import read_limits, read_numbers
from parallel_cal.mechanisms._swing_legs import CHAINS, SwingLegs, chain_tables, hinge_axis
from parallel_cal.model.closed_form import joint_angles
from parallel_cal.model.drawing import Line, axis
from parallel_cal.model.mechanism import Home
from parallel_cal.model.parameters import Named, ParameterTable

BASE, CRANK, ROD, PLATFORM, HOME = 0.08, 0.06, 0.1, 0.1, 20 * DEGREE  # m, rad
DRIVE = {
    "D_x": ("m", "motor axis' distance from the centre"),
    "D_y": ("m", "crank's shift along the motor axis"),
    "D_z": ("m", "motor axis' height"),
    "theta": ("rad", "motor axis' turn about z"),
    "alpha": ("rad", "motor axis' tilt"),
    "crank": ("m", "crank length"),
    "q0": ("rad", "encoder offset"),
}
BODIES = {
    "rods": ("*.rod",),
    "cranks": ("*.crank",),
    "base": ("*.D_?",),
    "platform": ("*.B_?",),
}


class PlateRrs(SwingLegs):
    """Plate on three cranks (3-RRS), such as a ball balancing plate: hinged rods, and balls.

    The plate moves along z and tilts about x and y. It also moves a little in x, y and rz. Each rod
    swings about a hinge of its crank, so that its ball stays in a plane. Each chain gives two
    equations, `|r + R T B - E| = rod` and `n . (r + R T B - E) = 0`.

    - `T = Rz(direction + (i - 1) 120 degrees)` turns the chain's frame to {B}. In this frame, x
      points outwards, y is along the axes and z points up.
    - `K = T Rz(theta) Rx(alpha) Ry(-(q + q0))` turns with the crank: at q + q0 = 0 the crank is
      level and points outwards. A positive reading raises it.
    - `E = T D + K (crank, 0, 0)` is the hinge of the rod, and `n = K Rz(gamma) Rx(delta) (0, 1, 0)`
      the direction of its axis.

    Options: `base` and `platform`, the distances in m of the motor axes and of the plate's balls
    from the centre (0.08 and 0.1); `crank` and `rod`, the lengths in m (0.06 and 0.1); `home`, the
    angle in rad of all cranks at home (0.35); `direction` in rad of the first chain about z,
    measured from x (0); `limits` of the readings in rad (-0.7 to 1.57). The plate is above the
    cranks.

    `switches` (rad) are the readings at which the controller homes the joints (default: the upper
    limits).
    """

    bodies = BODIES
    parts = ("crank", "rod")

    def __init__(
        self,
        base: float = BASE,
        platform: float = PLATFORM,
        crank: float = CRANK,
        rod: float = ROD,
        home: float = HOME,
        direction: float = 0.0,
        limits: Sequence[float] = (-40 * DEGREE, 90 * DEGREE),
        switches: Sequence[float] | None = None,
    ):
        stated = {"base": base, "platform": platform, "crank": crank, "rod": rod}
        size, angle = read_numbers(stated), float(home)
        self.direction = float(direction)
        nominal = {"D_x": size["base"], "B_x": size["platform"]}
        nominal |= {"crank": size["crank"], "rod": size["rod"]}
        self.parameters = ParameterTable(chain_tables(DRIVE, nominal))
        out = size["base"] + size["crank"] * np.cos(angle) - size["platform"]
        if not size["rod"] > abs(out):
            raise ModelError(
                f"rod is {size['rod']:g} m: too short for hinges {abs(out):.6g} m away from the "
                "balls of the plate at home; expected a longer rod, or another angle home"
            )
        rise = np.sqrt(size["rod"] ** 2 - out**2)
        height = round(float(size["crank"] * np.sin(angle) + rise), 13)
        self.home = Home(joints=(angle,) * 3, position=(0.0, 0.0, height))
        self.joint_limits = (read_limits(limits, "rad"),) * 3
        self.length = size["platform"]
        self.set_up(height, 10 * DEGREE, 0.25 * size["crank"], switches)

    def hinge(self, i: int, q: Any, c: Named) -> tuple[Any, Any]:
        """Return the hinge at the end of the crank and its axis."""
        K = rot_z(c.theta) @ rot_x(c.alpha) @ rot_y(-(q + c.q0))
        return c.vector("D_x", "D_y", "D_z") + K[:, 0] * c.crank, K @ hinge_axis(c)

    def centres(self, q: Any, r: Any, R: Any, p: Named) -> Mapping[str, list[Any]]:
        """Return the middles of cranks and rods."""
        cranks = []
        for i, (E, _, _) in enumerate(self.hinges(q, r, R, p)):
            cranks.append((E + self.frame(i) @ p[CHAINS[i]].vector("D_x", "D_y", "D_z")) / 2)
        return {"crank": cranks, **super().centres(q, r, R, p)}

    def drawn_drive(self, i: int, q: Any, p: Named) -> list[Line]:
        """Draw the axis of the motor and the crank."""
        own, T = CHAINS[i], self.frame(i)
        c = p[own]
        D, E = T @ c.vector("D_x", "D_y", "D_z"), T @ self.hinge(i, q[i], c)[0]
        along = T @ (rot_z(c.theta) @ rot_x(c.alpha))[:, 1]
        return [
            Line("base", (ca.vertcat(0, 0, D[2]), D), (f"{own}.D_?",)),
            axis(D, along, 0.15 * self.length, f"{own}.theta", f"{own}.alpha"),
            Line("driven", (D, E), (f"{own}.crank", f"{own}.q0")),
        ]

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """Find both angles at which a rod reaches its ball (eq. 6.24)."""
        return joint_angles(self, r, R, p)
