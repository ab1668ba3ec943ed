"""Tripod of three struts with measured lengths that meet in the tool's point, 12 parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.mechanisms._controller import read_controller
from parallel_cal.mechanisms._size import read_limits, read_numbers, read_point, read_points
from parallel_cal.model.closed_form import three_spheres
from parallel_cal.model.drawing import Line
from parallel_cal.model.drawing import ring as closed
from parallel_cal.model.mechanism import Home, Mechanism, Workspace
from parallel_cal.model.parameters import Named, Parameter, ParameterTable

BASE = ((0.0, 0.0, 0.0), (0.4, 0.0, 0.0), (0.2, 0.35, 0.0))  # m
POINT = (0.2, 0.12, 0.4)  # m
BODIES = {"base": ("*.C_?",), "legs": ("*.L0",)}


class TripodStruts(Mechanism):
    """Tripod: three struts with measured lengths, from balls on the base to one point.

    Strut i leads from the point C on the base (`legI.C_x`, ... in {B}) to the end point. Each strut
    gives one equation, `|r - C| = q + L0`. The end point only moves along x, y and z.

    Options: `base`, the three points C in {B}, m; `home` [x, y, z] of the end point, m, on its side
    of the base; `retracted`, the length in m of a strut at reading zero (default: its length at
    home, so that the readings at home are 0; 0 if the readings are whole lengths); `limits` of the
    readings in m (default: a quarter of the shortest strut to both sides of home); `tolerance` in m
    of all lengths (1 mm).

    `scale` and `switches` describe the controller, as for `stewart42`.
    """

    joints = ("leg1", "leg2", "leg3")
    joint_unit = "m"
    moves = controls = ("x", "y", "z")
    closed_forms = ("direct", "inverse")
    bodies = BODIES
    parts = ("leg",)

    def __init__(
        self,
        base: Sequence[Sequence[float]] = BASE,
        home: Sequence[float] = POINT,
        retracted: float | None = None,
        limits: Sequence[float] | None = None,
        tolerance: float = 1e-3,
        scale: Sequence[float] | None = None,
        switches: Sequence[float] | None = None,
    ):
        C, point = read_points("base", base, 3), read_point("home", home)
        size = read_numbers({"tolerance": tolerance})
        lengths = np.linalg.norm(point - C, axis=1).round(13)
        if abs(np.linalg.det(C - point)) < 1e-6 * lengths.max() ** 3:
            raise ModelError(
                f"home {point.tolist()} is in the plane of the base points {C.tolist()}, or these "
                "are on one line: expected a point on one side of three points that span a plane"
            )
        zero = lengths_at_zero(retracted, lengths)
        self.parameters = ParameterTable(
            p
            for leg, c, L0 in zip(self.joints, C, zero, strict=True)
            for p in strut_parameters(leg, c, float(L0), size["tolerance"])
        )
        readings = lengths - zero
        x, y, z = map(float, point)
        self.home = Home(tuple(map(float, readings)), (x, y, z))
        self.joint_limits = travel(readings, lengths, limits)
        reach = 0.15 * lengths.min()
        self.workspace = Workspace.around(point, reach)
        self.scale, self.switches = read_controller(scale, switches, 3, "leg")
        self.length = round(float(lengths.min()), 13)

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Compute the length error of each strut, in metres."""
        return ca.vertcat(
            *[
                ca.norm_2(head - foot) - (q[i] + p[leg].L0)
                for i, (leg, (foot, head)) in enumerate(
                    zip(self.joints, self.struts(r, R, p), strict=True)
                )
            ]
        )

    def struts(self, r: Any, R: Any, p: Named) -> list[tuple[Any, Any]]:
        """Return the struts' ends in {B}, (3, 1) m each."""
        return [(p[leg].vector("C_x", "C_y", "C_z"), r) for leg in self.joints]

    def centres(self, q: Any, r: Any, R: Any, p: Named) -> Mapping[str, list[Any]]:
        """Return the middles of the struts."""
        return {"leg": [(foot + head) / 2 for foot, head in self.struts(r, R, p)]}

    def drawing(self, q: Any, r: Any, R: Any, p: Named) -> list[Line]:
        """Draw the base and the struts."""
        ends = self.struts(r, R, p)
        struts = [
            Line("driven", each, (f"{leg}.L0",))
            for leg, each in zip(self.joints, ends, strict=True)
        ]
        return [closed("base", [foot for foot, _ in ends], "*.C_?"), *struts]

    def candidates(self, q: Any, p: Named) -> list[tuple[Any, Any]]:
        """Intersect the spheres of the struts about their feet, on home's side first."""
        centres = [p[leg].vector("C_x", "C_y", "C_z") for leg in self.joints]
        points = three_spheres(
            centres, [(q[i] + p[leg].L0) ** 2 for i, leg in enumerate(self.joints)]
        )
        return [(point, ca.DM.eye(3)) for point in points]

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """Find the only solution: a strut's length is positive."""
        ends = zip(self.joints, self.struts(r, R, p), strict=True)
        return [(ca.norm_2(head - foot) - p[leg].L0,) for leg, (foot, head) in ends]


def strut_parameters(leg: str, foot: np.ndarray, zero: float, tolerance: float) -> list[Parameter]:
    """Make the parameters of a strut: its foot C (3,) in {B} and its length at reading zero, m."""
    balls = [
        Parameter(f"{leg}.C_{a}", "m", float(v), tolerance, "C balls", label=f"base joint's {a}")
        for a, v in zip("xyz", foot, strict=True)
    ]
    return [*balls, Parameter(f"{leg}.L0", "m", zero, tolerance, label="length at reading zero")]


def lengths_at_zero(retracted: float | None, lengths: np.ndarray) -> np.ndarray:
    """Return the lengths (n,) m of struts at reading zero; without the option, those at home."""
    if retracted is None:
        return lengths
    return np.full(len(lengths), read_numbers({"retracted": retracted}, {"retracted"})["retracted"])


def travel(
    readings: np.ndarray, lengths: np.ndarray, limits: Sequence[float] | None
) -> tuple[tuple[float, float], ...]:
    """Return the limits (m) of struts with these readings and lengths (n,) at home."""
    if limits is not None:
        return (read_limits(limits, "m"),) * len(readings)
    ways = np.column_stack([readings - lengths.min() / 4, readings + lengths.min() / 4]).round(13)
    return tuple((float(low), float(high)) for low, high in ways)
