"""A mechanism's drawing as a tree of links: driven joints, and passive ones that close loops."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.compiled import Single, dense
from parallel_cal.base.errors import ModelError
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import Model

FIXED_POINT_TOLERANCE_M = 1e-7  # m: a point that moves less in a body's frame is fixed on it
JOINT_SWING = 0.5  # rad or 1 m: how far a joint is moved to find its axis
TELESCOPE_HALF_FRACTION = 0.6  # of the shortest length: how long each half of a telescope is
X, Y, Z = np.eye(3)


@dataclass(frozen=True)
class Joint:
    """A joint at `origin` (m) of its parent, frames parallel where it stands at zero; `value` is
    what a passive one is at, None for the robot's own."""

    name: str
    turns: bool
    parent: str
    child: str
    axis: np.ndarray
    origin: np.ndarray
    value: Any = None


@dataclass(frozen=True)
class Segment:
    """A piece of a link from one point (3,) of its frame to another, m."""

    kind: str
    ends: tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class _Body:
    """A frame that moves: R and origin p in {B} as expressions of the configuration."""

    name: str
    R: Any
    p: Any


@dataclass
class Tree:
    """Links by name and the joints between them; the first link is the root."""

    model: Model
    links: dict[str, list[Segment]] = field(default_factory=dict)
    joints: list[Joint] = field(default_factory=list)

    @cached_property
    def passive(self) -> list[str]:
        """Names of the joints that no motor drives."""
        return [joint.name for joint in self.joints if joint.value is not None]

    @cached_property
    def _values(self) -> Single:
        values = [joint.value for joint in self.joints if joint.value is not None]
        return Single(dense("passive", [self.model.structure.configuration], [ca.vertcat(*values)]))

    def values(self, x: np.ndarray) -> np.ndarray:
        """Where the passive joints stand (rad, m) at a configuration (nq + 12,)."""
        return self._values(x)[0]


def tree_of(model: Model) -> Tree:
    """The tree of a model's geometry; ModelError where the mechanism does not draw itself."""
    return _Builder(model).tree


class _Builder:
    def __init__(self, model: Model):
        s = model.structure
        self._s, self._model, self.tree = s, model, Tree(model)
        lines = model.mechanism.drawing(s.q, s.r, s.R, s.geometry)
        if not lines:
            raise ModelError(f"{model.mechanism.name} has no drawing, so there is no tree of it")
        self._lines = [
            (line.kind, [self._substitute_values(p) for p in line.points]) for line in lines
        ]
        self._samples = _samples(model)
        base, platform = (model.frames[name] for name in ("base", "platform"))
        self._bodies = [_Body(base, ca.SX.eye(3), ca.SX.zeros(3))]
        self.tree.links[base] = []
        for i in range(len(model.joints)):
            self._add_driven(i)
        self._add_platform(platform)
        for k, (kind, points) in enumerate(self._lines, start=1):
            for j, ends in enumerate(pairwise(points)):
                self._add_segment(f"{kind}{k}" + (f"_{j}" if len(points) > 2 else ""), kind, *ends)

    def _substitute_values(self, expression: Any) -> Any:
        return ca.substitute(ca.SX(expression), self._s.v, ca.DM(self._model.values))

    def _numbers(self, expression: Any, x: np.ndarray | None = None) -> np.ndarray:
        """An expression at configurations (K, nq + 12): (K, ...), those of the samples."""
        f = ca.Function("f", [self._s.configuration], [expression])
        rows = self._samples if x is None else x
        return np.array([np.array(f(row)) for row in rows]).squeeze(-1)

    # ------------------------------------------------------------------ bodies

    def _add_driven(self, i: int) -> None:
        """The body that joint i alone moves, if something is drawn on it."""
        s, m = self._s, self._model.mechanism
        own, others = s.q[i], [s.q[j] for j in range(s.q.numel()) if j != i] + [s.r, s.R9]
        points = [
            p
            for _, line in self._lines
            for p in line
            if ca.depends_on(p, own) and not ca.depends_on(p, ca.vertcat(*others))
        ]
        if not points:
            return
        x = np.array([m.home.configuration] * 3)
        x[:, i] += (-JOINT_SWING, 0.0, JOINT_SWING)
        ways = [self._numbers(p, x) for p in points]
        before, at, after = max(ways, key=lambda way: float(np.linalg.norm(way[2] - way[0])))
        turns, name = m.joint_units[i] == "rad", self._model.joints[i]
        if turns:
            axis = np.cross(at - before, after - at)
            axis, middle = axis / np.linalg.norm(axis), (before + after) / 2
            inwards = (middle - at) / np.linalg.norm(middle - at)
            origin = at + inwards * np.linalg.norm(after - before) / (2 * np.sin(JOINT_SWING))
            R, p = _rotation_about(axis, own), ca.DM(origin)
        else:
            axis, origin = (after - at) / JOINT_SWING, np.zeros(3)
            R, p = ca.SX.eye(3), ca.DM(axis) * own
        body = _Body(f"{name}_link", R, p)
        self._bodies.append(body)
        self._join(Joint(name, turns, self._bodies[0].name, body.name, axis, origin))

    def _add_platform(self, name: str) -> None:
        """Free in the base: three ways, then turns about z, y, x."""
        r, R = self._s.r, self._s.R
        turns = [
            ca.atan2(R[1, 0], R[0, 0]),
            ca.atan2(-R[2, 0], ca.sqrt(R[0, 0] ** 2 + R[1, 0] ** 2)),
            ca.atan2(R[2, 1], R[2, 2]),
        ]
        turned = zip(("yaw", "pitch", "roll"), (Z, Y, X), turns, strict=True)
        steps = [
            *_make_sliding_steps(r),
            *((what, True, axis, value) for what, axis, value in turned),
        ]
        self._chain(self._bodies[0].name, np.zeros(3), name, steps)
        self._bodies.append(_Body(name, R, r))

    def _place(self, body: _Body, point: Any) -> np.ndarray | None:
        """A point in a body's frame, where it is fixed there."""
        places = self._numbers(body.R.T @ (point - body.p))
        return places[0] if np.abs(places - places[0]).max() < FIXED_POINT_TOLERANCE_M else None

    # ------------------------------------------------------------------ segments

    def _add_segment(self, name: str, kind: str, a: Any, b: Any) -> None:
        """On the body that holds both ends; else as a rod, from a body that holds one."""
        held = [(body, self._place(body, a), self._place(body, b)) for body in self._bodies]
        for body, at_a, at_b in held:
            if at_a is not None and at_b is not None:
                return self.tree.links[body.name].append(Segment(kind, (at_a, at_b)))
        for body, at_a, at_b in sorted(held, key=lambda one: one[0] is held[-1][0]):
            if at_a is not None:
                return self._add_rod(name, kind, body, at_a, a, b)
            if at_b is not None:
                return self._add_rod(name, kind, body, at_b, b, a)
        self._chain(self._bodies[0].name, np.zeros(3), f"{name}_end", _make_sliding_steps(a))
        free = _Body(f"{name}_end", ca.SX.eye(3), a)
        return self._add_rod(name, kind, free, np.zeros(3), a, b)

    def _add_rod(
        self, name: str, kind: str, body: _Body, origin: np.ndarray, a: Any, b: Any
    ) -> None:
        """Along x from a body's point, which it may turn about; a telescope where its length
        changes, driven where a joint's reading is that change."""
        d = body.R.T @ (b - a)
        flat = ca.sqrt(d[0] ** 2 + d[1] ** 2)
        steps = [("yaw", True, Z, ca.atan2(d[1], d[0])), ("pitch", True, Y, ca.atan2(-d[2], flat))]
        self._chain(body.name, origin, name, steps)
        length = ca.norm_2(d)
        lengths = self._numbers(length).ravel()
        if np.ptp(lengths) < FIXED_POINT_TOLERANCE_M:
            self.tree.links[name].append(Segment(kind, (np.zeros(3), lengths[0] * X)))
            return
        half = TELESCOPE_HALF_FRACTION * lengths.min() * X
        self.tree.links[name].append(Segment(kind, (np.zeros(3), half)))
        joint, origin = self._drive(f"{name}_length", length)
        self._join(
            Joint(joint, False, name, f"{name}_tip", X, origin, None if origin.any() else length)
        )
        self.tree.links[f"{name}_tip"].append(Segment(kind, (-half, np.zeros(3))))

    def _drive(self, name: str, length: Any) -> tuple[str, np.ndarray]:
        """The joint that reads a length's change, and its length at zero; else a passive one."""
        for i, joint in enumerate(self._model.joints):
            rest = self._numbers(length - self._s.q[i]).ravel()
            if (
                self._model.mechanism.joint_units[i] == "m"
                and np.ptp(rest) < FIXED_POINT_TOLERANCE_M
            ):
                return joint, rest[0] * X
        return name, np.zeros(3)

    def _chain(
        self, parent: str, origin: np.ndarray, name: str, steps: Sequence[tuple[Any, ...]]
    ) -> None:
        """Passive joints one behind the other, to a link of this name."""
        for k, (what, turns, axis, value) in enumerate(steps):
            child = name if k == len(steps) - 1 else f"{name}_{what}_link"
            self._join(Joint(f"{name}_{what}", turns, parent, child, axis, origin, value))
            parent, origin = child, np.zeros(3)

    def _join(self, joint: Joint) -> None:
        self.tree.joints.append(joint)
        self.tree.links[joint.child] = []


def _make_sliding_steps(point: Any) -> list[tuple[Any, ...]]:
    """Three sliding joints to a point."""
    return [("x", False, X, point[0]), ("y", False, Y, point[1]), ("z", False, Z, point[2])]


def _samples(model: Model) -> np.ndarray:
    """Configurations of the closed mechanism, (K, nq + 12)."""
    r, R = poses_in_workspace(model.mechanism, 20, np.random.default_rng(0))
    found = Kinematics(model).inverse(r, R)
    if not found.solved.any():
        raise ModelError(f"{model.mechanism.name}: no pose of its workspace is reached")
    return found[found.solved].configuration.rows


def _rotation_about(axis: np.ndarray, angle: Any) -> Any:
    """Rotation about a unit axis (Rodrigues)."""
    K = ca.skew(ca.DM(axis))
    return ca.SX.eye(3) + ca.sin(angle) * K + (1 - ca.cos(angle)) * (K @ K)
