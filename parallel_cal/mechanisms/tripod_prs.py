"""Tripod with three carriages on rails, hinged rods and ball joints (3-PRS), 33 parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import rot_x, rot_y
from parallel_cal.base.units import DEGREE
from parallel_cal.mechanisms._controller import read_scale
from parallel_cal.mechanisms._size import read_limits, read_numbers
from parallel_cal.mechanisms._swing_legs import CHAINS, SwingLegs, chain_tables, hinge_axis
from parallel_cal.model.drawing import Line
from parallel_cal.model.mechanism import Home
from parallel_cal.model.parameters import Named, ParameterTable

BASE, PLATFORM, ROD, HEIGHT = 0.15, 0.1, 0.2, 0.1  # m
DRIVE = {
    "D_x": ("m", "hinge's distance from the centre at reading zero"),
    "D_y": ("m", "hinge's shift along its axis"),
    "D_z": ("m", "hinge's height at reading zero"),
    "alpha": ("rad", "rail's tilt about x"),
    "beta": ("rad", "rail's tilt about y"),
}
BODIES = {"rods": ("*.rod",), "base": ("*.D_?",), "platform": ("*.B_?",)}


class TripodPrs(SwingLegs):
    """Tripod (3-PRS): three carriages on rails, hinged rods, and balls on the platform.

    The platform moves along z and tilts about x and y. It also moves a little in x, y and rz. Each
    rod swings about a hinge of its carriage, so that its ball stays in a plane. Each chain gives
    two equations, `|r + R T B - E| = rod` and `n . (r + R T B - E) = 0`.

    - `T = Rz(direction + (i - 1) 120 degrees)` turns the chain's frame to {B}. In this frame, x
      points outwards, y is along the hinge and z points up.
    - `E = T (D + q Ry(inclination) Rx(alpha) Ry(beta) (0, 0, 1))` is the hinge on the carriage,
      and `n = T Rz(gamma) Rx(delta) (0, 1, 0)` the direction of its axis.

    Options: `base` and `platform`, the distances in m of the hinges at reading zero and of the
    platform's balls from the centre (0.15 and 0.1); `rod`, the length in m of the rods (0.2);
    `height` in m of the platform at home (0.1); `above`, true if the platform is above the
    carriages (default false); `inclination` in rad by which the rails lean outwards from the
    vertical (0); `direction` in rad of the first chain about z, measured from x (0); `limits` of
    the readings in m (default: half a rod to both sides of home).

    `scale` and `switches` describe the controller, as for `linear_delta`.
    """

    joint_unit = "m"
    bodies = BODIES

    def __init__(
        self,
        base: float = BASE,
        platform: float = PLATFORM,
        rod: float = ROD,
        height: float = HEIGHT,
        above: bool = False,
        inclination: float = 0.0,
        direction: float = 0.0,
        limits: Sequence[float] | None = None,
        scale: Sequence[float] | None = None,
        switches: Sequence[float] | None = None,
    ):
        size = read_numbers({"base": base, "platform": platform, "rod": rod})
        self.inclination, self.direction = float(inclination), float(direction)
        self.scale = None if scale is None else read_scale(scale, 3)
        nominal = {"D_x": size["base"], "B_x": size["platform"], "rod": size["rod"]}
        self.parameters = ParameterTable(chain_tables(DRIVE, nominal))
        # Where the rail meets the circle of the rod about the ball, in the plane of x and z.
        away = np.array([size["base"] - size["platform"], -float(height)])
        along = float(away @ [np.sin(self.inclination), np.cos(self.inclination)])
        square = along**2 - away @ away + size["rod"] ** 2
        if not square > 0:
            raise ModelError(
                f"rod is {size['rod']:g} m: too short to reach from the rails to the platform, "
                f"{abs(away[0]):g} m further inside; expected a longer rod"
            )
        reading = round(float(-along + (-1 if above else 1) * np.sqrt(square)), 13)
        self.home = Home(joints=(reading,) * 3, position=(0.0, 0.0, float(height)))
        half = size["rod"] / 2
        given = (reading - half, reading + half) if limits is None else read_limits(limits, "m")
        self.joint_limits = (given,) * 3
        self.length = size["platform"]
        self.set_up(float(height), 15 * DEGREE, 0.25 * size["rod"], switches)

    def hinge(self, i: int, q: Any, c: Named) -> tuple[Any, Any]:
        """Return the hinge on the carriage and its axis."""
        return c.vector("D_x", "D_y", "D_z") + q * self.rail(c), hinge_axis(c)

    def rail(self, c: Named) -> Any:
        """Direction of a rail in the chain's frame."""
        return (rot_y(self.inclination) @ rot_x(c.alpha) @ rot_y(c.beta))[:, 2]

    def drawn_drive(self, i: int, q: Any, p: Named) -> list[Line]:
        """Draw the rail between its limits."""
        c, T = p[CHAINS[i]], self.frame(i)
        D = c.vector("D_x", "D_y", "D_z")
        ends = [T @ (D + limit * self.rail(c)) for limit in self.joint_limits[i]]
        own = CHAINS[i]
        return [Line("base", tuple(ends), (f"{own}.D_?", f"{own}.alpha", f"{own}.beta"))]

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """Find both readings at which a rod reaches its ball, the higher one first."""
        found = []
        for i, (E, _, B) in enumerate(self.hinges(ca.DM.zeros(3), r, R, p)):
            c = p[CHAINS[i]]
            along = ca.dot(B - E, self.frame(i) @ self.rail(c))
            root = ca.sqrt(along**2 - ca.sumsqr(B - E) + c.rod**2)
            found.append((along + root, along - root))
        return found
