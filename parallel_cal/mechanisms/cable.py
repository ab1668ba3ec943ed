"""Cable robot: a point held by n lines wound on spools, more lines than freedoms if wanted."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.units import MM
from parallel_cal.model.closed_form import three_spheres
from parallel_cal.model.drawing import Line
from parallel_cal.model.drive import Spool
from parallel_cal.model.mechanism import Home, Mechanism, Workspace
from parallel_cal.model.parameters import Named, Parameter, ParameterTable

GEAR, RADIUS = 255 / 20, 75 * MM

# The Hangprinter HP4: three lines pull low and share one spool radius, the fourth pulls high.
HP4_ANCHORS = ((0, -1.6, -0.11), (1.3, 1.25, -0.15), (-1.44, 0.74, -0.16), (0, 0, 2.345))
HP4_ADVANTAGES = (2.0, 2.0, 2.0, 4.0)
HP4_SPOOLS = (1, 1, 1, 2)
BODIES = {"base": ("*.A_?",), "spools": ("*.R",)}


class Cable(Mechanism):
    """Cable robot: lines from the anchors A_i hold the end point P.

    The joint readings are zero if P is at the origin.

    Options: `anchors` (n, 3), m; `advantages` (n,), the mechanical advantages of the pulleys;
    `spools` (n,), where lines with equal numbers share one spool radius. The first three anchors
    must not be collinear. Gear ratio and advantage have the same influence as the radius. They are
    known exactly and therefore fixed by default.
    """

    moves = ("x", "y", "z")
    controls = ("x", "y", "z")
    fixed = ("*.gear", "*.advantage")
    periodic = False
    closed_forms = ("direct", "inverse")
    bodies = BODIES
    workspace = Workspace(low=(-0.5, -0.5, 0.0), high=(0.5, 0.5, 0.8))
    length = RADIUS / GEAR / 2  # m of line per rad of the motor

    def __init__(
        self,
        anchors: Sequence[Sequence[float]] = HP4_ANCHORS,
        advantages: Sequence[float] | None = None,
        spools: Sequence[int] | None = None,
    ):
        n = len(anchors)
        hp4 = n == len(HP4_ANCHORS)
        advantages = advantages or (HP4_ADVANTAGES if hp4 else (1.0,) * n)
        self.spools = tuple(spools or (HP4_SPOOLS if hp4 else range(1, n + 1)))
        _check(anchors, advantages, self.spools)
        self.joints = tuple(f"motor{i + 1}" for i in range(n))
        self.joint_limits = ((-np.inf, np.inf),) * n
        self.home = Home(joints=(0.0,) * n)
        lines = [_line(i + 1, *row) for i, row in enumerate(zip(anchors, advantages, strict=True))]
        radii = [
            Parameter(f"spool{k}.R", "m", RADIUS, 1 * MM, "spool", low=0, label="radius")
            for k in sorted({*self.spools})
        ]
        self.parameters = ParameterTable([*(p for line in lines for p in line), *radii])

    @property
    def winds(self) -> tuple[float, ...]:
        """Line (m) that each motor lets out at the platform per rad."""
        p = {parameter.name: parameter.nominal for parameter in self.parameters}
        lines = enumerate(self.spools, start=1)
        return tuple(
            p[f"spool{k}.R"] / (p[f"line{i}.gear"] * p[f"line{i}.advantage"]) for i, k in lines
        )

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Compute |P - A| - |A| - (line let out + offset): length error of each line, in metres."""
        lines = [p[f"line{i + 1}"] for i in range(len(self.joints))]
        A = [c.vector("A_x", "A_y", "A_z") for c in lines]
        let_out = [q[i] * self.per_radian(p, i) + c.offset for i, c in enumerate(lines)]
        return ca.vertcat(
            *[ca.norm_2(r - a) - ca.norm_2(a) - l for a, l in zip(A, let_out, strict=True)]
        )

    def per_radian(self, p: Named, i: int) -> Any:
        """Line (m) that motor i lets out per rad."""
        c = p[f"line{i + 1}"]
        return p[f"spool{self.spools[i]}"].R / (c.gear * c.advantage)

    def spool(self, joint: int, p: Named) -> Spool:
        """Return the spool that a motor turns through its gear."""
        return Spool(p[f"spool{self.spools[joint]}"].R, 1 / p[f"line{joint + 1}"].gear)

    def drawing(self, q: Any, r: Any, R: Any, p: Named) -> list[Line]:
        """Draw the lines from the end point to their anchors."""
        lines = [(f"line{i + 1}", p[f"line{i + 1}"]) for i in range(len(self.joints))]
        return [
            Line("rod", (r, c.vector("A_x", "A_y", "A_z")), (f"{name}.A_?", f"{name}.offset"))
            for name, c in lines
        ]

    def candidates(self, q: Any, p: Named) -> list[tuple[Any, Any]]:
        """Intersect the spheres about the anchors: one point of four lines, two of three lines."""
        lengths = -self.closure(q, ca.DM.zeros(3), ca.DM.eye(3), p)
        lines = [p[f"line{i + 1}"] for i in range(len(self.joints))]
        A = [c.vector("A_x", "A_y", "A_z") for c in lines]
        squares = [(ca.norm_2(a) + lengths[i]) ** 2 for i, a in enumerate(A)]
        points = (
            [_four_spheres(A, squares)] if self._spatial() else three_spheres(A[:3], squares[:3])
        )
        return [(point, ca.DM.eye(3)) for point in points]

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """Find the only solution: each line's length gives its motor's angle."""
        missing = self.closure(ca.DM.zeros(len(self.joints)), r, R, p)
        return [(missing[i] / self.per_radian(p, i),) for i in range(len(self.joints))]

    def _spatial(self) -> bool:
        """Whether the first four anchors span space and are far from coplanar."""
        if len(self.joints) < 4:
            return False
        names = [f"line{i + 1}.A_{axis}" for i in range(4) for axis in "xyz"]
        points = np.array([self.parameters[name].nominal for name in names]).reshape(4, 3)
        sizes = np.linalg.svd(points[1:] - points[0], compute_uv=False)
        return bool(sizes[-1] > 0.05 * sizes[0])


def _check(anchors: Sequence[Any], advantages: Sequence[float], spools: Sequence[int]) -> None:
    n = len(anchors)
    if n < 3 or any(len(point) != 3 for point in anchors):
        raise ModelError(f"{n} anchors given, expected at least 3 points [x, y, z] in m")
    for name, values in (("advantages", advantages), ("spools", spools)):
        if len(values) != n:
            raise ModelError(f"{len(values)} {name} for {n} anchors, expected one for each")
    if not all(value > 0 for value in advantages):
        raise ModelError(f"advantages {list(advantages)}, expected numbers above 0")
    points = np.array(anchors, dtype=float)
    if np.linalg.norm(np.cross(*(points[1:3] - points[0]))) < 1e-6:
        raise ModelError(f"the first 3 anchors {points[:3].tolist()} are collinear")
    if not points.any(axis=1).all():
        raise ModelError(
            "an anchor is at the origin, where readings are zero: its line has no length"
        )


def _line(number: int, anchor: Sequence[float], advantage: float) -> list[Parameter]:
    name = f"line{number}."
    return [
        *[
            Parameter(
                f"{name}A_{axis}", "m", float(value), 20 * MM, "anchor", label=f"anchor's {axis}"
            )
            for axis, value in zip("xyz", anchor, strict=True)
        ],
        Parameter(
            f"{name}offset", "m", 0.0, 5 * MM, "offset", label="line's length at reading zero"
        ),
        Parameter(f"{name}gear", "1", GEAR, 1e-3, "drive", low=0, label="gear ratio"),
        Parameter(
            f"{name}advantage",
            "1",
            float(advantage),
            1e-3,
            "drive",
            low=0,
            label="pulley's mechanical advantage",
        ),
    ]


def _four_spheres(centres: Sequence[Any], squares: Sequence[Any]) -> Any:
    """Intersect four spheres in one point: their differences are planes."""
    planes = ca.vertcat(*[(centres[0] - c).T for c in centres[1:4]])
    heights = [
        (squares[i] - squares[0] - ca.dot(c, c) + ca.dot(centres[0], centres[0])) / 2
        for i, c in enumerate(centres[1:4], start=1)
    ]
    return ca.solve(planes, ca.vertcat(*heights))
