"""Planar five-bar: two cranks carry one point by two rods, 10 parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.units import DEGREE, MM
from parallel_cal.model.closed_form import joint_angles, two_circles
from parallel_cal.model.drawing import Line
from parallel_cal.model.mechanism import Home, Mechanism, Workspace
from parallel_cal.model.parameters import Named, Parameter, ParameterTable

CRANK, ROD = 100 * MM, 150 * MM
HEIGHT = float(CRANK * np.sin(60 * DEGREE) + np.sqrt(ROD**2 - CRANK**2))  # m: the point at home
SIDES = {"left": -1, "right": 1}
BODIES = {"base": ("*.x", "*.y"), "cranks": ("*.crank",), "rods": ("*.rod",)}


class FiveBar(Mechanism):
    """Planar robot: two driven cranks, and two rods that meet at the end point.

    The angles of the cranks are measured from the x axis.

    The option `switches` (rad) states the readings at which the cranks touch their homing switches.
    """

    joints = ("left", "right")
    moves = controls = ("x", "y")
    parameters = ParameterTable(
        Parameter(f"{side}.{name}", unit, nominal, tolerance, label=label)
        for side, sign in SIDES.items()
        for name, unit, nominal, tolerance, label in (
            ("x", "m", sign * 50 * MM, 0.2 * MM, "crank axis' x"),
            ("y", "m", 0.0, 0.2 * MM, "crank axis' y"),
            ("crank", "m", CRANK, 0.2 * MM, "crank length"),
            ("rod", "m", ROD, 0.2 * MM, "rod length"),
            ("q0", "rad", 0.0, 1 * DEGREE, "encoder offset"),
        )
    )
    home = Home(joints=(120 * DEGREE, 60 * DEGREE), position=(0.0, HEIGHT, 0.0))
    workspace = Workspace(low=(-40 * MM, 170 * MM), high=(40 * MM, 230 * MM))
    joint_limits = ((60 * DEGREE, 180 * DEGREE), (0.0, 120 * DEGREE))
    closed_forms = ("direct", "inverse")
    length = CRANK
    bodies = BODIES

    def __init__(self, switches: Sequence[float] = (180 * DEGREE, 0.0)):
        if len(switches) != 2:
            raise ModelError(f"{len(switches)} switches given, expected one for each crank, in rad")
        self.switches = tuple(map(float, switches))

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Compute the length error (|P - elbow|^2 - rod^2) / (2 rod) of each rod, in metres."""
        rows = [
            (ca.sumsqr(r[:2] - self.elbow(q[i], p[side])) - p[side].rod ** 2) / (2 * p[side].rod)
            for i, side in enumerate(SIDES)
        ]
        return ca.vertcat(*rows)

    @staticmethod
    def elbow(angle: Any, s: Named) -> Any:
        """Compute the point (2, 1) where crank and rod of one side meet."""
        turned = angle + s.q0
        return ca.vertcat(s.x + s.crank * ca.cos(turned), s.y + s.crank * ca.sin(turned))

    def rod_lengths(self, p: Named) -> list[Any]:
        return [p[side].rod for side in SIDES]

    def drawing(self, q: Any, r: Any, R: Any, p: Named) -> list[Line]:
        """Draw the base between the cranks' axes, cranks and rods."""
        axes = [ca.vertcat(p[side].x, p[side].y, 0) for side in SIDES]
        elbows = [ca.vertcat(self.elbow(q[i], p[side]), 0) for i, side in enumerate(SIDES)]
        lines = [Line("base", tuple(axes), ("*.x", "*.y"))]
        for side, axis, elbow in zip(SIDES, axes, elbows, strict=True):
            lines.append(Line("driven", (axis, elbow), (f"{side}.crank", f"{side}.q0")))
            lines.append(Line("rod", (elbow, r), (f"{side}.rod",)))
        return lines

    def candidates(self, q: Any, p: Named) -> list[tuple[Any, Any]]:
        """Intersect the rods' circles about both elbows, above their line and below it."""
        elbows = [self.elbow(q[i], p[side]) for i, side in enumerate(SIDES)]
        points = two_circles(elbows, [p.left.rod**2, p.right.rod**2])
        return [(ca.vertcat(point, 0), ca.DM.eye(3)) for point in points]

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """Find both angles of each crank (eq. 6.24)."""
        return joint_angles(self, r, R, p)
