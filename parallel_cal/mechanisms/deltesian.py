"""Deltesian: two carriages on upright rails move the nozzle in x and z, and a bed moves in y, 11
parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import rot_x, rot_z
from parallel_cal.base.units import DEGREE, MM
from parallel_cal.mechanisms._controller import read_controller
from parallel_cal.mechanisms._size import read_limits, read_numbers
from parallel_cal.model.closed_form import two_circles
from parallel_cal.model.drawing import Line
from parallel_cal.model.mechanism import Home, Mechanism, Workspace
from parallel_cal.model.parameters import Named, Parameter, ParameterTable

WIDTH, ROD, HEIGHT, TRAVEL = 0.15, 0.22, 0.05, 0.2  # m
SIDES = {"left": -1, "right": 1}
BODIES = {"rails": ("*.x", "*.z"), "rods": ("*.rod",)}


class Deltesian(Mechanism):
    """Printer with two carriages on upright rails and a bed that moves across their plane.

    Each rod leads from a carriage to the nozzle. In the plane of x and z it gives one equation,
    `|r - b - C| = rod`, and a third one says that `r - b` is in this plane.

    - `C = (x + q sin(lean), z + q cos(lean))` is the carriage, less the place of the rod's joint on
      the effector.
    - `b = (q + q0) Rz(turn) Rx(lean) (0, 1, 0)` is the way of the bed. {B} is fixed to the bed.

    Options, in m: `width`, the distance of each rail from the nozzle in the middle, less that of
    the rod's joint on the effector (0.15); `rod`, the length (0.22); `height` of the nozzle at home
    (0.05); `travel` of the bed (0.2); `limits` of the carriages (default: from 0.1 m below home to
    half a rod above).

    `scale` and `switches` describe the controller, as for `linear_delta`.
    """

    joints = ("left", "right", "y")
    joint_unit = "m"
    moves = controls = ("x", "y", "z")
    closed_forms = ("direct", "inverse")
    bodies = BODIES

    def __init__(
        self,
        width: float = WIDTH,
        rod: float = ROD,
        height: float = HEIGHT,
        travel: float = TRAVEL,
        limits: Sequence[float] | None = None,
        scale: Sequence[float] | None = None,
        switches: Sequence[float] | None = None,
    ):
        size = read_numbers({"width": width, "rod": rod, "travel": travel})
        if not size["rod"] > size["width"]:
            raise ModelError(
                f"rod is {size['rod']:g} m: too short for rails {size['width']:g} m away; "
                "expected a longer rod"
            )
        self.scale, self.switches = read_controller(scale, switches, 3, "joint")
        rows = [
            row
            for side, sign in SIDES.items()
            for row in (
                (f"{side}.x", sign * size["width"], "rail's x"),
                (f"{side}.z", 0.0, "carriage's height at reading zero"),
                (f"{side}.lean", 0.0, "rail's lean towards x"),
                (f"{side}.rod", size["rod"], "rod length"),
            )
        ]
        rows += [("bed.turn", 0.0, "bed's way: turn about z"), ("bed.lean", 0.0, "bed's way: rise")]
        rows += [("bed.q0", 0.0, "reading's offset")]
        self.parameters = ParameterTable(
            Parameter(name, "rad", value, 0.5 * DEGREE, label=label)
            if name.endswith(("lean", "turn"))
            else Parameter(name, "m", value, 0.5 * MM, label=label)
            for name, value, label in rows
        )
        reading = float(height + np.sqrt(size["rod"] ** 2 - size["width"] ** 2))
        self.home = Home(joints=(reading, reading, 0.0), position=(0.0, 0.0, float(height)))
        given = (reading - 0.1, reading + size["rod"] / 2)
        ways = given if limits is None else read_limits(limits, "m")
        half = size["travel"] / 2
        self.joint_limits = (ways, ways, (-half, half))
        across = 0.4 * (size["rod"] - size["width"])
        box = np.array([across, half, 0.2 * size["rod"]])
        middle = np.array([0.0, 0.0, float(height)])
        self.workspace = Workspace.around(middle, 0.9 * box)
        self.length = size["width"]

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Compute the length error of each rod, and the bed's error along y, in metres."""
        at = self.in_plane(q, r, p)
        rows = []
        for i, side in enumerate(SIDES):
            rod = p[side].rod
            rows.append((ca.sumsqr(at[[0, 2]] - self.carriage(q[i], p[side])) - rod**2) / (2 * rod))
        return ca.vertcat(*rows, at[1])

    @staticmethod
    def carriage(q: Any, s: Named) -> Any:
        """Return x and z (2, 1) m of a carriage."""
        return ca.vertcat(s.x + q * ca.sin(s.lean), s.z + q * ca.cos(s.lean))

    def in_plane(self, q: Any, r: Any, p: Named) -> Any:
        """Return where the nozzle (3, 1) m is as seen from the rails; its y is 0 if all fits."""
        return r - (q[2] + p.bed.q0) * self.way(p)

    @staticmethod
    def way(p: Named) -> Any:
        """Return the direction (3, 1) of the bed's motion."""
        return (rot_z(p.bed.turn) @ rot_x(p.bed.lean))[:, 1]

    def rod_lengths(self, p: Named) -> list[Any]:
        return [p[side].rod for side in SIDES]

    def drawing(self, q: Any, r: Any, R: Any, p: Named) -> list[Line]:
        """Draw rails, rods and the way of the bed, as the bed sees them."""
        bed = (q[2] + p.bed.q0) * self.way(p)
        lines = []
        for i, side in enumerate(SIDES):
            ends = [
                self._place(self.carriage(limit, p[side])) + bed for limit in self.joint_limits[i]
            ]
            lines.append(Line("base", tuple(ends), (f"{side}.x", f"{side}.z", f"{side}.lean")))
            lines.append(
                Line("rod", (self._place(self.carriage(q[i], p[side])) + bed, r), (f"{side}.rod",))
            )
        foot = ca.vertcat(r[0], 0, 0)
        ways = [foot + limit * self.way(p) for limit in self.joint_limits[2]]
        return [*lines, Line("driven", tuple(ways), ("bed.*",))]

    @staticmethod
    def _place(point: Any) -> Any:
        return ca.vertcat(point[0], 0, point[1])

    def candidates(self, q: Any, p: Named) -> list[tuple[Any, Any]]:
        """Intersect the rods' circles about both carriages, below them and above."""
        centres = [self.carriage(q[i], p[side]) for i, side in enumerate(SIDES)]
        points = two_circles(centres, [p.left.rod**2, p.right.rod**2])
        bed = (q[2] + p.bed.q0) * self.way(p)
        return [(self._place(point) + bed, ca.DM.eye(3)) for point in points[::-1]]

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """Find both readings at which a rod reaches the nozzle, the higher one first."""
        way = self.way(p)
        along = r[1] / way[1]
        at = (r - along * way)[[0, 2]]
        found: list[tuple[Any, ...]] = []
        for side in SIDES:
            s = p[side]
            rail, away = ca.vertcat(ca.sin(s.lean), ca.cos(s.lean)), at - ca.vertcat(s.x, s.z)
            middle = ca.dot(away, rail)
            root = ca.sqrt(middle**2 - ca.sumsqr(away) + s.rod**2)
            found.append((middle + root, middle - root))
        return [*found, (along - p.bed.q0,)]
