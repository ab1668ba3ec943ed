"""Delta robot with perfect parallelograms, 24 parameters (eqs 3.13-3.16)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca

from parallel_cal.base.rotation import rot_x, rot_z
from parallel_cal.mechanisms._delta import POSITION, SizedDelta, chain_parameters
from parallel_cal.model.closed_form import joint_angles, positions
from parallel_cal.model.drawing import Line, axis, ring
from parallel_cal.model.parameters import Named

BODIES = {"arms": ("*.La_?",), "rods": ("*.Lb",), "base": ("*.D_?",)}


class Delta24(SizedDelta):
    """Delta robot with ideal parallelograms: the platform cannot rotate.

    Each parallelogram acts as one rod, and the three rods meet in one point of the platform.

    Options: `base`, `platform`, `arm`, `rod`, `direction`, `home`, `below` and `limits`, the size
    of the robot in m and rad. `base` and `platform` are the distances of the motor axes and of the
    rods' joints on the platform from the centre (0.1 and 0.024), `arm` and `rod` the lengths (0.12
    and 0.24). `direction` is that of the first motor about z, measured from x (0); the others
    follow at 120 and 240 degrees. `home` is the angle of all arms at home, positive towards +z
    (0.535). With `below: true` the platform is on the -z side of the arms: a hanging robot with z
    up (then `home` is -0.535). `limits` are those of the angles (-0.52 to 2.36, or -2.36 to 0.52
    with `below`). With any of them, the motors lie in the plane z = 0, and home and workspace
    follow from the size. Without options, the robot is that of table 5.12.

    `switches` (rad) are the readings at which the controller homes the joints (default: the upper
    limits).
    """

    moves = ("x", "y", "z")
    parameters = chain_parameters({"position": POSITION})
    closed_forms = ("direct", "inverse")
    bodies = BODIES
    parts = ("arm", "rod")

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Compute eq. 3.16 divided by 2 Lb: length error of each rod, in metres."""
        return ca.vertcat(*[self.rod(q[i], r, c) for i, c in enumerate(self.chains(p))])

    def chains(self, p: Named) -> list[Named]:
        """Return each chain's eight parameters."""
        return [p[f"chain{i + 1}"] for i in range(3)]

    @staticmethod
    def rod(angle: Any, r: Any, c: Named) -> Any:
        """Compute the closure row of one chain."""
        CB = r - Delta24.arm(angle, c)[1]
        return (ca.dot(CB, CB) - c.Lb**2) / (2 * c.Lb)

    @staticmethod
    def arm(angle: Any, c: Named) -> tuple[Any, Any]:
        """Compute both ends of one arm, hub and C, shifted by the platform's radius."""
        T = rot_z(c.theta) @ rot_x(c.alpha)
        D, La = c.vector("D_x", "D_y", "D_z"), ca.vertcat(c.La_x, c.La_y, 0)
        return T @ D, T @ (D + rot_z(angle) @ La)

    def drawing(self, q: Any, r: Any, R: Any, p: Named) -> list[Line]:
        """Draw motor axes, arms and the rods, which meet in one point: the platform has no size."""
        chains, hubs, lines = self.chains(p), [], []
        for i, c in enumerate(chains, start=1):
            (hub, C), own = self.arm(q[i - 1], c), f"chain{i}."
            along = (rot_z(c.theta) @ rot_x(c.alpha))[:, 2]
            hubs.append(hub)
            lines += [
                axis(hub, along, self.length, f"{own}theta", f"{own}alpha"),
                Line("driven", (hub, C), (f"{own}La_x", f"{own}La_y", "La")),
                Line("rod", (C, r), (f"{own}Lb", "Lb")),
            ]
        return [ring("base", hubs, "*.D_?", "R"), *lines]

    def rod_lengths(self, p: Named) -> list[Any]:
        """Return Lb for both rods of each pair."""
        return [c.Lb for c in self.chains(p) for _ in range(2)]

    def centres(self, q: Any, r: Any, R: Any, p: Named) -> Mapping[str, list[Any]]:
        """Return the middles of arms and rods, up to constant shifts."""
        arms = [self.arm(q[i], c) for i, c in enumerate(self.chains(p))]
        rods = [(C + r) / 2 for _, C in arms for _ in range(2)]
        return {"arm": [(hub + C) / 2 for hub, C in arms], "rod": rods}

    def candidates(self, q: Any, p: Named) -> list[tuple[Any, Any]]:
        """Find both solutions of the general position problem (eqs 6.25-6.26)."""
        return [(r, ca.DM.eye(3)) for r in positions(self, q, p)]

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """Find both solutions of each joint-angle problem (eqs 6.27-6.30)."""
        return joint_angles(self, r, R, p)

    def widen(self, values: Mapping[str, float]) -> tuple[str, dict[str, float]]:
        """Widen to model 54 with a perfect parallelogram (eq. 3.14) and the nominal platform."""
        return "delta54", dict(values)
