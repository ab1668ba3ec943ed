"""Palletizer: an arm whose forearm and wrist are driven by parallelograms, 33 parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import rot_x, rot_y, rot_z
from parallel_cal.base.units import DEGREE, MM
from parallel_cal.mechanisms._controller import read_one_per_joint, read_switches
from parallel_cal.mechanisms._size import read_numbers
from parallel_cal.model.closed_form import two_circles
from parallel_cal.model.drawing import Line
from parallel_cal.model.mechanism import POSE, Home, Mechanism, Workspace
from parallel_cal.model.parameters import Named, Parameter, ParameterTable

SIZE = {"shoulder": 0.1, "height": 0.35, "upper": 0.45, "forearm": 0.5, "crank": 0.12}
SIZE |= {"lever": 0.1, "wrist": 0.08, "tool": 0.06}
HOME = (0.0, 80 * DEGREE, -20 * DEGREE, 0.0)
LIMITS = ((-170, 170), (20, 150), (-80, 60), (-350, 350))  # degrees
# Of each parallelogram, only the difference of opposite sides is seen; of a tool that is always
# upright, only sums of heights and of distances from the waist.
FIXED = (
    *("forearm.lever", "forearm.bend", "tool.z"),
    *("level.arm", "level.base_z", "level.elbow_x", "level.wrist_?"),
)
BODIES = {
    "base": ("base.x", "base.y", "shoulder.?", "level.base_?"),
    "arms": ("upper.length", "forearm.length", "forearm.lever", "crank.length"),
    "rods": ("push.length", "level.rod1", "level.rod2"),
    "levers": ("level.arm", "level.elbow_?", "level.wrist_?"),
    "tool": ("flange.x", "tool.?"),
}


class Palletizer(Mechanism):
    """Palletizing arm (parallelogram arm): the motors of both arms sit on the waist.

    The waist turns about z. On it, the shoulder carries the upper arm and a crank. A push rod leads
    from the crank to a lever of the forearm: the motor of the crank turns the forearm. Two level
    rods with a lever at the elbow keep the wrist upright. If all opposite sides are equal, the
    forearm is parallel to the crank and the tool stays level; the model has every side with its own
    length, and so the tool tilts a little.

    - joint1: the waist. joint2 and joint3: angles of the upper arm and of the crank above the
      horizontal; the crank points backwards, its reading is that of the forearm. joint4: the
      flange about the z axis of the wrist.
    - In the plane of the arm, x points outwards from the waist and z up. `base.x`, `base.y`,
      `base.alpha` and `base.beta` place the axis of the waist in {B}; `shoulder.x`, `shoulder.y`,
      `shoulder.z` and `shoulder.tilt` the axis of the shoulder on the waist.
    - `level.base_x`, `level.base_z`: the first level rod's end on the waist, from the shoulder.
      `level.arm`: from the elbow to its other end. `level.elbow_x`, `level.elbow_z`: the second
      rod's end at the elbow, along this arm and across it. `level.wrist_x`, `level.wrist_z`: its
      end at the wrist, from the wrist.
    - `flange.x`: from the wrist to the axis of the flange. `tool.x`, `tool.y`, `tool.z`: from there
      to {P}, in {P}.
    - Fixed are one of two opposite sides of each parallelogram, and what an upright tool does not
      show: `tool.z` acts as `shoulder.z`, and `flange.x` as `shoulder.x`.

    Options, in m: `shoulder` and `height`, the distance of the shoulder from the axis of the waist
    and its height (0.1 and 0.35); `upper` and `forearm`, the lengths (0.45 and 0.5); `crank`, the
    lengths of the crank and of the forearm's lever (0.12), one number or two; `lever`, the lengths
    of all levers of the level rods (0.1); `wrist`, the distance from the wrist to the axis of the
    flange (0.08); `tool`, the distance of {P} below the wrist (0.06). `flange`: false for an arm
    without a fourth joint (default true).
    `home`: the readings at home in rad (0, 1.4, -0.35 and 0).

    `switches` (rad) are the readings at which the controller homes the joints (default: the upper
    limits).
    """

    moves = POSE
    bodies = BODIES

    def __init__(
        self,
        shoulder: float = SIZE["shoulder"],
        height: float = SIZE["height"],
        upper: float = SIZE["upper"],
        forearm: float = SIZE["forearm"],
        crank: float | Sequence[float] = SIZE["crank"],
        lever: float = SIZE["lever"],
        wrist: float = SIZE["wrist"],
        tool: float = SIZE["tool"],
        flange: bool = True,
        home: Sequence[float] | None = None,
        switches: Sequence[float] | None = None,
    ):
        two = isinstance(crank, (list, tuple)) and len(crank) == 2
        levers: Any = crank if two else (crank, crank)
        stated: dict[str, Any] = {"shoulder": shoulder, "height": height, "upper": upper}
        stated |= {"forearm": forearm, "crank": levers[0], "forearm lever (crank)": levers[1]}
        stated |= {"lever": lever, "wrist": wrist, "tool": tool}
        size = read_numbers(stated, may_be_zero=("shoulder", "height", "wrist", "tool"))
        if not isinstance(flange, bool):
            raise ModelError(f"flange is {flange!r}, expected true or false")
        self.flange, n = flange, 4 if flange else 3
        self.fixed = (*FIXED, "flange.x") if flange else (*FIXED, "tool.x", "tool.y")
        self.joints = tuple(f"joint{i + 1}" for i in range(n))
        self.controls = ("x", "y", "z", "rz") if flange else ("x", "y", "z")
        self.parameters = ParameterTable(_parameters(size, flange))
        at = HOME[:n] if home is None else read_one_per_joint("home", home, n, "joint")
        p = Named(self.parameters.names, ca.DM(self.parameters.nominal))
        raised = [*at[:2], _find_forearm(at, p), *at[3:]]
        r, R = self.candidates(ca.DM(raised), p)[0]
        x, y, z = (round(float(v), 13) + 0.0 for v in r.elements())
        turn = float(np.arctan2(float(R[1, 0]), float(R[0, 0])))
        self.home = Home(tuple(at), (x, y, z), (0.0, 0.0, np.sin(turn / 2), np.cos(turn / 2)))
        reach = 0.2 * (size["upper"] + size["forearm"])
        low, high = np.array([x, y, z]) - reach, np.array([x, y, z]) + reach
        swing = [60 * DEGREE] if flange else []
        self.workspace = Workspace(
            (*map(float, low), *[turn - w for w in swing]),
            (*map(float, high), *[turn + w for w in swing]),
        )
        self.joint_limits = tuple((a * DEGREE, b * DEGREE) for a, b in LIMITS[:n])
        self.switches = read_switches(switches, n)
        self.length = size["crank"]

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Compute how far the wrist is out of the plane of the arm, the length errors of forearm,
        push rod and second level rod (m), and the two angles of the wrist to the plane (rad)."""
        s, points = self.sketch(q, r, R, p), {}
        points = {name: point[:2] for name, point in s.items() if name in ("E", "W", "F", "G")}
        errors = [
            _too_long(points["W"] - points["E"], p.forearm.length),
            _too_long(points["F"] - points["G"], p.push.length),
            _too_long(s["V"][:2] - s["T"][:2], p.level.rod2),
        ]
        M, plate = self.plane(q, p)[1], self.wrist(q, R, p)
        tilts = M[:, 1].T @ plate
        return ca.vertcat(s["W"][2], *errors, tilts[0], tilts[2])

    def plane(self, q: Any, p: Named) -> tuple[Any, Any]:
        """Return the shoulder (3, 1) in {B}, and the rotation of the plane of the arm."""
        waist = rot_x(p.base.alpha) @ rot_y(p.base.beta) @ rot_z(q[0] + p.waist.q0)
        foot = ca.vertcat(p.base.x, p.base.y, 0)
        shoulder = foot + waist @ p.shoulder.vector("x", "y", "z")
        return shoulder, waist @ rot_x(p.shoulder.tilt)

    def wrist(self, q: Any, R: Any, p: Named) -> Any:
        """Return the rotation of the wrist: that of {P} without the flange."""
        angle = p.flange.q0 + (q[3] if self.flange else 0)
        return R @ rot_z(-angle) @ (rot_x(p.flange.alpha) @ rot_y(p.flange.beta)).T

    def sketch(self, q: Any, r: Any, R: Any, p: Named) -> dict[str, Any]:
        """Return the joints in the plane of the arm, each (3, 1): x, z and the distance from the
        plane, from the shoulder. E elbow, W wrist, G and F ends of the push rod, H and U of the
        first, T and V of the second level rod."""
        shoulder, M = self.plane(q, p)
        plate, arm = self.wrist(q, R, p), p.level
        at_wrist = r - R @ p.tool.vector("x", "y", "z")
        if self.flange:
            at_wrist -= plate @ ca.vertcat(p.flange.x, 0, 0)
        W = (M.T @ (at_wrist - shoulder))[[0, 2, 1]]
        E = p.upper.length * _direction(q[1] + p.upper.q0)
        G = -p.crank.length * _direction(q[2] + p.crank.q0)
        bend = rot_z(p.forearm.bend)[:2, :2]
        F = E - p.forearm.lever / p.forearm.length * bend @ (W[:2] - E)
        H = ca.vertcat(arm.base_x, arm.base_z)
        # Seen from the elbow to the waist, the rod's end is on the right: never across the arm.
        U = two_circles([E, H], [arm.arm**2, arm.rod1**2])[1]
        out = (U - E) / arm.arm
        T = E + arm.elbow_x * out + arm.elbow_z * ca.vertcat(-out[1], out[0])
        V = W[:2] + (M.T @ plate @ ca.vertcat(arm.wrist_x, 0, arm.wrist_z))[[0, 2]]
        flat = {"E": E, "G": G, "F": F, "H": H, "U": U, "T": T, "V": V}
        return {"W": W, **{name: ca.vertcat(point, 0) for name, point in flat.items()}}

    def rod_lengths(self, p: Named) -> list[Any]:
        """Return the push rod and both level rods."""
        return [p.push.length, p.level.rod1, p.level.rod2]

    def drawing(self, q: Any, r: Any, R: Any, p: Named) -> list[Line]:
        """Draw the waist, upper arm, crank, forearm, rods, levers, wrist and tool."""
        shoulder, M = self.plane(q, p)
        s = {name: shoulder + M @ v[[0, 2, 1]] for name, v in self.sketch(q, r, R, p).items()}
        foot = ca.vertcat(p.base.x, p.base.y, 0)
        top = foot + ca.dot(shoulder - foot, self._waist(p)) * self._waist(p)
        flange = r - R @ p.tool.vector("x", "y", "z")
        return [
            Line(
                "base", (ca.DM.zeros(3), foot, top, shoulder), ("base.*", "waist.q0", "shoulder.?")
            ),
            Line("base", (shoulder, s["H"]), ("shoulder.tilt", "level.base_?")),
            Line("driven", (shoulder, s["E"]), ("upper.*",)),
            Line("driven", (shoulder, s["G"]), ("crank.*",)),
            Line("rod", (s["G"], s["F"]), ("push.length",)),
            Line("rod", (s["F"], s["E"], s["W"]), ("forearm.*",)),
            Line("rod", (s["H"], s["U"]), ("level.rod1",)),
            Line("rod", (s["U"], s["E"], s["T"], s["U"]), ("level.arm", "level.elbow_?")),
            Line("rod", (s["T"], s["V"]), ("level.rod2",)),
            Line("platform", (s["V"], s["W"]), ("level.wrist_?",)),
            Line("platform", (s["W"], flange, r), ("flange.*", "tool.?")),
        ]

    @staticmethod
    def _waist(p: Named) -> Any:
        return (rot_x(p.base.alpha) @ rot_y(p.base.beta))[:, 2]

    def candidates(self, q: Any, p: Named) -> list[tuple[Any, Any]]:
        """Compute the pose of an arm with exact parallelograms."""
        shoulder, M = self.plane(q, p)
        out = p.upper.length * _direction(q[1] + p.upper.q0)
        out += p.forearm.length * _direction(q[2] + p.crank.q0)
        R = M @ rot_x(p.flange.alpha) @ rot_y(p.flange.beta)
        r = shoulder + M @ ca.vertcat(out[0], 0, out[1])
        if self.flange:
            r += M @ ca.vertcat(p.flange.x, 0, 0)
        R = R @ rot_z(p.flange.q0 + (q[3] if self.flange else 0))
        return [(r + R @ p.tool.vector("x", "y", "z"), R)]

    def joint_candidates(self, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
        """Compute the joints of an upright arm with exact parallelograms, elbow up and down."""
        away = r[:2] - ca.vertcat(p.base.x, p.base.y)
        waist = ca.atan2(away[1], away[0])
        beyond = p.shoulder.x + (p.flange.x if self.flange else p.tool.x)
        W = ca.vertcat(ca.norm_2(away) - beyond, r[2] - p.shoulder.z - p.tool.z)
        squares = [p.upper.length**2, p.forearm.length**2]
        elbows = two_circles([ca.DM.zeros(2), W], squares)
        upper = tuple(ca.atan2(E[1], E[0]) - p.upper.q0 for E in elbows)
        fore = tuple(ca.atan2(W[1] - E[1], W[0] - E[0]) - p.crank.q0 for E in elbows)
        found = [(waist - p.waist.q0,), upper, fore]
        if self.flange:
            found.append((ca.atan2(R[1, 0], R[0, 0]) - waist - p.flange.q0,))
        return found


def _direction(angle: Any) -> Any:
    return ca.vertcat(ca.cos(angle), ca.sin(angle))


def _find_forearm(at: Sequence[float], p: Named) -> float:
    """Return the angle of the forearm at joint readings: that of the crank if their four-bar is a
    parallelogram. ModelError if the push rod does not reach."""
    elbow = p.upper.length * _direction(at[1])
    end = -p.crank.length * _direction(at[2])
    squares = [p.forearm.lever**2, p.push.length**2]
    levers = [F - elbow for F in two_circles([elbow, end], squares)]
    angles = [float(np.arctan2(-float(v[1]), -float(v[0]))) for v in levers]
    if not np.isfinite(angles).all():
        raise ModelError(
            f"crank is {float(p.crank.length):g} and {float(p.forearm.lever):g} m: the push rod of "
            f"{float(p.push.length):g} m does not reach the forearm's lever at home"
        )
    away = [abs((angle - at[2] + np.pi) % (2 * np.pi) - np.pi) for angle in angles]
    return angles[int(np.argmin(away))]


def _too_long(span: Any, length: Any) -> Any:
    return (ca.sumsqr(span) - length**2) / (2 * length)


def _parameters(size: dict[str, float], flange: bool) -> list[Parameter]:
    """Make the parameters: name, nominal value, label; angles end in an angle's name."""
    lever, upper, forearm = size["lever"], size["upper"], size["forearm"]
    rows = [
        ("base.x", 0.0, "waist axis' x"),
        ("base.y", 0.0, "waist axis' y"),
        ("base.alpha", 0.0, "waist axis' tilt about x"),
        ("base.beta", 0.0, "waist axis' tilt about y"),
        ("waist.q0", 0.0, "encoder offset"),
        ("shoulder.x", size["shoulder"], "shoulder's distance from the waist axis"),
        ("shoulder.y", 0.0, "shoulder's shift across the arm"),
        ("shoulder.z", size["height"], "shoulder's height"),
        ("shoulder.tilt", 0.0, "shoulder axis' tilt"),
        ("upper.length", upper, "upper arm's length"),
        ("upper.q0", 0.0, "encoder offset"),
        ("crank.length", size["crank"], "crank length"),
        ("crank.q0", 0.0, "encoder offset"),
        ("push.length", upper, "push rod's length"),
        ("forearm.length", forearm, "forearm's length"),
        ("forearm.lever", size["forearm lever (crank)"], "forearm lever's length"),
        ("forearm.bend", 0.0, "forearm lever's angle to the forearm"),
        ("level.base_x", -lever, "first level rod's end on the waist: x"),
        ("level.base_z", 0.0, "first level rod's end on the waist: z"),
        ("level.rod1", upper, "first level rod's length"),
        ("level.arm", lever, "elbow lever's length"),
        ("level.elbow_x", 0.0, "second level rod's end at the elbow: along the lever"),
        ("level.elbow_z", -lever, "second level rod's end at the elbow: across the lever"),
        ("level.rod2", forearm, "second level rod's length"),
        ("level.wrist_x", 0.0, "second level rod's end at the wrist: x"),
        ("level.wrist_z", lever, "second level rod's end at the wrist: z"),
        ("flange.alpha", 0.0, "flange axis' tilt about x"),
        ("flange.beta", 0.0, "flange axis' tilt about y"),
        ("flange.q0", 0.0, "encoder offset" if flange else "flange's turn"),
        *([("flange.x", size["wrist"], "flange axis' distance from the wrist")] if flange else []),
        ("tool.x", 0.0 if flange else size["wrist"], "{P}'s x from the flange"),
        ("tool.y", 0.0, "{P}'s y from the flange"),
        ("tool.z", -size["tool"], "{P}'s z from the wrist"),
    ]
    angles = {"alpha", "beta", "q0", "tilt", "bend"}
    kinds = {True: ("rad", 0.5 * DEGREE), False: ("m", 0.5 * MM)}
    return [
        Parameter(name, unit, value + 0.0, tolerance, label=label)
        for name, value, label in rows
        for unit, tolerance in (kinds[name.rpartition(".")[2] in angles],)
    ]
