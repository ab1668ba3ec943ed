"""Legs with a servo: a crank that carries a ball, a rod, and a ball on the platform (R-S-S)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.rotation import rot_x, rot_z
from parallel_cal.base.units import DEGREE
from parallel_cal.model.closed_form import joint_angles
from parallel_cal.model.drawing import Line, axis
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter

BODIES = {"base": ("*.D_?",), "platform": ("*.B_?",), "cranks": ("*.crank",), "rods": ("*.rod",)}


def servo_leg(
    leg: str, hub: Any, direction: float, crank: float, rod: float, ball: Any, tolerance: float
) -> list[Parameter]:
    """Make the parameters of one leg: the hub D in {B} and the ball B in {P}, (3,) m; `direction`
    (rad) about z of the level crank at reading zero."""
    rows = [
        *((f"D_{a}", "m", v, f"crank axis' {a}") for a, v in zip("xyz", hub, strict=True)),
        ("theta", "rad", direction, "crank's direction about z"),
        ("alpha", "rad", 0.0, "crank axis' tilt"),
        ("q0", "rad", 0.0, "encoder offset"),
        ("crank", "m", crank, "crank length"),
        ("rod", "m", rod, "rod length"),
        *((f"B_{a}", "m", v, f"platform joint's {a}") for a, v in zip("xyz", ball, strict=True)),
    ]
    sizes = {"m": tolerance, "rad": 1 * DEGREE}
    return [Parameter(f"{leg}.{n}", u, float(v), sizes[u], label=label) for n, u, v, label in rows]


def rod_length_errors(rods: Sequence[Any], C: Sequence[Any], B: Sequence[Any]) -> Any:
    """Compute (|B - C|^2 - rod^2) / (2 rod) of each rod between points C and B, in metres."""
    ends = zip(rods, C, B, strict=True)
    return ca.vertcat(*((ca.sumsqr(b - c) - rod**2) / (2 * rod) for rod, c, b in ends))


class ServoLegs(Mechanism):
    """Mechanisms whose legs are servo cranks with rods; the joints have the names of the legs."""

    bodies: Mapping[str, tuple[str, ...]] = BODIES
    parts = ("crank", "rod")

    def rod_errors(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Compute the length error (|r + R B - C|^2 - rod^2) / (2 rod) of each leg, in metres."""
        return rod_length_errors([p[leg].rod for leg in self.joints], *self.rod_ends(q, r, R, p))

    def rod_ends(self, q: Any, r: Any, R: Any, p: Named) -> tuple[list[Any], list[Any]]:
        """Return the ends of the rods in {B}, (3, 1) each: C on the cranks, B on the platform."""
        legs = [p[leg] for leg in self.joints]
        C = [self.crank_ball(q[i], c) for i, c in enumerate(legs)]
        return C, [r + R @ c.vector("B_x", "B_y", "B_z") for c in legs]

    @staticmethod
    def crank_ball(angle: Any, c: Named) -> Any:
        """Compute C (3, 1) in {B}: a positive reading raises the crank."""
        turned = angle + c.q0
        arm = ca.vertcat(c.crank * ca.cos(turned), 0, c.crank * ca.sin(turned))
        return c.vector("D_x", "D_y", "D_z") + rot_z(c.theta) @ rot_x(c.alpha) @ arm

    def rod_lengths(self, p: Named) -> list[Any]:
        return [p[leg].rod for leg in self.joints]

    def centres(self, q: Any, r: Any, R: Any, p: Named) -> Mapping[str, list[Any]]:
        """Return the middles of cranks and rods."""
        C, B = self.rod_ends(q, r, R, p)
        hubs = [p[leg].vector("D_x", "D_y", "D_z") for leg in self.joints]
        return {
            "crank": [(hub + c) / 2 for hub, c in zip(hubs, C, strict=True)],
            "rod": [(c + b) / 2 for c, b in zip(C, B, strict=True)],
        }

    def drawn_legs(self, q: Any, r: Any, R: Any, p: Named) -> list[Line]:
        """Draw the axis, the crank and the rod of each leg."""
        lines = []
        for leg, C, B in zip(self.joints, *self.rod_ends(q, r, R, p), strict=True):
            c = p[leg]
            hub, along = c.vector("D_x", "D_y", "D_z"), (rot_z(c.theta) @ rot_x(c.alpha))[:, 1]
            lines += [
                axis(hub, along, 0.15 * self.length, f"{leg}.theta", f"{leg}.alpha"),
                Line("driven", (hub, C), (f"{leg}.crank", f"{leg}.q0")),
                Line("rod", (C, B), (f"{leg}.rod",)),
            ]
        return lines

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """Find both angles of each crank (eq. 6.24)."""
        return joint_angles(self, r, R, p)

    def solve_home_readings(self, position: np.ndarray) -> np.ndarray:
        """Return the nominal readings (n,) nearest to zero at a position of the level platform."""
        p = Named(self.parameters.names, ca.DM(self.parameters.nominal))
        both = np.array(
            [
                [float(q) for q in pair]
                for pair in joint_angles(self, ca.DM(position), ca.DM.eye(3), p)
            ]
        )
        both = (both + np.pi) % (2 * np.pi) - np.pi
        return np.where(np.abs(both[:, 0]) <= np.abs(both[:, 1]), both[:, 0], both[:, 1])
