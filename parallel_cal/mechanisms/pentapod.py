"""Pentapod: five struts with measured lengths, whose ends ride round the tool's axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.units import DEGREE
from parallel_cal.mechanisms._controller import read_controller, read_one_per_joint
from parallel_cal.mechanisms._size import read_numbers, read_point, read_points
from parallel_cal.mechanisms.tripod_struts import lengths_at_zero, strut_parameters, travel
from parallel_cal.model.drawing import Line
from parallel_cal.model.drawing import ring as closed
from parallel_cal.model.mechanism import POSE, Home, Mechanism, Workspace
from parallel_cal.model.parameters import Named, Parameter, ParameterTable

LEGS = tuple(f"leg{i + 1}" for i in range(5))
FOUR = ((-0.45, 0.3, 0.5), (0.45, 0.3, 0.5), (-0.45, -0.3, 0.5), (0.45, -0.3, 0.5))
BASE = (*FOUR, (0.0, -0.5, 0.9))  # m
RADIUS, HEIGHTS = 0.08, (0.05, 0.08, 0.32, 0.35, 0.2)  # m, of the rings on the spindle
TURN = 10 * DEGREE  # of the tool, in the default workspace
BODIES = {"base": ("*.C_?",), "platform": ("*.B_?",), "legs": ("*.L0",)}


class Pentapod(Mechanism):
    """Pentapod: five struts with measured lengths, each on a ring that turns round the spindle.

    Strut i leads from a ball C on the base (`legI.C_x`, ... in {B}) to the spindle, whose axis is z
    of {P}. There its end rides on a ring of the radius `legI.B_r` at the height `legI.B_z`: it is
    always on the side of C. With `P = R' (C - r)`, each strut gives one equation,
    `|(hypot(P_x, P_y) - B_r, P_z - B_z)| = q + L0`.

    Turning the spindle about its own axis changes no strut. As in LinuxCNC, x of {P} is therefore
    in the plane of x and z of {B}, `R[1, 0] = 0`. If your device measures whole orientations, turn
    its frames about the spindle accordingly, or give it positions only.

    Options: `base`, the five points C in {B}, m; `radius`, one or five radii in m of the rings
    (0.08); `heights`, of the rings in {P}, m; `home` [x, y, z] of the tool's tip, m, where the
    spindle is parallel to z; `retracted`, `limits` and `tolerance` as for `tripod_struts`.

    `scale` and `switches` describe the controller, as for `stewart42`.
    """

    joints = LEGS
    joint_unit = "m"
    moves = POSE
    controls = ("x", "y", "z", "rx", "ry")
    closed_forms = ("inverse",)
    bodies = BODIES
    parts = ("leg",)

    def __init__(
        self,
        base: Sequence[Sequence[float]] = BASE,
        radius: float | Sequence[float] = RADIUS,
        heights: Sequence[float] = HEIGHTS,
        home: Sequence[float] = (0.0, 0.0, 0.0),
        retracted: float | None = None,
        limits: Sequence[float] | None = None,
        tolerance: float = 1e-3,
        scale: Sequence[float] | None = None,
        switches: Sequence[float] | None = None,
    ):
        C, tip = read_points("base", base, 5), read_point("home", home)
        level = np.array(read_one_per_joint("heights", heights, 5, "leg"))
        one_or_five: Any = [radius] * 5 if np.ndim(radius) == 0 else radius
        radii = np.array(read_one_per_joint("radius", one_or_five, 5, "leg"))
        size = read_numbers({"tolerance": tolerance})
        away = C - tip
        spans = np.column_stack([np.hypot(away[:, 0], away[:, 1]) - radii, away[:, 2] - level])
        lengths = np.linalg.norm(spans, axis=1).round(13)
        if not (spans[:, 0] > 0).all():
            short = int(np.argmin(spans[:, 0]))
            raise ModelError(
                f"base point {C[short].tolist()} of {LEGS[short]} is within the ring of "
                f"{radii[short]:g} m at home {tip.tolist()}: expected base points further from the "
                "spindle's axis"
            )
        zero = lengths_at_zero(retracted, lengths)
        table = list[Parameter]()
        for i, leg in enumerate(LEGS):
            table += strut_parameters(leg, C[i], float(zero[i]), size["tolerance"])
            for name, value, label in (("r", radii[i], "radius"), ("z", level[i], "height")):
                table.append(
                    Parameter(
                        f"{leg}.B_{name}",
                        "m",
                        float(value),
                        size["tolerance"],
                        "rings",
                        label=f"ring's {label}",
                    )
                )
        self.parameters = ParameterTable(table)
        readings = lengths - zero
        x, y, z = map(float, tip)
        self.home = Home(tuple(map(float, readings)), (x, y, z))
        self.joint_limits = travel(readings, lengths, limits)
        reach = 0.1 * lengths.min()
        self.workspace = Workspace.around(tip, reach, (TURN, TURN))
        self.scale, self.switches = read_controller(scale, switches, 5, "leg")
        self.length = round(float(np.sqrt(np.mean(radii**2 + (level - level.mean()) ** 2))), 13)

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Compute the length error of each strut, and how far x of {P} points to y, in metres."""
        spans = [self.span(r, R, p[leg]) for leg in LEGS]
        errors = [
            span - (q[i] + p[leg].L0) for i, (leg, span) in enumerate(zip(LEGS, spans, strict=True))
        ]
        return ca.vertcat(*errors, self.length * R[1, 0])

    @staticmethod
    def span(r: Any, R: Any, c: Named) -> Any:
        """Distance between both ends of a strut, in the plane of its foot and the spindle."""
        P = R.T @ (c.vector("C_x", "C_y", "C_z") - r)
        return ca.norm_2(ca.vertcat(ca.norm_2(P[:2]) - c.B_r, P[2] - c.B_z))

    def struts(self, r: Any, R: Any, p: Named) -> list[tuple[Any, Any]]:
        """Return the struts' ends in {B}, (3, 1) m each."""
        found = []
        for leg in LEGS:
            c = p[leg]
            C = c.vector("C_x", "C_y", "C_z")
            P = R.T @ (C - r)
            out = c.B_r * P[:2] / ca.norm_2(P[:2])
            found.append((C, r + R @ ca.vertcat(out, c.B_z)))
        return found

    def centres(self, q: Any, r: Any, R: Any, p: Named) -> Mapping[str, list[Any]]:
        """Return the middles of the struts."""
        return {"leg": [(foot + head) / 2 for foot, head in self.struts(r, R, p)]}

    def drawing(self, q: Any, r: Any, R: Any, p: Named) -> list[Line]:
        """Draw the base, the struts, and the spindle with an arm of each ring."""
        ends = self.struts(r, R, p)
        lines = [closed("base", [foot for foot, _ in ends], "*.C_?")]
        middles = []
        for leg, each in zip(LEGS, ends, strict=True):
            middle = r + p[leg].B_z * R[:, 2]
            middles.append(middle)
            lines.append(Line("driven", each, (f"{leg}.L0",)))
            lines.append(Line("platform", (middle, each[1]), (f"{leg}.B_r", f"{leg}.B_z")))
        return [*lines, Line("platform", (r, *middles), ())]

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """Find the only solution: a strut's length is positive."""
        return [(self.span(r, R, p[leg]) - p[leg].L0,) for leg in LEGS]
