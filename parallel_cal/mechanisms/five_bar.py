"""Planar five-bar: two cranks carry one point by two rods, 10 parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.units import DEGREE, MM
from parallel_cal.mechanisms._controller import read_one_per_joint
from parallel_cal.mechanisms._size import read_limits, read_numbers
from parallel_cal.model.closed_form import joint_angles, two_circles
from parallel_cal.model.drawing import Line
from parallel_cal.model.mechanism import Home, Mechanism, Workspace
from parallel_cal.model.parameters import Named, Parameter, ParameterTable

BASE, CRANK, ROD = 100 * MM, 100 * MM, 150 * MM
HEIGHT = float(CRANK * np.sin(60 * DEGREE) + np.sqrt(ROD**2 - CRANK**2))  # m: the point at home
SIDES = {"left": -1, "right": 1}
BODIES = {"base": ("*.x", "*.y"), "cranks": ("*.crank",), "rods": ("*.rod",)}


class FiveBar(Mechanism):
    """Planar robot: two driven cranks, and two rods that meet at the end point.

    The angles of the cranks are measured from the x axis.

    Options: `base`, the distance in m of the cranks' axes (0.1), which lie on the x axis; `crank`
    and `rod`, the lengths in m (0.1 and 0.15); `home`, the angles in rad of the left and of the
    right crank at home (2.09 and 1.05); `below`, true if the point is below the line through the
    elbows, on its -y side (default false); `limits` of both angles in rad (default 1.05 to 3.14 of
    the left crank and 0 to 2.09 of the right one; with another `home`, 1.05 to both sides of it).
    Home and workspace follow from them. `switches` (rad) are the readings at which the cranks touch
    their homing switches.
    """

    joints = ("left", "right")
    moves = controls = ("x", "y")
    parameters = ParameterTable(
        Parameter(f"{side}.{name}", unit, nominal, tolerance, label=label)
        for side, sign in SIDES.items()
        for name, unit, nominal, tolerance, label in (
            ("x", "m", sign * BASE / 2, 0.2 * MM, "crank axis' x"),
            ("y", "m", 0.0, 0.2 * MM, "crank axis' y"),
            ("crank", "m", CRANK, 0.2 * MM, "crank length"),
            ("rod", "m", ROD, 0.2 * MM, "rod length"),
            ("q0", "rad", 0.0, 1 * DEGREE, "encoder offset"),
        )
    )
    home = Home(joints=(120 * DEGREE, 60 * DEGREE), position=(0.0, HEIGHT, 0.0))
    workspace = Workspace(low=(-40 * MM, 170 * MM), high=(40 * MM, 230 * MM))
    joint_limits: tuple[tuple[float, float], ...] = (
        (60 * DEGREE, 180 * DEGREE),
        (0.0, 120 * DEGREE),
    )
    closed_forms = ("direct", "inverse")
    length = CRANK
    bodies = BODIES

    def __init__(
        self,
        switches: Sequence[float] = (180 * DEGREE, 0.0),
        base: float | None = None,
        crank: float | None = None,
        rod: float | None = None,
        home: Sequence[float] | None = None,
        below: bool = False,
        limits: Sequence[float] | None = None,
    ):
        if len(switches) != 2:
            raise ModelError(f"{len(switches)} switches given, expected one for each crank, in rad")
        self.switches = tuple(map(float, switches))
        if limits is not None:
            self.joint_limits = (read_limits(limits, "rad"),) * 2
        stated = {"base": base, "crank": crank, "rod": rod}
        stated = {name: value for name, value in stated.items() if value is not None}
        if not stated and home is None and not below:
            return
        size = {"base": BASE, "crank": CRANK, "rod": ROD} | read_numbers(stated)
        angles = np.array(
            FiveBar.home.joints if home is None else read_one_per_joint("home", home, 2, "crank")
        )
        nominal = {f"{side}.{part}": size[part] for side in SIDES for part in ("crank", "rod")}
        nominal |= {f"{side}.x": sign * size["base"] / 2 for side, sign in SIDES.items()}
        self.parameters = self.parameters.with_nominal(nominal)
        p = Named(self.parameters.names, ca.DM(self.parameters.nominal))
        pose = self.candidates(ca.DM(angles), p)[1 if below else 0][0]
        x, y = (round(float(v), 13) for v in pose.elements()[:2])
        if not np.isfinite([x, y]).all():
            raise ModelError(
                f"rod is {size['rod']:g} m: the rods do not meet at home, with the cranks at "
                f"{angles[0]:g} and {angles[1]:g} rad; expected longer rods"
            )
        self.home = Home(tuple(map(float, angles)), (x, y, 0.0))
        if home is not None and limits is None:
            self.joint_limits = tuple(
                (float(q) - 60 * DEGREE, float(q) + 60 * DEGREE) for q in angles
            )
        half = 0.25 * size["crank"]
        self.workspace = Workspace((x - half, y - half), (x + half, y + half))

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
