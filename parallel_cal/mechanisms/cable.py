"""Cable robot: a point in space or in a plane, held by n lines that are wound on spools. It may
have more lines than degrees of freedom."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.units import MM
from parallel_cal.model.closed_form import three_spheres, two_circles
from parallel_cal.model.drawing import Line
from parallel_cal.model.drive import Spool
from parallel_cal.model.mechanism import Home, Mechanism, Workspace
from parallel_cal.model.parameters import Named, Parameter, ParameterTable

GEAR, RADIUS = 255 / 20, 75 * MM
MIN_LENGTH = 1e-6  # m, of a line

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
        hp4 = anchors is None
        anchors = HP4_ANCHORS if anchors is None else anchors
        n = len(anchors)
        points = _check_anchors(anchors)
        stated = None if home is None else _read_point("home", home)
        flat = len(anchors[0]) == 2 and (stated is None or not stated[2])
        used = np.flatnonzero([True, True, False]) if flat else _find_axes(points, stated)
        self.moves = self.controls = tuple("xyz"[axis] for axis in used)
        ends = _check_second_anchors(n, used, second_anchors, second_strands)
        self.moving_pulleys = tuple(end is not None for end in ends)
        if any(self.moving_pulleys):
            self.closed_forms = ("inverse",)
        if zero not in ("origin", "anchors"):
            raise ModelError(f"zero '{zero}': expected 'origin' or 'anchors'")
        self.whole = zero == "anchors"
        motors = hp4 or any(option is not None for option in (spools, radius, gear))
        advantages = advantages or (HP4_ADVANTAGES if hp4 else (1.0,) * n)
        own = spools or (HP4_SPOOLS if hp4 else range(1, n + 1))
        self.spools = tuple(own) if motors else ()
        radii, gears = (
            _numbers(name, given, default, n)
            for name, given, default in (("radius", radius, RADIUS), ("gear", gear, GEAR))
        )
        _check_lines(n, advantages, self.spools or own)
        strands = second_strands or (1.0,) * n
        lines_at = _Lines(points, ends, np.divide(strands, advantages), used)
        self.zero_point = lines_at.find_home(stated)
        box = np.array([Cable.workspace.low, Cable.workspace.high]) + self.zero_point
        box = box[:, used].tolist()
        self.workspace = Workspace(low=tuple(box[0]), high=tuple(box[1]))
        self.joints = tuple(f"{'motor' if motors else 'line'}{i + 1}" for i in range(n))
        self.joint_unit = "rad" if motors else "m"
        self.joint_limits = ((-np.inf, np.inf),) * n
        if motors:  # line (m) per rad of the motor
            self.length = radii[0] / gears[0] / 2
        self.fixed = ("*.gear", "*.advantage") if motors else ("*.advantage",)
        self.fixed += ("*.strands",) * any(self.moving_pulleys)
        base = ("*.A_?", "*.E_?") if any(self.moving_pulleys) else ("*.A_?",)
        self.bodies = {"base": base, **({"spools": ("*.R",)} if motors else {})}
        places = [dict(zip(self.moves, point, strict=True)) for point in points[:, used]]
        lines = [
            _line(i + 1, place, advantages[i], gears[i] if motors else None)
            for i, place in enumerate(places)
        ]
        for i, end in enumerate(ends):
            if end is not None:
                place = dict(zip(self.moves, end[used], strict=True))
                lines[i] += _second_part(i + 1, place, strands[i])
        shared = {k: radii[self.spools.index(k)] for k in sorted({*self.spools})}
        spooled = [
            Parameter(f"spool{k}.R", "m", size, 1 * MM, "spool", low=0, label="radius")
            for k, size in shared.items()
        ]
        self.parameters = ParameterTable([*(p for line in lines for p in line), *spooled])
        position = tuple(self.zero_point.tolist())
        self.home = Home(joints=(0.0,) * n, position=position)
        if self.whole:
            p = Named(self.parameters.names, self.parameters.nominal)
            joints = self.joint_candidates(ca.DM(position), None, p)
            self.home = Home(tuple(round(float(q[0]), 13) for q in joints), position)
        self.start_lines = lines_at.find_independent()
        self.remarks = ()
        if stated is None and self.zero_point.any():
            zero = "" if self.whole else "readings are taken as zero there; "
            self.remarks = (
                f"the lines cannot hold the point at the origin: home is {list(position)} m; "
                f"{zero}state another point with the option home",
            )
        if self.moves == ("x", "y") and n == 2:  # lines hold the point only if it hangs
            self.gravity = lines_at.find_gravity(self.zero_point) or self.gravity

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


def _numbers(name: str, given: Any, default: float, n: int) -> list[float]:
    """Return n numbers above 0, given as one or as n of them."""
    try:
        values = np.broadcast_to(np.array(default if given is None else given, float), n)
    except (TypeError, ValueError):
        raise ModelError(f"{name} {given!r}: expected a number, or {n} of them") from None
    if not (values > 0).all():
        raise ModelError(f"{name} {given!r}: expected numbers above 0")
    return [float(value) for value in values]


def _check_lines(n: int, advantages: Sequence[float], spools: Sequence[int]) -> None:
    for name, values in (("advantages", advantages), ("spools", spools)):
        if len(values) != n:
            raise ModelError(f"{len(values)} {name} for {n} anchors, expected one for each")
    if not all(value > 0 for value in advantages):
        raise ModelError(f"advantages {list(advantages)}, expected numbers above 0")


def _check_anchors(anchors: Sequence[Any]) -> np.ndarray:
    """Return the anchors (n, 3) m, or ModelError."""
    if {len(point) for point in anchors} not in ({2}, {3}):
        raise ModelError(f"anchors {list(anchors)}: expected points [x, y, z], or all [x, y], in m")
    points = np.zeros((len(anchors), 3))
    points[:, : len(anchors[0])] = np.array(anchors, dtype=float)
    return points


def _find_axes(points: np.ndarray, home: np.ndarray | None) -> np.ndarray:
    """Return the coordinates (indices) in which the point moves, or ModelError."""
    n, every = len(points), points if home is None else np.vstack([points, home])
    used = np.flatnonzero(every.any(axis=0))
    if len(used) < 2:
        raise ModelError(
            f"the {n} anchors {points.tolist()} are collinear with the origin: expected anchors "
            "that span a plane or space; state those in a plane as [x, y], or state a point that "
            "the lines hold as the option home"
        )
    return used


@dataclass(frozen=True)
class _Lines:
    """Drawn lines: `anchors` (n, 3) m, the second ones or None, and `shares` (n,): strands to the
    second anchor over the advantage. `used` are the coordinates in which the point moves."""

    anchors: np.ndarray
    ends: Sequence[np.ndarray | None]
    shares: np.ndarray
    used: np.ndarray

    def find_home(self, stated: np.ndarray | None) -> np.ndarray:
        """Return the stated home, or else the first of some points that the lines can hold.

        ModelError if they hold none.
        """
        n, freedoms = len(self.anchors), len(self.used)
        if n < freedoms:
            raise ModelError(
                f"{n} anchors given, expected at least 3 points [x, y, z] in m, or at least 2 "
                "points [x, y] of a planar robot"
            )
        every = np.array([*self.anchors, *(end for end in self.ends if end is not None)])
        middle, down = np.round(every.mean(axis=0), 3), np.zeros(3)
        down[self.used[-1]] = np.round(np.ptp(every, axis=0).max() / 2, 3)
        places = [np.zeros(3), middle, middle - down] if stated is None else [stated]
        for place in places:
            if self.count_directions(place) == freedoms:
                return place
        where = "at the origin" if stated is None else f"at home {stated.tolist()}"
        if np.min(np.linalg.norm(every - places[0], axis=1)) < MIN_LENGTH:
            raise ModelError(f"an anchor is {where}: its line has no length there")
        raise ModelError(
            f"the lines from the anchors {self.anchors.tolist()} do not hold the point {where}: "
            f"they pull along {self.count_directions(places[0])} of {freedoms} independent "
            "directions; expected anchors at different points that are not on one line (in space, "
            "in one plane) with home"
        )

    def directions(self, place: np.ndarray) -> np.ndarray:
        """Return by how much each line is longer per metre of motion (n, freedoms); NaN if the
        place is an anchor."""
        rows = []
        for anchor, end, share in zip(self.anchors, self.ends, self.shares, strict=True):
            row = _unit(place - anchor)
            rows.append(row if end is None else row + share * _unit(place - end))
        return np.array(rows)[:, self.used]

    def count_directions(self, place: np.ndarray) -> int:
        """Count the independent directions in which the lines pull; 0 at an anchor."""
        rows = self.directions(place)
        if not np.isfinite(rows).all():
            return 0
        return int(np.linalg.matrix_rank(rows, tol=1e-6))

    def find_independent(self) -> list[int]:
        """Return the first lines whose spheres meet in one point, or in two if there are no more
        lines than freedoms (by their numbers)."""
        centres = self.anchors.copy()
        for i, end in enumerate(self.ends):
            if end is not None:
                centres[i] += self.shares[i] / (1 + self.shares[i]) * (end - centres[i])
        found = list[int]()
        for i in range(len(centres)):
            apart = centres[[*found[1:], i]] - centres[found[0]] if found else np.eye(3)
            sizes = np.linalg.svd(apart[:, self.used], compute_uv=False)
            if sizes[min(len(apart), len(self.used)) - 1] > 0.05 * sizes[0]:
                found.append(i)
            if len(found) > len(self.used):
                break
        return found

    def find_gravity(self, home: np.ndarray) -> tuple[float, float, float] | None:
        """Return the gravity (m/s^2) along y that keeps both lines of a planar robot taut at home;
        None if neither direction does."""
        tensions = -np.linalg.solve(self.directions(home).T, np.array([0.0, 1.0]))
        if (tensions >= 0).all():
            return (0.0, -9.81, 0.0)
        return (0.0, 9.81, 0.0) if (tensions <= 0).all() else None


def _unit(vector: np.ndarray) -> np.ndarray:
    size = float(np.linalg.norm(vector))
    return vector / size if size > MIN_LENGTH else np.full(3, np.nan)


def _check_second_anchors(
    n: int,
    used: np.ndarray,
    given: Sequence[Sequence[float] | None] | None,
    strands: Sequence[float] | None,
) -> list[np.ndarray | None]:
    """Return the second anchor (3,) m of each line, None of a line without one, or ModelError."""
    for name, values in (("second_anchors", given), ("second_strands", strands)):
        if values is not None and len(values) != n:
            raise ModelError(f"{len(values)} {name} for {n} anchors, expected one for each")
    if strands is not None and not all(value > 0 for value in strands):
        raise ModelError(f"second_strands {list(strands)}, expected numbers above 0")
    ends = [
        None if end is None else _read_point("second anchor", end) for end in given or [None] * n
    ]
    for end in ends:
        if end is not None and np.delete(end, used).any():
            raise ModelError(
                f"second anchor {end.tolist()} is outside the plane of the anchors, which the "
                "lines of a planar robot do not leave"
            )
    return ends


def _read_point(name: str, given: Sequence[float]) -> np.ndarray:
    """Return a point (3,) m that is given as [x, y, z] or [x, y], or ModelError."""
    point = np.zeros(3)
    if len(given) not in (2, 3):
        raise ModelError(f"{name} {list(given)}: expected [x, y, z] or [x, y], in m")
    point[: len(given)] = np.array(given, dtype=float)
    return point


def _anchor(name: str, label: str, point: Mapping[str, float]) -> list[Parameter]:
    return [
        Parameter(f"{name}_{axis}", "m", float(v), 20 * MM, "anchor", label=f"{label}'s {axis}")
        for axis, v in point.items()
    ]


def _second_part(number: int, end: Mapping[str, float], strands: float) -> list[Parameter]:
    name = f"line{number}."
    return [
        *_anchor(f"{name}E", "second anchor", end),
        Parameter(
            f"{name}strands",
            "1",
            float(strands),
            1e-3,
            "drive",
            low=0,
            label="strands to the second anchor",
        ),
    ]


def _line(
    number: int, anchor: Mapping[str, float], advantage: float, gear: float | None
) -> list[Parameter]:
    name, drive = f"line{number}.", []
    if gear is not None:
        drive = [Parameter(f"{name}gear", "1", gear, 1e-3, "drive", low=0, label="gear ratio")]
    return [
        *_anchor(f"{name}A", "anchor", anchor),
        Parameter(
            f"{name}offset",
            "m",
            0.0,
            5 * MM,
            "offset",
            label="error of the line's length at reading zero",
        ),
        *drive,
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
