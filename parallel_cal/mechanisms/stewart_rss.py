"""Stewart platform with six rotary servos: a crank and a rod a leg (6-RSS), 66 parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.units import DEGREE
from parallel_cal.mechanisms._controller import read_one_per_joint, read_switches
from parallel_cal.mechanisms._servo_legs import ServoLegs, servo_leg
from parallel_cal.mechanisms._size import read_limits, read_numbers, rms_radius
from parallel_cal.mechanisms.stewart42 import Points, read_ends, ring
from parallel_cal.model.drawing import Line
from parallel_cal.model.drawing import ring as closed
from parallel_cal.model.mechanism import Home, Workspace
from parallel_cal.model.parameters import Named, ParameterTable

BASE_RADIUS, PLATFORM_RADIUS, HEIGHT, CRANK = 0.1, 0.08, 0.14, 0.03  # m
BASE_ANGLES = (-20, 20, 100, 140, 220, 260)
PLATFORM_ANGLES = (-50, 50, 70, 170, 190, 290)
BASE, PLATFORM = ring(BASE_RADIUS, BASE_ANGLES), ring(PLATFORM_RADIUS, PLATFORM_ANGLES)
LIMIT = 60 * DEGREE


class StewartRss(ServoLegs):
    """Stewart platform with rotary servos (6-RSS): each servo turns a crank that moves a rod.

    The axis of servo i passes through D (`legI.D_x`, ... in {B}). Its crank carries the ball C of
    a rod, and the other ball B of the rod is on the platform (`legI.B_x`, ... in {P}). Each leg
    gives one equation, `|r + R B - C| = rod`.

    - `C = D + T (crank cos(q + q0), 0, crank sin(q + q0))` with `T = Rz(theta) Rx(alpha)`:
      at q + q0 = 0 the crank is level and points in the direction theta about z. A positive
      reading raises it. The axis of the servo is parallel to `T (0, 1, 0)`.

    Options: `base` and `platform`, the six points D in {B} and B in {P}: (6, 3) in m, or a radius
    in m and six angles in degrees, such as `{radius: 0.1, angles: [-20, 20, 100, 140, 220, 260]}`
    (these are those of the default `base`; the platform has a radius of 0.08 m); `crank` in m
    (0.03); `rod` in m; `height` in m of the platform above {B} at home (0.14); `directions`,
    the six angles theta in degrees (default: tangential, to the side of the leg's ball B); `limits`
    of the readings in rad (-1.05 to 1.05); `tolerance` in m of all lengths (0.5 mm).

    If `height` or `rod` is missing, it follows from level cranks at home. With both, the readings
    at home follow from them.

    `switches` (rad) are the readings at which the controller homes the joints (default: the upper
    limits).
    """

    closed_forms = ("inverse",)

    def __init__(
        self,
        base: Points | None = None,
        platform: Points | None = None,
        crank: float = CRANK,
        rod: float | None = None,
        height: float | None = None,
        directions: Sequence[float] | None = None,
        limits: Sequence[float] = (-LIMIT, LIMIT),
        tolerance: float = 0.5e-3,
        switches: Sequence[float] | None = None,
    ):
        D, B = read_ends(base, platform, (BASE, PLATFORM))
        n = len(D)
        self.joints = tuple(f"leg{i + 1}" for i in range(n))
        size = read_numbers({"crank": crank, "tolerance": tolerance})
        if directions is None:
            side = np.where(D[:, 0] * B[:, 1] - D[:, 1] * B[:, 0] < 0, -1, 1)
            theta = np.arctan2(D[:, 1], D[:, 0]) + side * 90 * DEGREE
        else:
            theta = np.radians(read_one_per_joint("directions", directions, n, "leg"))
        level = D + size["crank"] * np.column_stack([np.cos(theta), np.sin(theta), 0 * theta])
        if height is None and rod is not None:
            rods = np.full(n, read_numbers({"rod": rod})["rod"])
            square = rods**2 - np.sum((B - level)[:, :2] ** 2, axis=1)
            if not (square > 0).all():
                raise ModelError(
                    f"rod is {rod!r} m: too short to reach from the level cranks to the platform; "
                    "expected a longer rod"
                )
            tall = float(np.mean(level[:, 2] - B[:, 2] + np.sqrt(square)))
        else:
            tall = read_numbers({"height": HEIGHT if height is None else height})["height"]
            spans = np.linalg.norm(B + [0, 0, tall] - level, axis=1)
            rods = spans if rod is None else np.full(n, read_numbers({"rod": rod})["rod"])
        # Rounded: the last bit of a root depends on the machine.
        tall, rods, theta = round(tall, 13), rods.round(13), theta.round(13)
        rows = zip(self.joints, D, theta, rods, B, strict=True)
        self.parameters = ParameterTable(
            parameter
            for leg, hub, direction, length, ball in rows
            for parameter in servo_leg(
                leg, hub, direction, size["crank"], length, ball, size["tolerance"]
            )
        )
        q = self.solve_home_readings(np.array([0.0, 0.0, tall])).round(11)
        if not np.isfinite(q).all():
            raise ModelError(
                f"rod {rod!r} m and height {height!r} m: the rod of "
                f"{self.joints[int(np.argmin(np.isfinite(q)))]} does not reach from its crank to "
                "the platform at home; expected another rod or height"
            )
        self.home = Home(tuple(map(float, q + 0.0)), (0.0, 0.0, tall))
        middle = np.array([0.0, 0.0, tall])
        self.workspace = Workspace.around(middle, 0.25 * size["crank"], (6 * DEGREE,) * 3)
        self.joint_limits = (read_limits(limits, "rad"),) * n
        self.switches = read_switches(switches, n, "leg")
        self.length = rms_radius(B)

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Compute the length error of each rod, in metres."""
        return self.rod_errors(q, r, R, p)

    def rods(self, q: Any, p: Named) -> tuple[list[Any], list[Any], list[Any]]:
        """Return the rods' ends C in {B} and B in {P}, (3, 1) each, and their lengths."""
        C, B = self.rod_ends(q, ca.DM.zeros(3), ca.DM.eye(3), p)
        return C, B, self.rod_lengths(p)

    def drawing(self, q: Any, r: Any, R: Any, p: Named) -> list[Line]:
        """Draw the base between the servos, cranks, rods and the platform."""
        hubs = [p[leg].vector("D_x", "D_y", "D_z") for leg in self.joints]
        tops = self.rod_ends(q, r, R, p)[1]
        return [
            closed("base", hubs, "*.D_?"),
            *self.drawn_legs(q, r, R, p),
            closed("platform", tops, "*.B_?"),
        ]
