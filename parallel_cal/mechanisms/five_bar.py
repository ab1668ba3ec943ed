"""Planar five-bar: two cranks carry one point by two rods, 10 parameters (12 with a tool)."""

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
    """Planar robot: two driven cranks, and two rods that meet at the end point or near it.

    The angles of the cranks are measured from the x axis.

    Options: `base`, the distance in m of the cranks' axes (0.1), which lie on the x axis; 0 for
    cranks on one axis. `crank` and `rod`, the lengths in m (0.1 and 0.15), one number or [left,
    right]; `home`, the angles in rad of the left and of the right crank at home (2.09 and 1.05);
    `below`, true if the point is below the line through the elbows, on its -y side (default false);
    `limits` of both angles in rad (default 1.05 to 3.14 of the left crank and 0 to 2.09 of the
    right one; with another `home`, 1.05 to both sides of it). Home and workspace follow from them.
    `switches` (rad) are the readings at which the cranks touch their homing switches.

    - `tool` [along, across] in m: the end point is not where the rods meet, but fixed to the rod of
      the side `carrier` (default left): `tool.x` beyond the meeting point in the direction from the
      rod's elbow, and `tool.y` to the left of this direction. A negative `tool.x` leads back, over
      the elbow: a SCARA with two arms on one axis (Morgan) has `base: 0`, `crank: [a, b]`, `rod:
      [b, a]` and a tool at `[-(b + forearm), 0]`. Of two opposite sides of such a parallelogram,
      only the difference is seen, so that the right crank is fixed.
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
    closed_forms: tuple[str, ...] = ("direct", "inverse")
    length = CRANK
    bodies = BODIES

    def __init__(
        self,
        switches: Sequence[float] = (180 * DEGREE, 0.0),
        base: float | None = None,
        crank: float | Sequence[float] | None = None,
        rod: float | Sequence[float] | None = None,
        home: Sequence[float] | None = None,
        below: bool = False,
        limits: Sequence[float] | None = None,
        tool: Sequence[float] | None = None,
        carrier: str = "left",
    ):
        if len(switches) != 2:
            raise ModelError(f"{len(switches)} switches given, expected one for each crank, in rad")
        self.switches = tuple(map(float, switches))
        if limits is not None:
            self.joint_limits = (read_limits(limits, "rad"),) * 2
        if carrier not in SIDES:
            raise ModelError(f"carrier is {carrier!r}: expected left or right")
        self.carrier, self.has_tool = carrier, tool is not None
        if all(given is None for given in (base, crank, rod, home, tool)) and not below:
            return
        size = read_numbers({"base": BASE if base is None else base}, may_be_zero=("base",))
        bars = {"crank": _read_sides("crank", CRANK if crank is None else crank)}
        bars["rod"] = _read_sides("rod", ROD if rod is None else rod)
        angles = np.array(
            FiveBar.home.joints if home is None else read_one_per_joint("home", home, 2, "crank")
        )
        nominal = {
            f"{side}.{part}": lengths[k]
            for part, lengths in bars.items()
            for k, side in enumerate(SIDES)
        }
        nominal |= {f"{side}.x": sign * size["base"] / 2 for side, sign in SIDES.items()}
        if tool is not None:
            self._add_tool(read_one_per_joint("tool", tool, 2, "coordinate"), bars)
        self.parameters = self.parameters.with_nominal(nominal)
        p = Named(self.parameters.names, ca.DM(self.parameters.nominal))
        pose = self.candidates(ca.DM(angles), p)[1 if below else 0][0]
        x, y = (round(float(v), 13) for v in pose.elements()[:2])
        if not np.isfinite([x, y]).all():
            rods = " and ".join(dict.fromkeys(f"{length:g}" for length in bars["rod"]))
            raise ModelError(
                f"rod is {rods} m: the rods do not meet at home, with the cranks at "
                f"{angles[0]:g} and {angles[1]:g} rad; expected longer rods"
            )
        self.home = Home(tuple(map(float, angles)), (x, y, 0.0))
        if home is not None and limits is None:
            self.joint_limits = tuple(
                (float(q) - 60 * DEGREE, float(q) + 60 * DEGREE) for q in angles
            )
        half = 0.25 * max(bars["crank"])
        self.workspace = Workspace((x - half, y - half), (x + half, y + half))

    def _add_tool(self, tool: Sequence[float], bars: dict[str, tuple[float, float]]) -> None:
        """Add the parameters of the tool. The inverse problem then has no closed form."""
        rows = zip("xy", tool, ("along", "across"), strict=True)
        self.parameters = ParameterTable(
            [
                *self.parameters,
                *(
                    Parameter(
                        f"tool.{axis}", "m", value, 0.2 * MM, label=f"end point {way} the rod"
                    )
                    for axis, value, way in rows
                ),
            ]
        )
        self.closed_forms = ("direct",)
        self.bodies = {**BODIES, "rods": ("*.rod", "tool.?")}
        if bars["crank"] == bars["rod"][::-1]:  # a parallelogram
            self.fixed = (f"{self.other}.crank",)

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Compute the length error (|J - elbow|^2 - rod^2) / (2 rod) of each rod, in metres, where
        J is the point at which the rods meet: the end point, or what the carrier's rod makes of it.
        With a tool, the error of the carrier is that of its length from the elbow to the tool."""
        elbows = {side: self.elbow(q[i], p[side]) for i, side in enumerate(SIDES)}
        if not self.has_tool:
            return ca.vertcat(*[_too_long(r[:2] - elbows[side], p[side].rod) for side in SIDES])
        reach = ca.norm_2(self._reach(p))
        errors = {self.carrier: _too_long(r[:2] - elbows[self.carrier], reach)}
        errors[self.other] = _too_long(
            self.meeting(q, r, p) - elbows[self.other], p[self.other].rod
        )
        return ca.vertcat(*[errors[side] for side in SIDES])

    @property
    def other(self) -> str:
        """The side whose rod does not carry the tool."""
        return "right" if self.carrier == "left" else "left"

    @property
    def _index(self) -> int:
        """The number of the carrier's joint."""
        return list(SIDES).index(self.carrier)

    def _reach(self, p: Named) -> Any:
        """Return the end point (2, 1) m in the frame of the carrier's rod, from its elbow."""
        return ca.vertcat(p[self.carrier].rod + p.tool.x, p.tool.y)

    def meeting(self, q: Any, r: Any, p: Named) -> Any:
        """Return the point (2, 1) m where the rods meet."""
        if not self.has_tool:
            return r[:2]
        elbow = self.elbow(q[self._index], p[self.carrier])
        return elbow + p[self.carrier].rod * self._along(r[:2] - elbow, p)

    def _along(self, away: Any, p: Named) -> Any:
        """Return the direction (2, 1) of the carrier's rod, from the way elbow to end point."""
        reach = self._reach(p)
        turned = ca.vertcat(
            ca.dot(reach, away), reach[0] * away[1] - reach[1] * away[0]
        )  # away, turned back by the angle of the tool to its rod
        return turned / ca.norm_2(turned)

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
        J = ca.vertcat(self.meeting(q, r, p), 0)
        for side, axis, elbow in zip(SIDES, axes, elbows, strict=True):
            lines.append(Line("driven", (axis, elbow), (f"{side}.crank", f"{side}.q0")))
            lines.append(Line("rod", (elbow, J), (f"{side}.rod",)))
        if self.has_tool:
            lines.append(Line("rod", (J, r), ("tool.?",)))
        return lines

    def candidates(self, q: Any, p: Named) -> list[tuple[Any, Any]]:
        """Intersect the rods' circles about both elbows, above their line and below it."""
        elbows = [self.elbow(q[i], p[side]) for i, side in enumerate(SIDES)]
        points = two_circles(elbows, [p.left.rod**2, p.right.rod**2])
        if self.has_tool:
            elbow = elbows[self._index]
            x, y = self._reach(p).elements()
            along = [(point - elbow) / p[self.carrier].rod for point in points]
            points = tuple(elbow + x * u + y * ca.vertcat(-u[1], u[0]) for u in along)
        return [(ca.vertcat(point, 0), ca.DM.eye(3)) for point in points]

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """Find both angles of each crank (eq. 6.24); with a tool, those of the other crank for
        both angles of the carrier's."""
        if not self.has_tool:
            return joint_angles(self, r, R, p)
        carrier, other = p[self.carrier], p[self.other]
        first = _crank_angles(r[:2], carrier, ca.norm_2(self._reach(p)))
        second = list[Any]()
        for angle in first:
            elbow = self.elbow(angle, carrier)
            J = elbow + carrier.rod * self._along(r[:2] - elbow, p)
            second += _crank_angles(J, other, other.rod)
        return [first, tuple(second)] if self._index == 0 else [tuple(second), first]


def _too_long(span: Any, length: Any) -> Any:
    return (ca.sumsqr(span) - length**2) / (2 * length)


def _crank_angles(point: Any, s: Named, length: Any) -> tuple[Any, Any]:
    """Return both readings of a crank whose end is `length` (m) from a point (2, 1)."""
    ends = two_circles([ca.vertcat(s.x, s.y), point], [s.crank**2, length**2])
    one, other = (ca.atan2(end[1] - s.y, end[0] - s.x) - s.q0 for end in ends)
    return one, other


def _read_sides(name: str, given: float | Sequence[float]) -> tuple[float, float]:
    """Return a length of the left and of the right side, given as one number or as two."""
    two = [given, given] if np.ndim(given) == 0 else np.ravel(given).tolist()
    if len(two) != 2:
        raise ModelError(f"{name} is {given!r}: expected one number, or two: [left, right]")
    left, right = (read_numbers({name: value})[name] for value in two)
    return left, right
