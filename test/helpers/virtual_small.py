"""Small mechanisms from points and rods: slider-crank, RSSR loop, cable robot, linear Delta."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from parallel_cal.virtual.robot import Array, Parameters, apply, axis_rotation, solve, stack
from parallel_cal.virtual.stewart import (
    Assembly,
    Pose,
    _batch,
    _make_pose_function,
    column,
    numbered,
    vectors,
)


class SliderCrank(Assembly):
    """A crank a, a rod b and a slider on the x-axis through the crank's axis (figure 5.3)."""

    moves = controls = "x"
    home = (0.1, 0.0, 0.0)
    home_joints = (0.52,)

    def pin(self, q: Array) -> Array:
        """Where crank and rod meet."""
        angle = q[..., 0] + self.parameters["q0"]
        return self.parameters["a"] * stack([np.cos(angle), np.sin(angle), 0.0])

    def gaps(self, q: Array, r: Array, R: Array, hidden: Array) -> Array:
        """How far the rod is too short to reach from the crank's pin to the slider."""
        return np.linalg.norm(r - self.pin(q), axis=-1, keepdims=True) - self.parameters["b"]


class Rssr(Assembly):
    """Two cranks joined by a rod with two balls: the short-cut set-up (figure 4.7, 9 parameters).

    z is the output's axis, x the common normal to the input's axis, `a` away and twisted by `alpha`
    about that normal. A crank's ball is r from its axis and s along it from the common normal; at
    angle zero it stands on the normal's side. {P} is the output crank.
    """

    moves = controls = "rz"
    home_turn = axis_rotation("z", 1.14)
    home_joints = (1.14,)

    def ball(self, crank: str, angle: ArrayLike) -> Array:
        """A crank's ball as seen from the foot of the common normal on its axis."""
        r, s, q0 = (self.parameters[f"{crank}.{name}"] for name in ("r", "s", "q0"))
        angle = np.asarray(angle) + q0
        return stack([r * np.cos(angle), r * np.sin(angle), s])

    def balls(self, q: Array, R: Array) -> tuple[Array, Array]:
        """The rod's ends: on the input crank at q, on the output crank where R has turned it."""
        lean = axis_rotation("x", self.parameters["alpha"])
        foot = stack([self.parameters["a"], 0.0, 0.0])
        return foot + apply(lean, self.ball("input", q[..., 0])), apply(R, self.ball("output", 0.0))

    def gaps(self, q: Array, r: Array, R: Array, hidden: Array) -> Array:
        """How far the rod is too short to reach from ball to ball."""
        one, other = self.balls(q, R)
        return np.linalg.norm(one - other, axis=-1, keepdims=True) - self.parameters["L"]


class Cable(Assembly):
    """A point held by lines that are wound on spools (the Hangprinter's README).

    A line's way from the origin is all that its spool gives: the motor turns the spool through a
    gear, and tackle divides what the spool winds off.
    """

    moves = controls = "x y z"

    def __init__(self, parameters: Parameters, spools: tuple[int, ...] = (1, 1, 1, 2)) -> None:
        super().__init__(parameters)
        lines = numbered("line", len(spools))
        self.anchors = vectors(parameters, ["A_x", "A_y", "A_z"], lines)
        self.offset = column(parameters, "offset", lines)
        turns = 1 / column(parameters, "gear", lines)
        radius = stack(parameters[f"spool{spool}.R"] for spool in spools)
        self.way = radius * turns / column(parameters, "advantage", lines)
        self.home_joints = np.zeros(len(spools))

    def gaps(self, q: Array, r: Array, R: Array, hidden: Array) -> Array:
        """How far each line is too short to reach from its anchor to the point."""
        reach = np.linalg.norm(r[..., None, :] - self.anchors, axis=-1)
        return reach - np.linalg.norm(self.anchors, axis=-1) - q * self.way - self.offset

    def forward(self, q: ArrayLike, start: tuple[ArrayLike, ArrayLike] | None = None) -> Pose:
        """The point that three lines hold; the others must agree, or ValueError."""
        q = np.asarray(q, dtype=float)
        r0, R0 = _batch(q.shape[:-1], *(start or (self.home, self.home_turn)))
        pose = _make_pose_function(r0, R0, ["x", "y", "z"])
        r, R = pose(solve(lambda u: self.gaps(q, *pose(u), u)[..., :3], np.zeros(r0.shape)))
        if np.max(self.max_gap(q, r, R), initial=0) > 1e-9:
            raise ValueError("a line is slack or overstretched there")
        return r, R

    def inverse(
        self,
        r: ArrayLike | None = None,
        R: ArrayLike | None = None,
        start: ArrayLike | None = None,
    ) -> tuple[Array, Array, Array]:
        """Motor angles that wind every line taut at `r`; gears of many turns need no search."""
        r = np.asarray(self.home if r is None else r, dtype=float)
        R = np.broadcast_to(np.eye(3), (*r.shape[:-1], 3, 3))
        still = np.zeros((*r.shape[:-1], len(self.way)))
        return self.gaps(still, r, R, r[..., :0]) / self.way, r, R


class FiveBar(Assembly):
    """Two cranks on motors, a rod from each crank's end to the point they carry."""

    moves = controls = "x y"
    home = (0.0, 0.1984, 0.0)
    home_joints = (2 * np.pi / 3, np.pi / 3)

    def ends(self, q: Array) -> list[Array]:
        """Where crank and rod meet, left and right."""
        p, found = self.parameters, []
        for k, side in enumerate(("left", "right")):
            arm = apply(axis_rotation("z", q[..., k] + p[f"{side}.q0"]), np.array([1.0, 0.0, 0.0]))
            found.append(stack([p[f"{side}.x"], p[f"{side}.y"], 0.0]) + p[f"{side}.crank"] * arm)
        return found

    def gaps(self, q: Array, r: Array, R: Array, hidden: Array) -> Array:
        """How far each rod is too short to reach the point."""
        rods = [self.parameters[f"{side}.rod"] for side in ("left", "right")]
        away = [np.linalg.norm(r - end, axis=-1) for end in self.ends(q)]
        return np.stack(away, axis=-1) - np.array(rods)


class FiveBarWithTool(FiveBar):
    """A five-bar whose end point is fixed to one rod, away from the hinge of both rods.

    The rod turns with an angle of its own: the hidden coordinate. It carries hinge and point.
    """

    def __init__(
        self,
        parameters: Parameters,
        carrier: int,
        home: Sequence[float],
        joints: Sequence[float],
        angle: float,
    ) -> None:
        super().__init__(parameters)
        self.carrier, self.home, self.home_joints = carrier, tuple(home), tuple(joints)
        self.angle = angle

    def hidden(self, q: Array, r: Array, R: Array) -> Array:
        """The angle of the carrying rod near home."""
        return np.full((*q.shape[:-1], 1), self.angle)

    def gaps(self, q: Array, r: Array, R: Array, hidden: Array) -> Array:
        """How far the point is from where its rod holds it (2), and how long the other rod is."""
        p, ends = self.parameters, self.ends(q)
        sides = ("left", "right")
        own, other = sides[self.carrier], sides[1 - self.carrier]
        turned = axis_rotation("z", hidden[..., 0])
        hinge = ends[self.carrier] + apply(turned, np.array([p[f"{own}.rod"], 0.0, 0.0]))
        point = hinge + apply(turned, np.array([p["tool.x"], p["tool.y"], 0.0]))
        away = np.linalg.norm(hinge - ends[1 - self.carrier], axis=-1, keepdims=True)
        return np.concatenate([(r - point)[..., :2], away - p[f"{other}.rod"]], axis=-1)


class Deltesian(Assembly):
    """Two carriages on rails hold the nozzle over a bed that slides; {B} slides with the bed."""

    moves = controls = "x y z"
    home = (0.0, 0.0, 0.05)
    home_joints = (0.2109, 0.2109, 0.0)

    def gaps(self, q: Array, r: Array, R: Array, hidden: Array) -> Array:
        """How far each rod is too short, and how far the nozzle is from the rails' plane."""
        p = self.parameters
        turned = axis_rotation("z", p["bed.turn"]) @ axis_rotation("x", p["bed.lean"])
        slide = turned @ np.array([0.0, 1.0, 0.0])
        nozzle = r - (q[..., 2:] + p["bed.q0"]) * slide
        found = []
        for k, side in enumerate(("left", "right")):
            foot = np.array([p[f"{side}.x"], 0.0, p[f"{side}.z"]])
            rail = axis_rotation("y", p[f"{side}.lean"]) @ np.array([0.0, 0.0, 1.0])
            away = (nozzle - foot - q[..., k : k + 1] * rail)[..., [0, 2]]
            found.append(np.linalg.norm(away, axis=-1) - p[f"{side}.rod"])
        return np.stack([*found, nozzle[..., 1]], axis=-1)
