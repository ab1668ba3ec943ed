"""Stewart platforms from balls and legs, and the assembly of any robot of rigid parts.

This module uses no other room. A robot is a list of gaps between parts that must touch. A pose is
found by moving the parts until the gaps vanish (`robot.solve`).
SI units; every function takes batches, arrays of shape (..., 3).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from parallel_cal.virtual.robot import Array, Parameters, apply, solve, stack, turn

Pose = tuple[Array, Array]
POSE = ["x", "y", "z", "rx", "ry", "rz"]


def column(parameters: Parameters, name: str, members: Sequence[str]) -> Array:
    """Stack one parameter of all legs, chains or lines: shape (..., members)."""
    return stack(parameters[f"{member}.{name}"] for member in members)


def vectors(parameters: Parameters, names: Sequence[str], members: Sequence[str]) -> Array:
    """Stack one point of all legs, chains or lines: shape (..., members, 3).

    `names` are its three coordinates; an empty name is a coordinate that is zero.
    """
    zero = np.zeros(len(members))
    return stack(column(parameters, name, members) if name else zero for name in names)


def numbered(what: str, count: int) -> list[str]:
    """List names such as leg1, leg2, ..."""
    return [f"{what}{i}" for i in range(1, count + 1)]


class Assembly:
    """Rigid parts that must touch; subclasses define their coordinates, joints and gaps.

    `moves` are the pose coordinates that the structure leaves free, `controls` those that are given
    in the inverse problem. Passive joints (`hidden`) may be unknowns, too.
    """

    moves = "x y z rx ry rz"
    controls = "x y z rx ry rz"
    home: ArrayLike = (0.0, 0.0, 0.0)
    home_turn: ArrayLike = np.eye(3)
    home_joints: ArrayLike

    def __init__(self, parameters: Parameters) -> None:
        self.parameters: Mapping[str, Any] = parameters

    def gaps(self, q: Array, r: Array, R: Array, hidden: Array) -> Array:
        """Compute the distances between parts that must touch, m, shape (..., gaps)."""
        raise NotImplementedError

    def hidden(self, q: Array, r: Array, R: Array) -> Array:
        """Estimate passive joints at which the parts nearly touch; by default there are none."""
        return np.zeros((*np.shape(r)[:-1], 0))

    def max_gap(self, q: ArrayLike, r: ArrayLike, R: ArrayLike) -> Array:
        """Compute the largest gap at the best passive joints, shape (...)."""
        q, r, R = (np.asarray(part, dtype=float) for part in (q, r, R))
        return np.abs(self.gaps(q, r, R, self.hidden(q, r, R))).max(axis=-1)

    def forward(self, q: ArrayLike, start: tuple[ArrayLike, ArrayLike] | None = None) -> Pose:
        """Find the pose (r, R) of the joints `q` that is nearest to `start`."""
        q = np.asarray(q, dtype=float)
        r0, R0 = _batch(q.shape[:-1], *(start or (self.home, self.home_turn)))
        pose, n = _make_pose_function(r0, R0, self.moves.split()), len(self.moves.split())
        u = np.concatenate([np.zeros((*q.shape[:-1], n)), self.hidden(q, r0, R0)], -1)
        u = solve(lambda u: self.gaps(q, *pose(u[..., :n]), u[..., n:]), u)
        return pose(u[..., :n])

    def inverse(
        self,
        r: ArrayLike | None = None,
        R: ArrayLike | None = None,
        start: ArrayLike | None = None,
    ) -> tuple[Array, Array, Array]:
        """Find joints q for the controlled coordinates of (r, R), and the resulting pose."""
        given = self.home if r is None else r, self.home_turn if R is None else R
        shape = np.broadcast_shapes(np.shape(given[0])[:-1], np.shape(given[1])[:-2])
        r0, R0 = _batch(shape, *given)
        q0 = np.asarray(self.home_joints if start is None else start, dtype=float)
        q0 = np.broadcast_to(q0, (*shape, q0.shape[-1]))
        follows = [c for c in self.moves.split() if c not in self.controls.split()]
        pose, n, m = _make_pose_function(r0, R0, follows), q0.shape[-1], q0.shape[-1] + len(follows)
        u = np.concatenate([q0, np.zeros((*shape, m - n)), self.hidden(q0, r0, R0)], -1)
        u = solve(lambda u: self.gaps(u[..., :n], *pose(u[..., n:m]), u[..., m:]), u)
        return u[..., :n], *pose(u[..., n:m])


def _batch(shape: tuple[int, ...], r: ArrayLike, R: ArrayLike) -> Pose:
    r, R = np.asarray(r, dtype=float), np.asarray(R, dtype=float)
    return np.broadcast_to(r, (*shape, 3)), np.broadcast_to(R, (*shape, 3, 3))


def _make_pose_function(
    r0: Array, R0: Array, coordinates: Sequence[str]
) -> Callable[[Array], Pose]:
    """Make a function to poses near (r0, R0), shifted along and turned about some base axes."""
    places = [POSE.index(c) for c in coordinates]

    def pose(u: Array) -> Pose:
        move = np.zeros((*r0.shape[:-1], 6))
        move[..., places] = u
        return r0 + move[..., :3], turn(move[..., 3:]) @ R0

    return pose


class Stewart(Assembly):
    """Six legs between balls B on the platform and balls C on the base (figure 3.8, eq. 3.8).

    The length of a leg is the reading of its transducer plus its offset L0.
    """

    home = (0.0, 0.0, 0.3)
    legs = numbered("leg", 6)

    def __init__(self, parameters: Parameters) -> None:
        super().__init__(parameters)
        self.platform = vectors(parameters, ["B_x", "B_y", "B_z"], self.legs)
        self.base = vectors(parameters, ["C_x", "C_y", "C_z"], self.legs)
        self.offset = column(parameters, "L0", self.legs)
        self.home_joints = self.leg_lengths(np.asarray(self.home), np.eye(3)) - self.offset

    def leg_lengths(self, r: Array, R: Array) -> Array:
        """Compute distances from ball to ball at pose (r, R), shape (..., legs)."""
        balls = r[..., None, :] + apply(R[..., None, :, :], self.platform)
        return np.linalg.norm(balls - self.base, axis=-1)

    def gaps(self, q: Array, r: Array, R: Array, hidden: Array) -> Array:
        """Compute by how much each leg is too short to reach from ball to ball."""
        return self.leg_lengths(r, R) - q - self.offset


class PlanarStewart(Stewart):
    """Three legs in a plane (figure 3.2, eq. 3.4: 18 parameters).

    At reading zero the balls of a leg are L0 apart. One ball slides along an axis that is turned by
    delta relative to the line between the balls.
    """

    moves = controls = "x y rz"
    home = (0.0, 0.0, 0.0)
    legs = numbered("leg", 3)

    def __init__(self, parameters: Parameters) -> None:
        zero = {f"{leg}.{name}_z": 0.0 for leg in self.legs for name in "BC"}
        super().__init__({**parameters, **zero})
        lean = column(parameters, "delta", self.legs)
        self.slide = stack([np.cos(lean), np.sin(lean)])

    def gaps(self, q: Array, r: Array, R: Array, hidden: Array) -> Array:
        """Compute the distance of each leg's ball, slid by q, from the platform's ball."""
        ball = stack([self.offset, np.zeros(len(self.legs))]) + q[..., None] * self.slide
        return self.leg_lengths(r, R) - np.linalg.norm(ball, axis=-1)
