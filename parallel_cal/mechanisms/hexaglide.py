"""Hexapod with rods of fixed length on six carriages (6-PSS, hexaglide), 54 parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import rot_x, rot_y
from parallel_cal.base.units import DEGREE
from parallel_cal.mechanisms._controller import read_controller
from parallel_cal.mechanisms._servo_legs import rod_length_errors
from parallel_cal.mechanisms._size import read_limits, read_numbers, rms_radius
from parallel_cal.mechanisms.stewart42 import Points, read_ends, ring
from parallel_cal.model.drawing import Line
from parallel_cal.model.drawing import ring as closed
from parallel_cal.model.mechanism import Home, Mechanism, Workspace
from parallel_cal.model.parameters import Named, Parameter, ParameterTable

HEIGHT, TRAVEL, AWAY, PLATFORM_RADIUS = 0.25, 0.15, 0.25, 0.1  # m
TRACKS = (0.28, 0.0, -0.28)  # m: y of three tracks, with two carriages each
BASE = np.array([(side * AWAY, y, 0.0) for y in TRACKS for side in (1, -1)])
# The balls of the middle track are aside of it: else nothing would hold the rotation about z.
PLATFORM = ring(PLATFORM_RADIUS, (80, 100, -40, 220, -80, 260))
BODIES = {"base": ("*.C_?",), "platform": ("*.B_?",), "rods": ("*.rod",)}


class Hexaglide(Mechanism):
    """Hexapod with six carriages on rails and six rods of fixed length (6-PSS).

    The carriage of leg i carries the ball of a rod. At reading zero this ball is at C (`legI.C_x`,
    ... in {B}). The other ball B of the rod is on the platform (`legI.B_x`, ... in {P}). Each leg
    gives one equation, `|r + R B - C - q u| = rod`.

    - `u = F Rx(alpha) Ry(beta) (0, 0, 1)` is the direction of the rail. F turns the z axis to the
      direction of the drawing: alpha and beta are the errors of this direction.

    Options: `base` and `platform`, the six points C in {B} and B in {P}: (6, 3) in m, or a radius
    in m and six angles in degrees; `rails`, the direction of all rails [x, y, z], or one for each
    leg (default: all along x); `height` in m of the platform above {B} at home (0.25); `rod`, the
    length of all rods in m (default: each rod is as long as the readings 0 at home require);
    `limits` of the readings in m (-0.15 to 0.15); `tolerance` in m of all lengths (0.5 mm).
    Without options, there are three parallel tracks along x with two carriages each. Rails along
    z make a linear hexapod: six upright columns, as `rails: [0, 0, 1]`.

    Two further options describe the controller with which the joints were recorded; an export for
    it starts from them. `switches` are the readings in m at which the carriages are homed (default:
    the upper limits). `scale` is how many counts or steps make a reading 1 m longer (default:
    unknown).
    """

    joint_unit = "m"
    closed_forms = ("inverse",)
    bodies = BODIES
    parts = ("rod",)

    def __init__(
        self,
        base: Points | None = None,
        platform: Points | None = None,
        rails: Sequence[Any] = (1.0, 0.0, 0.0),
        height: float = HEIGHT,
        rod: float | None = None,
        limits: Sequence[float] = (-TRAVEL, TRAVEL),
        tolerance: float = 0.5e-3,
        switches: Sequence[float] | None = None,
        scale: Sequence[float] | None = None,
    ):
        C, B = read_ends(base, platform, (BASE, PLATFORM))
        n = len(C)
        self.joints = tuple(f"leg{i + 1}" for i in range(n))
        self.frames = read_rails(rails, n)
        size = read_numbers({"height": height, "tolerance": tolerance})
        spans = B + [0, 0, size["height"]] - C
        along = np.sum(spans * self.frames[:, :, 2], axis=1)
        q, rods = np.zeros(n), np.linalg.norm(spans, axis=1).round(13)
        if rod is not None:
            rods = np.full(n, read_numbers({"rod": rod})["rod"])
            square = rods**2 - np.sum(spans**2, axis=1) + along**2
            if not (square > 0).all():
                raise ModelError(
                    f"rod is {rod!r} m: the rod of {self.joints[int(np.argmin(square))]} does not "
                    "reach from its rail to the platform at home; expected a longer rod"
                )
            # The carriage stays on its side of the platform.
            q = (along - np.where(along < 0, -1, 1) * np.sqrt(square)).round(13)
        rows = zip(self.joints, C, B, rods, strict=True)
        self.parameters = ParameterTable(
            p for row in rows for p in _leg(*row, tolerance=size["tolerance"])
        )
        self.home = Home(tuple(map(float, q)), (0.0, 0.0, size["height"]))
        reach, turn = 0.12 * size["height"], (8 * DEGREE,) * 3
        middle = np.array([0.0, 0.0, size["height"]])
        self.workspace = Workspace.around(middle, reach, turn)
        self.joint_limits = (read_limits(limits, "m"),) * n
        self.scale, self.switches = read_controller(scale, switches, n, "leg")
        self.length = rms_radius(B)

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Compute the length error (|r + R B - C - q u|^2 - rod^2) / (2 rod) of each leg, in m."""
        return rod_length_errors([p[leg].rod for leg in self.joints], *self.rod_ends(q, r, R, p))

    def rod_ends(self, q: Any, r: Any, R: Any, p: Named) -> tuple[list[Any], list[Any]]:
        """Return the ends of the rods in {B}, (3, 1) each: on the carriages, on the platform."""
        legs = [p[leg] for leg in self.joints]
        C = [c.vector("C_x", "C_y", "C_z") + q[i] * self.rail(i, c) for i, c in enumerate(legs)]
        return C, [r + R @ c.vector("B_x", "B_y", "B_z") for c in legs]

    def rods(self, q: Any, p: Named) -> tuple[list[Any], list[Any], list[Any]]:
        """Return the rods' ends C in {B} and B in {P}, (3, 1) each, and their lengths."""
        C, B = self.rod_ends(q, ca.DM.zeros(3), ca.DM.eye(3), p)
        return C, B, self.rod_lengths(p)

    def rail(self, i: int, c: Named) -> Any:
        """Return the direction of a rail in {B}."""
        return ca.DM(self.frames[i]) @ (rot_x(c.alpha) @ rot_y(c.beta))[:, 2]

    def rod_lengths(self, p: Named) -> list[Any]:
        return [p[leg].rod for leg in self.joints]

    def centres(self, q: Any, r: Any, R: Any, p: Named) -> Mapping[str, list[Any]]:
        """Return the middles of the rods."""
        return {"rod": [(c + b) / 2 for c, b in zip(*self.rod_ends(q, r, R, p), strict=True)]}

    def drawing(self, q: Any, r: Any, R: Any, p: Named) -> list[Line]:
        """Draw the rails between the limits of their readings, the rods and the platform."""
        C, tops = self.rod_ends(q, r, R, p)
        lines = []
        for i, leg in enumerate(self.joints):
            c = p[leg]
            ends = [
                c.vector("C_x", "C_y", "C_z") + h * self.rail(i, c) for h in self.joint_limits[i]
            ]
            shown = (f"{leg}.C_?", f"{leg}.alpha", f"{leg}.beta")
            lines.append(Line("base", tuple(ends), shown))
            lines.append(Line("rod", (C[i], tops[i]), (f"{leg}.rod",)))
        return [*lines, closed("platform", tops, "*.B_?")]

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """Find both readings of every carriage, the higher one first: a quadratic in the reading,
        q^2 - 2 q u.s + s.s - rod^2 = 0 with s = r + R B - C."""
        found = []
        for i, (C, B) in enumerate(
            zip(*self.rod_ends(ca.DM.zeros(len(self.joints)), r, R, p), strict=True)
        ):
            c, span = p[self.joints[i]], B - C
            along = ca.dot(span, self.rail(i, c))
            root = ca.sqrt(along**2 - ca.sumsqr(span) + c.rod**2)
            found.append((along + root, along - root))
        return found


def read_rails(given: Sequence[Any], n: int) -> np.ndarray:
    """Return rotations (n, 3, 3) that turn z to the direction of each rail."""
    try:
        rails = np.array(given, dtype=float)
    except (TypeError, ValueError):
        rails = np.empty(0)
    if rails.shape == (3,):
        rails = np.tile(rails, (n, 1))
    if rails.shape != (n, 3) or not np.isfinite(rails).all() or not rails.any(axis=1).all():
        raise ModelError(
            f"rails is {given!r}: expected one direction [x, y, z], or one for each of {n} legs"
        )
    rails = rails / np.linalg.norm(rails, axis=1, keepdims=True)
    # The second column is across the rail, and as near to y as possible (to x if the rail is y).
    across = np.where(np.abs(rails[:, 1:2]) < 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    y = across - np.sum(across * rails, axis=1, keepdims=True) * rails
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    return np.stack([np.cross(y, rails), y, rails], axis=-1).round(13) + 0.0


def _leg(leg: str, C: np.ndarray, B: np.ndarray, rod: float, tolerance: float) -> list[Parameter]:
    points = (("C", C, "carriage joint"), ("B", B, "platform joint"))
    balls = [
        Parameter(f"{leg}.{name}_{axis}", "m", float(v), tolerance, label=f"{what}'s {axis}")
        for name, point, what in points
        for axis, v in zip("xyz", point, strict=True)
    ]
    tilts = [
        Parameter(f"{leg}.{name}", "rad", 0.0, 0.5 * DEGREE, label="rail's direction")
        for name in ("alpha", "beta")
    ]
    return [*balls, *tilts, Parameter(f"{leg}.rod", "m", float(rod), tolerance, label="rod length")]
