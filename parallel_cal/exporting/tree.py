"""Turn a mechanism's drawing into a tree of links with driven and passive joints."""

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
from parallel_cal.mechanisms.serial import Serial
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import Model

FIXED_POINT_TOLERANCE_M = 1e-7  # m; a point that moves less in a body's frame is fixed to it
JOINT_SWING = 0.5  # rad or m by which a joint is moved to find its axis
TELESCOPE_HALF_FRACTION = 0.6  # length of each half of a telescope, per shortest total length
X, Y, Z = np.eye(3)


@dataclass(frozen=True)
class Joint:
    """A joint at `origin` (m) of its parent; both frames are parallel at zero.

    `value` is the expression of a passive joint's position, and None for a driven joint.
    """

    name: str
    turns: bool
    parent: str
    child: str
    axis: np.ndarray
    origin: np.ndarray
    value: Any = None


@dataclass(frozen=True)
class Segment:
    """A piece of a link between two points (3,) of its frame, m."""

    kind: str
    ends: tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class _Body:
    """A moving frame: R and origin p in {B} as expressions of the configuration."""

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
        """Return the positions of the passive joints (rad, m) at a configuration (nq + 12,)."""
        return self._values(x)[0]


def tree_of(model: Model) -> Tree:
    """Return the tree of a model's geometry; without a drawing it has the base, the platform and
    an empty link for each reading.

    ModelError if the mechanism is a serial arm, which has no passive joints, or if no pose of the
    workspace is reached.
    """
    if isinstance(model.mechanism, Serial):
        raise ModelError(f"{model.mechanism.name} is a serial arm, so it has no passive joints")
    return _Builder(model).tree


class _Builder:
    def __init__(self, model: Model):
        s = model.structure
        self._s, self._model, self.tree = s, model, Tree(model)
        lines = s.drawing()
        values = ca.DM(model.values)
        self._lines = [
            (line.kind, [ca.substitute(ca.SX(p), s.v, values) for p in line.points])
            for line in lines
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
        self._add_undrawn()

    def _numbers(self, expression: Any, x: np.ndarray | None = None) -> np.ndarray:
        """Evaluate an expression at configurations (K, nq + 12), by default at the samples."""
        f = ca.Function("f", [self._s.configuration], [expression])
        rows = self._samples if x is None else x
        return np.asarray(f(rows.T).full().T)  # one column for each configuration

    # ------------------------------------------------------------------ bodies

    def _add_driven(self, i: int) -> None:
        """Add the body that only joint i moves, if a line is drawn on it."""
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
        # The point that moves most shows the axis best.
        paths = [self._numbers(p, x) for p in points]
        before, at, after = max(paths, key=lambda path: float(np.linalg.norm(path[2] - path[0])))
        turns, name = m.joint_units[i] == "rad", self._model.joints[i]
        if turns:
            axis = np.cross(at - before, after - at)
            axis, middle = axis / np.linalg.norm(axis), (before + after) / 2
            inwards = (middle - at) / np.linalg.norm(middle - at)
            origin = at + inwards * np.linalg.norm(after - before) / (2 * np.sin(JOINT_SWING))
            K = ca.skew(ca.DM(axis))
            R = ca.SX.eye(3) + ca.sin(own) * K + (1 - ca.cos(own)) * (K @ K)  # Rodrigues
            p = ca.DM(origin)
        else:
            axis, origin = (after - at) / JOINT_SWING, np.zeros(3)
            R, p = ca.SX.eye(3), ca.DM(axis) * own
        body = _Body(f"{name}_link", R, p)
        self._bodies.append(body)
        self._join(Joint(name, turns, self._bodies[0].name, body.name, axis, origin))

    def _add_undrawn(self) -> None:
        """Add a joint beside the base for each reading that is not the position of a drawn link,
        such as the angle of a motor that winds a line: programs know the joints by these names."""
        drawn, units = {joint.name for joint in self.tree.joints}, self._model.mechanism.joint_units
        for name, unit in zip(self._model.joints, units, strict=True):
            if name not in drawn:
                base, origin = self._bodies[0].name, np.zeros(3)
                self._join(Joint(name, unit == "rad", base, f"{name}_link", Z, origin))

    def _add_platform(self, name: str) -> None:
        """Add the platform, free in the base: three translations, then rotations about z, y, x."""
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
        """Return a point in a body's frame if it is fixed there, else None."""
        places = self._numbers(body.R.T @ (point - body.p))
        return places[0] if np.abs(places - places[0]).max() < FIXED_POINT_TOLERANCE_M else None

    # ------------------------------------------------------------------ segments

    def _add_segment(self, name: str, kind: str, a: Any, b: Any) -> None:
        """Add a segment to the body of both ends; else add a rod to the body of one end."""
        places = [(body, self._place(body, a), self._place(body, b)) for body in self._bodies]
        for body, at_a, at_b in places:
            if at_a is not None and at_b is not None:
                return self.tree.links[body.name].append(Segment(kind, (at_a, at_b)))
        for body, at_a, at_b in sorted(places, key=lambda one: one[0] is places[-1][0]):
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
        """Add a rod along x from a point of a body, about which it turns.

        It is a telescope if its length changes, and driven if a joint reads this change.
        """
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
        """Return the joint that reads a length's change, with the length at zero; else `name`."""
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
        """Add passive joints in series, up to a link of this name."""
        for k, (what, turns, axis, value) in enumerate(steps):
            child = name if k == len(steps) - 1 else f"{name}_{what}_link"
            self._join(Joint(f"{name}_{what}", turns, parent, child, axis, origin, value))
            parent, origin = child, np.zeros(3)

    def _join(self, joint: Joint) -> None:
        self.tree.joints.append(joint)
        self.tree.links[joint.child] = []


def _make_sliding_steps(point: Any) -> list[tuple[Any, ...]]:
    """Return three sliding joints to a point."""
    return [("x", False, X, point[0]), ("y", False, Y, point[1]), ("z", False, Z, point[2])]


def _samples(model: Model) -> np.ndarray:
    """Return configurations (K, nq + 12) of the closed mechanism."""
    r, R = poses_in_workspace(model.mechanism, 20, np.random.default_rng(0))
    found = Kinematics(model).inverse(r, R)
    if not found.solved.any():
        raise ModelError(f"{model.mechanism.name}: no pose of its workspace is reached")
    return found[found.solved].configuration.rows
