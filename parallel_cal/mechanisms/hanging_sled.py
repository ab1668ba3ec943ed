"""Sled that hangs on two lines in an upright plane: a Maslow, or a plotter that carries its motors.

The lines do not hold the tilt of the sled; its weight does.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import rot_z
from parallel_cal.base.units import MM
from parallel_cal.mechanisms._controller import read_one_per_joint
from parallel_cal.mechanisms._size import read_numbers
from parallel_cal.model.closed_form import two_circles
from parallel_cal.model.drawing import Line
from parallel_cal.model.mechanism import Home, Mechanism, Workspace
from parallel_cal.model.parameters import Named, Parameter, ParameterTable

SIDES = {"left": 1, "right": -1}  # where the sled is, along x
ANCHORS = ((-1489.2 * MM, 1072.6 * MM), (1489.2 * MM, 1072.6 * MM))  # a Maslow as delivered
MOUNTS = ((-155 * MM, 139 * MM), (155 * MM, 139 * MM))
BELOW, RADIUS = 79 * MM, 63.5 * MM / (2 * np.pi)
PLACES = ("frame", "sled")
BODIES = {"frame": ("*.A_?",), "sled": ("*.B_?", "sled.G_?"), "lines": ("*.L0",)}


class HangingSled(Mechanism):
    """Sled that hangs on two lines in an upright plane, such as a Maslow or a mural robot.

    A line leads from a sprocket or a peg at A (`left.A_x`, `left.A_y` in {B}) to the mount B of the
    sled (`left.B_x`, `left.B_y` in {P}). Its length in the plane is `s`, and with the wheel's arc
    and the distance `sled.standoff` across the plane it is `hypot(s, standoff) + arc = q + L0`.
    The origin of {P} is the tool. The sled tilts until the lines balance its weight at the centre
    of gravity G (`sled.G_x`, `sled.G_y` in {P}): with the unit vectors u_i along the lines,
    `sum t_i (B_i - G) x u_i = 0` and `sum t_i u_i = up`.

    - Wheels on the frame have their axes at A. The arc counts from 12 o'clock, over the outer side,
      to where the line leaves.
    - Wheels on the sled have their axes at B. The arc counts from where the line touches to the
      wheel's lowest point, in {P}, and the line pulls at the point where it touches.
    - x of {P} is horizontal if the sled hangs freely at G and the tool is right above it.
      Therefore `sled.G_x` is fixed. An angle that you measure includes the frame of its device.
    - If both mounts are at the tool (`mounts: [[0, 0], [0, 0]]`: a ring, or a linkage that acts
      like one), the sled does not tilt, and what only a tilt shows is fixed.

    Options, in m: `anchors` and `mounts`, two points [x, y] each, left and right (those of a Maslow
    as it was delivered, whose origin is the middle of its sheet); `below`, how far the centre of
    gravity is below the tool (0.079); `radius` of the wheels (0.0101; 0 for lines that are fixed to
    pegs and points); `wheels`: `frame` or `sled` (default frame); `over`: false if the lines leave
    the wheels at the bottom (default true); `standoff`, from the plane of the anchors to that of
    the mounts (0); `retracted`, the length of both lines at reading zero (default: that at home, so
    that the readings at home are 0; 0 if the readings are whole lengths); `home` [x, y] of the tool
    ([0, 0]). The workspace follows from them.
    """

    joints = tuple(SIDES)
    joint_unit = "m"
    moves = ("x", "y", "rz")
    controls = ("x", "y")
    gravity = (0.0, -9.81, 0.0)
    joint_limits = ((-np.inf, np.inf),) * 2
    bodies = BODIES

    def __init__(
        self,
        anchors: Sequence[Sequence[float]] = ANCHORS,
        mounts: Sequence[Sequence[float]] = MOUNTS,
        below: float = BELOW,
        radius: float = RADIUS,
        wheels: str = "frame",
        over: bool = True,
        standoff: float = 0.0,
        retracted: float | None = None,
        home: Sequence[float] = (0.0, 0.0),
    ):
        if wheels not in PLACES:
            raise ModelError(f"wheels is {wheels!r}: expected {' or '.join(PLACES)}")
        self.on_sled, self.over = wheels == "sled", bool(over)
        A, B = (_read_pair(name, two) for name, two in (("anchors", anchors), ("mounts", mounts)))
        at_home = np.array(read_one_per_joint("home", home, 2, "coordinate"))
        zero = ("radius", "standoff", "retracted")
        stated = {"below": below, "radius": radius, "standoff": standoff}
        size = read_numbers(stated | {"retracted": retracted or 0}, zero)
        self._check(A, B, at_home, size["radius"])
        table = list[Parameter]()
        for side, a, b in zip(SIDES, A, B, strict=True):
            table += _point(f"{side}.A", a, 20 * MM, "anchor")
            table += _point(f"{side}.B", b, 2 * MM, "mount")
            label = "line's length at reading zero"
            table.append(
                Parameter(f"{side}.L0", "m", size["retracted"], 5 * MM, "offset", label=label)
            )
        table += _point("sled.G", np.array([0.0, -size["below"]]), 10 * MM, "centre of gravity")
        for name, key in (("wheels.radius", "radius"), ("sled.standoff", "standoff")):
            tolerance = (0.1 if key == "radius" else 2) * MM
            table.append(Parameter(name, "m", size[key], tolerance, low=0.0, label=key))
        self.parameters = ParameterTable(table)
        self.fixed = ("sled.G_x", "sled.standoff") + ("wheels.radius",) * (not size["radius"])
        self.tilts = bool(B.any())
        if not self.tilts:
            self.fixed += ("*.B_?", "sled.G_y")
        self.length = round(float(np.hypot(np.linalg.norm(B, axis=1).mean(), size["below"])), 13)
        self._place_home(at_home, retracted is None)
        # Towards the anchors, lines become level, and beside them, one hangs down.
        half = np.array([0.4 * np.ptp(A[:, 0]), 0.5 * (A[:, 1].min() - at_home[1])])
        self.workspace = Workspace.around(at_home, half)

    @staticmethod
    def _check(A: np.ndarray, B: np.ndarray, home: np.ndarray, radius: float) -> None:
        """Refuse lines that cannot hold a sled at home."""
        (left, right), ends = A, home + B
        if not left[0] + radius < ends[0, 0] <= ends[1, 0] < right[0] - radius:
            raise ModelError(
                f"at home {home.tolist()} the mounts are at x {ends[0, 0]:g} and {ends[1, 0]:g} m: "
                f"expected the left one first, and both between the anchors {A.tolist()}"
            )
        if ends[:, 1].max() >= A[:, 1].min():
            raise ModelError(
                f"a mount is at y {ends[:, 1].max():g} m at home {home.tolist()}, as high as an "
                f"anchor {A.tolist()}: expected home below the anchors"
            )

    def _place_home(self, point: np.ndarray, zero_there: bool) -> None:
        """Let the sled hang at home; with `zero_there`, its readings are 0 there."""
        nominal = Named(self.parameters.names, ca.DM(self.parameters.nominal))
        place = ca.SX.sym("place", 3)  # x, y and the tilt
        r, R = ca.vertcat(place[:2], 0), rot_z(place[2])
        balance = ca.vertcat(
            *[self._length(side, r, R, nominal) for side in SIDES], self._moment(r, R, nominal)
        )
        evaluate = ca.Function("balance", [place], [balance, ca.jacobian(balance, place)])
        angle = 0.0
        for _ in range(50):
            found, slopes = (np.array(each) for each in evaluate([*point, angle]))
            angle -= float(found[2, 0] / slopes[2, 2])
        # Lengths kept, a tilt to one side must raise the centre of gravity as one to the other.
        rises = np.linalg.det(slopes) / np.linalg.det(slopes[:2, :2]) < 0
        if not (abs(found[2, 0]) < 1e-12 and abs(angle) < 1 and rises):
            raise ModelError(
                f"no tilt balances the sled at home {point.tolist()}: expected a centre of gravity "
                "further below the mounts (option below)"
            )
        angle = round(angle, 13) + 0.0
        lengths = np.array(evaluate([*point, angle])[0]).ravel()[:2].round(13)
        if zero_there:
            zeros = dict(zip((f"{side}.L0" for side in SIDES), map(float, lengths), strict=True))
            self.parameters = self.parameters.with_nominal(zeros)
            lengths = 0 * lengths
        else:
            lengths = lengths - [float(nominal[side].L0) for side in SIDES]
        x, y = map(float, point)
        turned = (0.0, 0.0, float(np.sin(angle / 2)), float(np.cos(angle / 2)))
        self.home = Home(tuple(map(float, lengths)), (x, y, 0.0), turned)

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Compute by how much each line is too short, and the lever of the weight that the lines do
        not balance: both in m."""
        lengths = [self._length(side, r, R, p) for side in SIDES]
        errors = [
            length - (q[i] + p[side].L0)
            for i, (side, length) in enumerate(zip(SIDES, lengths, strict=True))
        ]
        return ca.vertcat(*errors, self._moment(r, R, p))

    def _line(self, side: str, r: Any, R: Any, p: Named) -> tuple[Any, Any, Any, int]:
        """Return the way (2, 1) from anchor to mount and the straight length of a line (m), both in
        the plane; its angle below the horizontal (rad), and the sign with which the arc grows with
        that angle."""
        c, ahead = p[side], SIDES[side]
        away = self.mount(side, r, R, p) - ca.vertcat(c.A_x, c.A_y)
        straight = ca.sqrt(ca.sumsqr(away) - p.wheels.radius**2)
        grows = 1 if self.over != self.on_sled else -1
        angle = ca.atan2(-away[1], ahead * away[0])
        return away, straight, angle + grows * ca.atan2(p.wheels.radius, straight), grows

    def _length(self, side: str, r: Any, R: Any, p: Named) -> Any:
        """Return the whole length of a line (m)."""
        _, straight, angle, grows = self._line(side, r, R, p)
        if self.on_sled:  # the arc counts in {P}
            angle += SIDES[side] * ca.atan2(R[1, 0], R[0, 0])
        arc = angle if grows > 0 else ca.pi - angle
        return ca.sqrt(straight**2 + p.sled.standoff**2) + p.wheels.radius * arc

    def _slope(self, side: str, r: Any, R: Any, p: Named) -> tuple[Any, Any]:
        """Return by how much a line is longer per motion of its mount (2, 1), and per turn of the
        sled about the mount (m)."""
        away, straight, _, grows = self._line(side, r, R, p)
        radius, ahead, square = p.wheels.radius, SIDES[side], ca.sumsqr(away)
        across = ca.vertcat(away[1], -away[0]) * ahead - grows * radius / straight * away
        slope = away / ca.sqrt(straight**2 + p.sled.standoff**2)
        turn = grows * ahead * radius if self.on_sled else 0
        return slope + grows * radius / square * across, turn

    def _moment(self, r: Any, R: Any, p: Named) -> Any:
        """Return the moment of both lines about the centre of gravity, over the weight (m).

        By virtual work: the tensions are those with which the weight does no work in x and y.
        """
        down = ca.DM(np.array(self.gravity[:2], dtype=float))
        if not any(self.gravity[:2]):
            raise ModelError(
                f"gravity {list(self.gravity)} m/s^2 does not act in the plane x, y in which the "
                "sled hangs: expected, for example, [0, -9.81, 0]"
            )
        up, G = -down / ca.norm_2(down), r[:2] + R[:2, :2] @ p.sled.vector("G_x", "G_y")
        (left, left_turn), (right, right_turn) = (self._slope(side, r, R, p) for side in SIDES)
        levers = [
            _cross(self.mount(side, r, R, p) - G, slope) + turn
            for side, slope, turn in zip(SIDES, (left, right), (left_turn, right_turn), strict=True)
        ]
        moment = _cross(up, right) * levers[0] + _cross(left, up) * levers[1]
        return moment / _cross(left, right)

    @staticmethod
    def mount(side: str, r: Any, R: Any, p: Named) -> Any:
        """Return the mount of a line (2, 1) m in {B}."""
        return r[:2] + R[:2, :2] @ p[side].vector("B_x", "B_y")

    def strands(self, r: Any, R: Any, p: Named) -> list[Any]:
        """Return the vectors in {B}, (3, 1) m, from the mount to the anchor of each line."""
        anchors = [p[side].vector("A_x", "A_y") for side in SIDES]
        mounts = [self.mount(side, r, R, p) for side in SIDES]
        return [ca.vertcat(A - B, 0) for A, B in zip(anchors, mounts, strict=True)]

    @staticmethod
    def place(r: Any) -> Any:
        """Return the coordinates of a point in {B} that lines move, (2, 1) m."""
        return r[:2]

    @staticmethod
    def per_reading(p: Named, i: int) -> float:
        """Line (m) that a reading of 1 lets out."""
        return 1.0

    def drawing(self, q: Any, r: Any, R: Any, p: Named) -> list[Line]:
        """Draw the frame between the anchors, the lines, and the sled down to its centre of
        gravity."""
        anchors = [ca.vertcat(p[side].A_x, p[side].A_y, 0) for side in SIDES]
        mounts = [ca.vertcat(self.mount(side, r, R, p), 0) for side in SIDES]
        lines = [Line("base", tuple(anchors), ("*.A_?",))]
        for side, anchor, mount in zip(SIDES, anchors, mounts, strict=True):
            lines.append(Line("driven", (anchor, mount), (f"{side}.L0", "wheels.radius")))
        G = ca.vertcat(r[:2] + R[:2, :2] @ p.sled.vector("G_x", "G_y"), 0)
        return [
            *lines,
            Line("platform", (mounts[0], mounts[1], r, mounts[0]), ("*.B_?",)),
            Line("platform", (r, G), ("sled.G_y",)),
        ]

    def candidates(self, q: Any, p: Named) -> list[tuple[Any, Any]]:
        """Intersect circles about the anchors, as if the sled had the tilt and the arcs of home."""
        r, R = super().candidates(q, p)[0]
        centres, squares = [], []
        for i, side in enumerate(SIDES):
            _, straight, _, _ = self._line(side, r, R, p)
            arc = self._length(side, r, R, p) - ca.sqrt(straight**2 + p.sled.standoff**2)
            taut = q[i] + p[side].L0 - arc
            centres.append(ca.vertcat(p[side].A_x, p[side].A_y) - self.mount(side, 0 * r, R, p))
            squares.append(taut**2 - p.sled.standoff**2 + p.wheels.radius**2)
        return [(ca.vertcat(point, 0), R) for point in two_circles(centres, squares)]

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """Find the only solution for a given tilt."""
        return [(self._length(side, r, R, p) - p[side].L0,) for side in SIDES]


def _cross(one: Any, other: Any) -> Any:
    return one[0] * other[1] - one[1] * other[0]


def _point(name: str, at: np.ndarray, tolerance: float, label: str) -> list[Parameter]:
    return [
        Parameter(f"{name}_{axis}", "m", float(v), tolerance, label, label=f"{label}'s {axis}")
        for axis, v in zip("xy", at, strict=True)
    ]


def _read_pair(name: str, given: Sequence[Sequence[float]]) -> np.ndarray:
    """Return an option that is two points [x, y] as an array (2, 2) in m."""
    try:
        points = np.array(given, dtype=float)
    except (TypeError, ValueError):
        points = np.empty(0)
    if points.shape != (2, 2) or not np.isfinite(points).all():
        raise ModelError(f"{name} is {given!r}: expected two points [x, y] in m, left and right")
    return points
