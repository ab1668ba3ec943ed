"""Linear Delta 3[P(2S/2S)], complete calibration model with 48 parameters (table 3.1)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import rot_x, rot_y, rot_z
from parallel_cal.base.units import DEGREE, MM
from parallel_cal.mechanisms._controller import read_scale, read_switches
from parallel_cal.mechanisms._delta import pair_errors, pair_lengths, rod_pairs
from parallel_cal.mechanisms._size import read_limits, read_numbers
from parallel_cal.model.closed_form import positions
from parallel_cal.model.drawing import Line
from parallel_cal.model.mechanism import Home, Mechanism, Workspace
from parallel_cal.model.parameters import Named, Parameter, ParameterTable

OFFSET, ROD, LOW = 100 * MM, 250 * MM, 100 * MM  # rail to rod plane, rod, platform at home
PLATFORM = 30 * MM

# In the chain's frame: x outwards, y along the rod pair's bar, z up. The pairs are written as
# mean and half difference, as in model 54. name: unit, nominal, tolerance, group.
CHAIN = {
    "D_x": ("m", OFFSET, 1 * MM, "position"),  # carriage at reading zero, less the platform's b
    "D_y": ("m", 0.0, 1 * MM, "position"),
    "D_z": ("m", 0.0, 1 * MM, "position"),
    "alpha": ("rad", 0.0, 0.5 * DEGREE, "position"),  # tilt of the rail about x, then y
    "beta": ("rad", 0.0, 0.5 * DEGREE, "position"),
    "Lb": ("m", ROD, 0.5 * MM, "position"),
    "dC_x": ("m", 0.0, 0.2 * MM, "P1"),  # carriage's half bar less the platform's
    "dC_y": ("m", 0.0, 0.2 * MM, "P1"),
    "dC_z": ("m", 0.0, 0.2 * MM, "P1"),
    "dLb": ("m", 0.0, 0.1 * MM, "P1"),
    "d_x": ("m", 0.0, 0.2 * MM, "P2"),  # the platform's half bar and where it sits
    "d_y": ("m", 25 * MM, 0.2 * MM, "P2"),
    "d_z": ("m", 0.0, 0.2 * MM, "P2"),
    "b_x": ("m", PLATFORM, 0.2 * MM, "P2"),
    "b_y": ("m", 0.0, 0.2 * MM, "P2"),
    "b_z": ("m", 0.0, 0.2 * MM, "P2"),
}
RAIL = ("D_?", "alpha", "beta")
BODIES = {"rods": ("*.Lb", "*.dLb"), "base": ("*.D_?", "*.b_?")}  # with the platform


class LinearDelta(Mechanism):
    """Delta robot with three carriages on rails and six rods, each with its own length.

    Position and orientation of the platform vary.

    Options: `base` and `platform`, the distances in m of the carriages' joints at reading zero and
    of the platform's joints from the centre (0.13 and 0.03); `rod`, the length in m of the rods
    (0.25); `height` in m of the platform at home (0.1); `limits` of the readings in m (0 to 0.6;
    with another size, up to one rod above home). Home and workspace follow from them. The carriages
    are above the platform.

    `inclination` (rad) is the angle by which the rails lean outwards from the vertical;
    `direction` (rad) is the angle of the first rail about z, measured from x. Both are 0 by
    default: vertical rails, the first of them on the x axis. The others follow at 120 and 240
    degrees.
    `scale` describes the controller with which the joints were recorded: how many steps or turns of
    its motor make a joint's reading 1 m longer, one number for each joint (default: unknown). An
    export for this controller starts from it. `switches` are the readings in m at which it homes
    the joints (default: the upper limits).
    """

    joints = ("joint1", "joint2", "joint3")
    joint_unit = "m"
    controls = ("x", "y", "z")
    parameters = ParameterTable(
        Parameter(f"chain{i + 1}.{name}", *numbers)
        for i in range(3)
        for name, numbers in CHAIN.items()
    )
    fixed = tuple(f"*.{name}" for name, numbers in CHAIN.items() if numbers[3] == "P2")
    workspace = Workspace(low=(-0.06, -0.06, 0.02), high=(0.06, 0.06, 0.18))
    joint_limits = ((0.0, 0.6),) * 3
    length = 25 * MM
    bodies = BODIES

    def __init__(
        self,
        inclination: float = 0.0,
        direction: float = 0.0,
        scale: Sequence[float] | None = None,
        base: float | None = None,
        platform: float | None = None,
        rod: float | None = None,
        height: float = LOW,
        limits: Sequence[float] | None = None,
        switches: Sequence[float] | None = None,
    ):
        self.inclination, self.direction = float(inclination), float(direction)
        self.scale = None if scale is None else read_scale(scale, len(self.joints))
        self.switches = read_switches(switches, len(self.joints))
        # At reading q the carriage is pushed out by q sin(inclination). Solve for the rod's length.
        lean = np.array([np.sin(self.inclination), np.cos(self.inclination)])
        stated = {"base": base, "platform": platform, "rod": rod}
        stated = {name: value for name, value in stated.items() if value is not None}
        size = {"base": OFFSET + PLATFORM, "platform": PLATFORM, "rod": ROD}
        size |= read_numbers(stated, may_be_zero=("platform",))
        offset, long = round(size["base"] - size["platform"], 13), size["rod"]
        away = np.array([offset, -float(height)])
        along = float(away @ lean)
        square = along**2 - away @ away + long**2
        if not square > 0:
            raise ModelError(
                f"rod is {long:g} m: too short for a platform {offset:g} m inside the rails; "
                "expected a longer rod"
            )
        reading = float(-along + np.sqrt(square))
        self.home = Home(joints=(reading,) * 3, position=(0.0, 0.0, float(height)))
        if limits is not None:
            self.joint_limits = (read_limits(limits, "m"),) * 3
        if not stated and height == LOW:
            return
        numbers = {"D_x": offset, "b_x": size["platform"], "Lb": long}
        self.parameters = self.parameters.with_nominal(
            {f"chain{i}.{name}": value for i in (1, 2, 3) for name, value in numbers.items()}
        )
        if limits is None:
            self.joint_limits = ((min(0.0, reading - long), reading + long),) * 3
        reach, middle = abs(offset) * np.array([0.6, 0.6, 0.8]), np.array([0.0, 0.0, height])
        self.workspace = Workspace.around(middle, reach)

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Compute mean and half difference of each pair's two rods, like eq. 3.12, in metres."""
        return pair_errors(self.rods(q, p), r, R, p)

    def rods(self, q: Any, p: Named) -> tuple[list[Any], list[Any], list[Any]]:
        """Return the six rods' ends C in {B} and B in {P}, (3, 1) each, and their lengths."""
        C, B = [], []
        for i in range(3):
            c, T = p[f"chain{i + 1}"], self.frame(i)
            b, D = c.vector("b_x", "b_y", "b_z"), c.vector("D_x", "D_y", "D_z")
            d, dC = c.vector("d_x", "d_y", "d_z"), c.vector("dC_x", "dC_y", "dC_z")
            for side in (1, -1):
                C.append(T @ (b + D + self.rail(c) * q[i] + side * (d + dC)))
                B.append(T @ (b + side * d))
        return C, B, self.rod_lengths(p)

    def drawing(self, q: Any, r: Any, R: Any, p: Named) -> list[Line]:
        """Draw rails, carriages, six rods and the platform."""
        lines = []
        for i in range(3):
            c, T = p[f"chain{i + 1}"], self.frame(i)
            start = T @ (c.vector("b_x", "b_y", "b_z") + c.vector("D_x", "D_y", "D_z"))
            end = start + T @ self.rail(c) * self.joint_limits[i][1]
            lines.append(Line("base", (start, end), tuple(f"chain{i + 1}.{n}" for n in RAIL)))
        return [*lines, *rod_pairs(self.rods(q, p), r, R)]

    def frame(self, i: int) -> Any:
        """Rotation from a chain's frame to {B}."""
        return rot_z(self.direction + i * 120 * DEGREE)

    def rod_lengths(self, p: Named) -> list[Any]:
        return pair_lengths(p)

    def rail(self, c: Named) -> Any:
        """Direction of a rail in the chain's frame."""
        return (rot_y(self.inclination) @ rot_x(c.alpha) @ rot_y(c.beta))[:, 2]

    def candidates(self, q: Any, p: Named) -> list[tuple[Any, Any]]:
        """Find both solutions of the general position problem (eq. 6.6) for a parallel platform."""
        return [(r, ca.DM.eye(3)) for r in positions(self, q, p)]

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """Find both readings of every carriage for a parallel platform, the higher one first."""
        zero, plus, minus = (
            self.closure(ca.DM.ones(3) * reading, r, ca.DM.eye(3), p) for reading in (0, 1, -1)
        )
        # The closure is a quadratic in the reading, given by its values at 0, 1 and -1.
        a, half_b = (plus + minus) / 2 - zero, (plus - minus) / 4
        root = ca.sqrt(half_b**2 - a * zero)
        high, low = (root - half_b) / a, -(root + half_b) / a
        return [(high[i], low[i]) for i in range(3)]
