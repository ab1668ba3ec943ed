"""Cable robot: a point in space or in a plane, held by n lines that are wound on spools. It may
have more lines than degrees of freedom."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.mechanisms._cable_lines import RADIUS, DrawnLines, Motors
from parallel_cal.model.closed_form import three_spheres, two_circles
from parallel_cal.model.drawing import Line
from parallel_cal.model.drive import Spool
from parallel_cal.model.mechanism import Home, Mechanism, Workspace
from parallel_cal.model.parameters import Named, ParameterTable

# The Hangprinter HP4: three lines pull low and share one spool radius, the fourth pulls high.
HP4_ANCHORS = ((0, -1.6, -0.11), (1.3, 1.25, -0.15), (-1.44, 0.74, -0.16), (0, 0, 2.345))
HP4_ADVANTAGES = (2.0, 2.0, 2.0, 4.0)
HP4_SPOOLS = (1, 1, 1, 2)


class Cable(Mechanism):
    """Cable robot: lines from the anchors A_i hold the end point P.

    Options: without any, the robot is the Hangprinter HP4.

    - `anchors` (n, 3): positions of the anchors, m.
    - `advantages` (n,): mechanical advantages of the pulleys. Default 1.
    - `spools` (n,): number of the spool of each line. Lines with the same number share one spool
      radius.
    - `radius`: radius of the spools, m. One number, or (n,), one for each line.
    - `gear`: turns of the motor per turn of the spool. One number, or (n,), one for each line.
    - `zero`: `origin` (default): readings are zero if P is at `home`. `anchors`: a reading is the
      whole length of the line from the anchor to P.
    - `home` (3,): the position of P, m, from which poses are searched. Default: the origin; if the
      lines cannot hold P there (an anchor is there, or all anchors are on one line with it), the
      middle of the anchors, or a point below it.
    - `second_anchors` (n,): for each line a point E, m, or null. A line with such a point does not
      end at P: it runs over a pulley there, and on to E. Its length is advantage |P - A| + strands
      |P - E|.
    - `second_strands` (n,): how often each line runs between P and E. Default 1.

    With `spools`, `radius` or `gear`, the joint readings are angles of the motors that turn the
    spools (rad); a missing `radius` or `gear` is that of the Hangprinter HP4. With `anchors` alone,
    the readings are lengths of line (m). If the encoder of a motor that turns a spool measures this
    length, state the spool as the `drive` of the joint in the model file. The gear ratio and the
    advantage have the same influence as the radius of the spool. They are counted, not measured,
    and therefore fixed by default: their tolerance matters only if you free them.

    If the same coordinate is 0 for all anchors and for `home`, the robot is planar: P moves in this
    plane, and a measured third coordinate is ignored. `anchors` (n, 2) are x and y. A planar robot
    has at least two lines. A robot in space has at least three. Several lines may start at one
    point. At `home`, their directions must span the plane or space.

    Two lines hold a point in a plane only against a weight. If they are drawn in x and y, gravity
    therefore acts along y: towards negative y if the anchors are above `home`, else towards
    positive y. With more lines in x and y, gravity is along z. If such a machine stands upright,
    state `gravity: [0, -9.81, 0]` in the model file.
    """

    periodic = False
    closed_forms: tuple[str, ...] = ("direct", "inverse")
    workspace = Workspace(low=(-0.5, -0.5, 0.0), high=(0.5, 0.5, 0.8))

    def __init__(
        self,
        anchors: Sequence[Sequence[float]] | None = None,
        advantages: Sequence[float] | None = None,
        spools: Sequence[int] | None = None,
        radius: float | Sequence[float] | None = None,
        gear: float | Sequence[float] | None = None,
        zero: str = "origin",
        second_anchors: Sequence[Sequence[float] | None] | None = None,
        second_strands: Sequence[float] | None = None,
        home: Sequence[float] | None = None,
    ):
        if anchors is None:
            anchors = HP4_ANCHORS
            advantages, spools = advantages or HP4_ADVANTAGES, spools or HP4_SPOOLS
        if zero not in ("origin", "anchors"):
            raise ModelError(f"zero '{zero}': expected 'origin' or 'anchors'")
        self.whole, n = zero == "anchors", len(anchors)
        lines = DrawnLines.read(anchors, advantages, second_anchors, second_strands, home)
        motors = Motors.read(n, spools, radius, gear)
        self.moves = self.controls = lines.axes
        self.moving_pulleys = tuple(end is not None for end in lines.ends)
        self.zero_point = lines.find_home()
        self.start_lines = lines.find_independent()
        box = np.array([Cable.workspace.low, Cable.workspace.high]) + self.zero_point
        low, high = box[:, lines.used].tolist()
        self.workspace = Workspace(tuple(low), tuple(high))
        self.joint_limits = ((-np.inf, np.inf),) * n
        self.fixed, self.bodies = ("*.advantage",), {"base": ("*.A_?",)}
        table = lines.parameters(() if motors is None else motors.gears)
        self.spools: tuple[int, ...] = ()
        if motors is None:
            self.joints, self.joint_unit = tuple(f"line{i + 1}" for i in range(n)), "m"
        else:
            self.joints, self.joint_unit = tuple(f"motor{i + 1}" for i in range(n)), "rad"
            self.spools = motors.spools
            self.length = motors.radii[0] / motors.gears[0] / 2  # line (m) per rad of the motor
            self.fixed = ("*.gear", *self.fixed)
            self.bodies["spools"] = ("*.R",)
            table += motors.parameters()
        if any(self.moving_pulleys):
            self.closed_forms = ("inverse",)
            self.fixed += ("*.strands",)
            self.bodies["base"] = ("*.A_?", "*.E_?")
        self.parameters = ParameterTable(table)
        position = tuple(self.zero_point.tolist())
        self.home = Home(joints=(0.0,) * n, position=position)
        if self.whole:
            p = Named(self.parameters.names, self.parameters.nominal)
            joints = self.joint_candidates(ca.DM(position), None, p)
            self.home = Home(tuple(round(float(q[0]), 13) for q in joints), position)
        self.remarks = ()
        if home is None and self.zero_point.any():
            zero = "" if self.whole else "readings are taken as zero there; "
            self.remarks = (
                f"the lines cannot hold the point at the origin: home is {list(position)} m; "
                f"{zero}state another point with the option home",
            )
        if self.moves == ("x", "y") and n == 2:  # lines hold the point only if it hangs
            self.gravity = lines.find_gravity(self.zero_point) or self.gravity

    @classmethod
    def complete_options(
        cls, options: Mapping[str, Any], parameters: Collection[str]
    ) -> dict[str, Any]:
        """Add the options that older files lack: these list spools among their parameters only.

        Every cable robot had spools then. One with four anchors in space had those of the HP4.
        """
        motors = options.keys() & {"spools", "radius", "gear"} or "anchors" not in options
        if motors or "spool1.R" not in parameters:
            return dict(options)
        if len(options["anchors"]) == len(HP4_ANCHORS) and "spool3.R" not in parameters:
            return {"advantages": HP4_ADVANTAGES, "spools": HP4_SPOOLS, **options}
        return {**options, "radius": RADIUS}

    @property
    def winds(self) -> tuple[float, ...]:
        """Line (m) that each motor lets out at the platform per rad; empty if readings are m."""
        p = Named(self.parameters.names, self.parameters.nominal)
        return tuple(float(self.per_reading(p, i)) for i in range(len(self.spools)))

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Compute |P - A| - |H - A| - (line let out + offset): length error of each line (m).

        H is home. There is no |H - A| if readings are zero at the anchors. A line over a pulley at
        P has |P - A| + strands / advantage |P - E| in place of |P - A|.
        """
        P = self.place(r)
        let_out = [
            q[i] * self.per_reading(p, i) + p[f"line{i + 1}"].offset
            for i in range(len(self.joints))
        ]
        ways, at_zero = self._ways(P, p), self._ways(self.place(ca.DM(self.zero_point)), p)
        return ca.vertcat(
            *[
                way - (0 if self.whole else way0) - l
                for way, way0, l in zip(ways, at_zero, let_out, strict=True)
            ]
        )

    def _ways(self, P: Any, p: Named) -> list[Any]:
        """Return the length of each line that holds P, over its advantage (m)."""
        ways = [ca.norm_2(P - a) for a in self.anchors(p)]
        for i, goes_on in enumerate(self.moving_pulleys):
            if goes_on:
                c = p[f"line{i + 1}"]
                ways[i] += c.strands / c.advantage * ca.norm_2(P - self._second_anchor(c))
        return ways

    def _second_anchor(self, line: Named) -> Any:
        return line.vector(*[f"E_{axis}" for axis in self.moves])

    def anchors(self, p: Named) -> list[Any]:
        """Return the anchors in the coordinates that move, (3, 1) or (2, 1) m."""
        names = [f"A_{axis}" for axis in self.moves]
        return [p[f"line{i + 1}"].vector(*names) for i in range(len(self.joints))]

    def place(self, r: Any) -> Any:
        """Return the coordinates of a point in {B} that move, (3, 1) or (2, 1) m."""
        return ca.vertcat(*[r[i] for i in self.moved])

    def strands(self, r: Any, R: Any, p: Named) -> list[Any]:
        """Return the vectors in {B}, (3, 1) m, from the end point to the anchor of each line."""
        return [self.in_base(A - self.place(r)) for A in self.anchors(p)]

    def in_base(self, place: Any) -> Any:
        """Return a point (3, 1) m in {B}, given the coordinates that move."""
        rows = [place[self.moved.index(i)] if i in self.moved else 0 for i in range(3)]
        return ca.vertcat(*rows)

    def per_reading(self, p: Named, i: int) -> Any:
        """Line (m) at the platform that a reading of 1 (rad or m) lets out."""
        c = p[f"line{i + 1}"]
        if not self.spools:
            return 1 / c.advantage
        return p[f"spool{self.spools[i]}"].R / (c.gear * c.advantage)

    def spool(self, joint: int, p: Named) -> Spool | None:
        """Return the spool that a motor turns through its gear, or that moves a length."""
        if not self.spools:
            return super().spool(joint, p)
        return Spool(p[f"spool{self.spools[joint]}"].R, 1 / p[f"line{joint + 1}"].gear)

    def drawing(self, q: Any, r: Any, R: Any, p: Named) -> list[Line]:
        """Draw the lines from the end point to their anchors."""
        lines = [
            Line("rod", (r, self.in_base(a)), (f"line{i}.A_?", f"line{i}.offset"))
            for i, a in enumerate(self.anchors(p), start=1)
        ]
        for i, goes_on in enumerate(self.moving_pulleys, start=1):
            if goes_on:
                end = self.in_base(self._second_anchor(p[f"line{i}"]))
                lines.append(Line("rod", (r, end), (f"line{i}.E_?", f"line{i}.offset")))
        return lines

    def candidates(self, q: Any, p: Named) -> list[tuple[Any, Any]]:
        """Intersect the spheres or circles about the anchors.

        In n dimensions, n lines give two points, and n + 1 lines give one. A line over a pulley at
        P makes an ellipsoid; the sphere about the mean of its anchors is near enough to begin a
        search.
        """
        home, n = ca.DM(self.zero_point), len(self.moves)
        if len(self.start_lines) < n:  # spheres about points on a line do not meet in a point
            return super().candidates(q, p)
        more = -self.closure(q, home, ca.DM.eye(3), p)  # than the distance of home
        centres, squares = [], []
        ways = self._ways(self.place(home), p)
        for i in self.start_lines:
            way = ways[i]
            centre, ends, share = self.anchors(p)[i], 0, 0
            if self.moving_pulleys[i]:
                c = p[f"line{i + 1}"]
                share = c.strands / c.advantage
                apart = self._second_anchor(c) - centre
                centre += share / (1 + share) * apart
                # The mean square of the two distances exceeds that to the centre by this.
                ends = share / (1 + share) ** 2 * ca.sumsqr(apart)
            centres.append(centre)
            squares.append(((way + more[i]) / (1 + share)) ** 2 - ends)
        two_points = three_spheres if n == 3 else two_circles
        points = (
            [_one_point(centres, squares)]
            if len(self.start_lines) > n
            else two_points(centres, squares)
        )
        return [(self.in_base(point), ca.DM.eye(3)) for point in points]

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """Find the only solution: each line's length gives its motor's angle."""
        missing = self.closure(ca.DM.zeros(len(self.joints)), r, R, p)
        return [(missing[i] / self.per_reading(p, i),) for i in range(len(self.joints))]


def _one_point(centres: Sequence[Any], squares: Sequence[Any]) -> Any:
    """Intersect four spheres in space, or three circles in a plane, in one point: the differences
    of their equations are linear."""
    n = centres[0].shape[0]
    slopes = ca.vertcat(*[(centres[0] - c).T for c in centres[1 : n + 1]])
    heights = [
        (squares[i] - squares[0] - ca.dot(c, c) + ca.dot(centres[0], centres[0])) / 2
        for i, c in enumerate(centres[1 : n + 1], start=1)
    ]
    return ca.solve(slopes, ca.vertcat(*heights))
