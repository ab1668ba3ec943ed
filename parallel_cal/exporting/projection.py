"""A model put into the few numbers of a firmware, and what is lost by that.

The firmware's own kinematics is refitted: its motors shall stand where the calibrated model, with
its effects, wants them over the workspace. All in SI.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import rotation_vector
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.kinematics.solutions import Solutions
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import Model

Array = np.ndarray
# poses over the workspace that numbers are fitted to, and judged at
N_FIT_POSES = 400
N_VALIDATION_POSES = 2000
BED_POSES = 200  # on the plate of a probe, where a printer's first layer is
BED_WEIGHT = 10.0  # of a height on that plate beside any other error over the workspace
STEP = 1e-6  # rad or m, for differences
MICRO = 1e6  # of m or rad: the fit's unit, so that its tolerances are far below any digit


class Firmware(Protocol):
    """What a controller computes with its numbers."""

    @property
    def homed(self) -> Array:
        """Motors (n,), m or rad, at their end-stops."""

    def joints(self, r: Array, R: Array) -> Array:
        """Motors (N, n) with which it goes to r (N, 3), R (N, 3, 3); NaN beyond its reach."""


@dataclass(frozen=True)
class Frame:
    """Its coordinates, r = origin + axes r_F in {B}; its k-th motor is joint order[k] of the model,
    whose reading grows by signs[k] times it."""

    order: tuple[int, ...]
    signs: Array
    origin: Array = field(default_factory=lambda: np.zeros(3))
    axes: Array = field(default_factory=lambda: np.eye(3))
    turn: Array = field(default_factory=lambda: np.eye(3))  # axes but for a tilted plate

    def poses(self, r: Array, R: Array) -> tuple[Array, Array]:
        return np.linalg.solve(self.axes, (r - self.origin).T).T, self.turn.T @ R

    def motors(self, q: Array) -> Array:
        """Readings (..., n) in the firmware's order and sense."""
        return np.asarray(q)[..., list(self.order)] * self.signs

    def readings(self, motors: Array) -> Array:
        return np.asarray((motors * self.signs)[..., np.argsort(self.order)])


@dataclass(frozen=True)
class Machine:
    """A firmware that moves the robot: its motors count from the end-stops, where the robot's
    joints read `stops` (n,)."""

    firmware: Firmware
    frame: Frame
    stops: Array

    def readings(self, r: Array, R: Array) -> Array:
        motors = self.firmware.joints(*self.frame.poses(r, R))
        return self.stops + self.frame.readings(motors - self.firmware.homed)


@dataclass(frozen=True)
class Projection:
    """A firmware's numbers for a model: by file and field, as text with its digits; the frame and
    what the joints read at the end-stops are what no number says."""

    settings: Mapping[str, Mapping[str, str]]
    frame: Frame
    stops: Array
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class Bed:
    """The plate z = height + slopes . (x, y) of {B} (m, 1) that a probe touched."""

    height: float
    slopes: tuple[float, float]

    @property
    def normal(self) -> Array:
        return np.array([-self.slopes[0], -self.slopes[1], 1.0])

    def poses(self, model: Model, n: int) -> tuple[Array, Array]:
        """Poses (n,) on it, evenly over the round bed around the workspace's box."""
        low, high = (
            np.array(corner)
            for corner in (model.mechanism.workspace.low, model.mechanism.workspace.high)
        )
        k = np.arange(n) + 0.5
        out, around = np.sqrt(k / n), k * np.pi * (3 - 5**0.5)  # a sunflower's seeds
        xy = np.column_stack([np.cos(around), np.sin(around)]) * out[:, None]
        xy = (low + high)[:2] / 2 + xy * (high - low)[:2] / 2**0.5
        z = self.height + xy @ np.array(self.slopes)
        return np.column_stack([xy, z]), np.broadcast_to(np.eye(3), (n, 3, 3))


class TargetPoses:
    """Those of some poses that a model reaches, and how its joints stand there."""

    def __init__(self, model: Model, r: Array, R: Array):
        self.kinematics, m = Kinematics(model, quick=True), model.mechanism
        found = self.kinematics.inverse(r, R)
        self.at = found[found.solved]
        self.controlled, self.more = m.controlled, len(m.joints) > len(m.controlled)

    @classmethod
    def over_workspace(cls, model: Model, n: int, seed: int) -> TargetPoses:
        """Of n poses over the model's workspace; ModelError where none is reached."""
        rng = np.random.default_rng(seed)
        wanted = cls(model, *poses_in_workspace(model.mechanism, n, rng))
        if not len(wanted.at):
            raise ModelError(f"{model.mechanism.name} reaches no pose of its workspace")
        return wanted

    @classmethod
    def on_bed(cls, model: Model, bed: Bed, machine: Machine) -> TargetPoses:
        """Of poses on a bed, whose rim lies outside the workspace's box: where both the model and
        a machine reach."""
        r, R = bed.poses(model, BED_POSES)
        reached = np.isfinite(machine.readings(r, R)).all(axis=1)
        return cls(model, r[reached], R[reached])

    @cached_property
    def controlled_jacobian(self) -> Array:
        """What is controlled by joint, (N, m, n); where joints are more, these themselves (rad or
        m), as lines that pull against each other must not be let go either."""
        q, columns = self.at.joints, []
        if self.more:
            return np.broadcast_to(np.diag(self.winds), (len(q), q.shape[1], q.shape[1]))
        for step in STEP * np.eye(q.shape[1]):
            ahead, back = (self.kinematics.direct(q + s * step, start=self.at) for s in (1, -1))
            change = compute_pose_difference(back, ahead) / (2 * STEP)
            columns.append(change[:, self.controlled])
        return np.stack(columns, axis=2)

    @property
    def winds(self) -> Array:
        m = self.kinematics.model.mechanism
        return np.array(m.winds or (1.0,) * len(m.joints))


def compute_pose_difference(wanted: Solutions, found: Solutions) -> Array:
    """By how much poses (N, 6) differ: m, and rad about base axes."""
    turned = rotation_vector(found.rotation @ wanted.rotation.transpose(0, 2, 1))
    return np.hstack([found.position - wanted.position, turned])


def fit_numbers(
    model: Model, start: Array, machine: Callable[[Array], Machine], bed: Bed | None = None
) -> Array:
    """The numbers (k,) with which a machine's motors take the robot where it shall go, by least
    squares in what it controls; `start` is near them.

    Heights on a printer's `bed` weigh more: what the firmware cannot follow (leaning towers) shall
    not be traded for them.
    """
    from scipy.optimize import least_squares

    wanted = TargetPoses.over_workspace(model, N_FIT_POSES, seed=2)
    parts = [(wanted.at, wanted.controlled_jacobian)]
    if bed is not None:
        on_bed = TargetPoses.on_bed(model, bed, machine(start))
        heights = np.einsum("i,nij->nj", bed.normal, on_bed.controlled_jacobian)[:, None]
        parts.append((on_bed.at, BED_WEIGHT * heights))

    def missed(numbers: Array) -> Array:
        at = machine(numbers)
        rows = [
            np.einsum("nij,nj->ni", slopes, at.readings(to.position, to.rotation) - to.joints)
            for to, slopes in parts
        ]
        return MICRO * np.concatenate([row.ravel() for row in rows])

    if np.isnan(missed(start)).any():
        raise ModelError(f"{model.mechanism.name}: the firmware does not reach its whole workspace")
    tight = {"ftol": 1e-14, "xtol": 1e-14, "gtol": 1e-14}
    scale = np.maximum(np.abs(start), 0.01)
    return np.asarray(least_squares(missed, start, x_scale=scale, **tight).x)


def loss(model: Model, machine: Machine) -> dict[str, Any]:
    """Where the robot goes less where its controller sends it, at poses that the fit did not see;
    of robots with more joints than freedoms that of their lines, too (m)."""
    wanted = TargetPoses.over_workspace(model, N_VALIDATION_POSES, seed=1)
    q = machine.readings(wanted.at.position, wanted.at.rotation)
    start = wanted.at[np.isfinite(q).all(axis=1)]
    found = wanted.kinematics.direct(q[np.isfinite(q).all(axis=1)], start=start)
    document = summary(model, start[found.solved], found[found.solved])
    reached = int(found.solved.sum())
    document |= {"poses": reached, "not_reached": len(q) - reached}
    if wanted.more:
        lines = np.abs((q - wanted.at.joints) * wanted.winds)
        document |= {"line_mean": np.nanmean(lines), "line_max": np.nanmax(lines)}
    return document


def summary(model: Model, wanted: Solutions, found: Solutions) -> dict[str, Any]:
    """Mean and largest difference of what the robot controls, and where it is largest."""
    change = compute_pose_difference(wanted, found)
    document: dict[str, Any] = {}
    for kind, part in (("position", range(3)), ("orientation", range(3, 6))):
        columns = [i for i in part if i in model.mechanism.controlled]
        norm = np.linalg.norm(change[:, columns], axis=1)
        if columns and len(norm):
            worst = int(np.nanargmax(norm))
            document |= {
                f"{kind}_mean": np.nanmean(norm),
                f"{kind}_max": norm[worst],
                f"{kind}_worst_at": wanted.position[worst],
            }
    return document
