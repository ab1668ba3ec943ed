"""Fit the few numbers of a firmware to a model, and compute the loss of accuracy.

The fit makes the motors of the firmware's own kinematics agree with those of the calibrated model
and its effects over the workspace. All values are in SI units.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import nearest_rotation, rotation_vector
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.kinematics.solutions import Solutions
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import Model

Array = np.ndarray
# Poses over the workspace, for the fit and for its validation.
N_FIT_POSES = 400
N_VALIDATION_POSES = 2000
BED_POSES = 200  # on the plate that a probe touched, where the first layer is printed
BED_WEIGHT = 10.0  # weight of a height on that plate; other errors have 1
MAX_EQUAL_DIFFERENCE_M = 1e-7  # m; the numbers are written with this digit
EQUAL = 1e-9  # m or rad, between numbers of a firmware that are the same
STEP = 1e-6  # rad or m, for differences
MICRO = 1e6  # the fit is in um and urad, so that its tolerances are below any written digit


class Firmware(Protocol):
    """The kinematics that a controller computes with its numbers."""

    @property
    def homed(self) -> Array:
        """Motors (n,), m or rad, at their end-stops."""

    def joints(self, r: Array, R: Array) -> Array:
        """Return motors (N, n) for the pose r (N, 3), R (N, 3, 3); NaN out of reach."""


def are_equal(one: Any, other: Any) -> bool:
    """Return whether two firmwares have equal numbers, to a nanometre or nanoradian."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(are_equal(one[k], other[k]) for k in one)
    if one is None or other is None:
        return one is other
    if hasattr(one, "__dict__"):
        return type(one) is type(other) and are_equal(vars(one), vars(other))
    try:
        return np.allclose(one, other, rtol=0, atol=EQUAL, equal_nan=True)
    except (TypeError, ValueError):
        return bool(one == other)


@dataclass(frozen=True)
class Frame:
    """The frame of a firmware: r = origin + axes r_F in {B}.

    Motor k is joint order[k] of the model, and the reading grows by signs[k] times the
    motor: 1 or -1, or m per count. The bed of a printer is the plane z = 0, unless `bed_anywhere`:
    the firmware counts from its motors, and the owner states the height of the bed as an offset of
    his work.
    """

    order: tuple[int, ...]
    signs: Array
    origin: Array = field(default_factory=lambda: np.zeros(3))
    axes: Array = field(default_factory=lambda: np.eye(3))
    turn: Array = field(default_factory=lambda: np.eye(3))  # axes without the tilt of the plate
    bed_anywhere: bool = False

    def poses(self, r: Array, R: Array) -> tuple[Array, Array]:
        return np.linalg.solve(self.axes, (r - self.origin).T).T, self.turn.T @ R

    def motors(self, q: Array) -> Array:
        """Return readings (..., n) in the firmware's order and direction."""
        return np.asarray(q)[..., list(self.order)] / self.signs

    def readings(self, motors: Array) -> Array:
        return np.asarray((motors * self.signs)[..., np.argsort(self.order)])


@dataclass(frozen=True)
class Machine:
    """A firmware that moves the robot.

    Its motors count from the end-stops, where the robot's joints read `stops` (n,).
    """

    firmware: Firmware
    frame: Frame
    stops: Array

    def readings(self, r: Array, R: Array) -> Array:
        motors = self.firmware.joints(*self.frame.poses(r, R))
        return self.stops + self.frame.readings(motors - self.firmware.homed)


@dataclass(frozen=True)
class Projection:
    """A firmware's numbers for a model, as text by file and field.

    No number states the frame and the joint readings at the end-stops (`stops`). `expressed` are
    the effects that the numbers express.
    """

    settings: Mapping[str, Mapping[str, str]]
    frame: Frame
    stops: Array
    remarks: tuple[str, ...] = ()
    head: str = ""  # comment at the head of each file
    expressed: tuple[str, ...] = ()


@dataclass(frozen=True)
class Bed:
    """The plate z = height + slopes . (x, y) of {B} (m, 1) that a probe touched."""

    height: float
    slopes: tuple[float, float]

    @property
    def normal(self) -> Array:
        return np.array([-self.slopes[0], -self.slopes[1], 1.0])

    def poses(self, model: Model, n: int) -> tuple[Array, Array]:
        """Return n poses on the plate, spread evenly over the circle around the workspace's box."""
        low, high = (
            np.array(corner)
            for corner in (model.mechanism.workspace.low, model.mechanism.workspace.high)
        )
        k = np.arange(n) + 0.5
        out, around = np.sqrt(k / n), k * np.pi * (3 - 5**0.5)  # the sunflower pattern
        xy = np.column_stack([np.cos(around), np.sin(around)]) * out[:, None]
        xy = (low + high)[:2] / 2 + xy * (high - low)[:2] / 2**0.5
        z = self.height + xy @ np.array(self.slopes)
        return np.column_stack([xy, z]), np.broadcast_to(np.eye(3), (n, 3, 3))


class Refinement(Protocol):
    """Knowledge of the machine itself, besides the model."""

    def refine(self, model: Model, numbers: Array, machine: Callable[[Array], Machine]) -> Array:
        """Return the numbers (k,) that agree with it, from those that agree with the model."""


class TargetPoses:
    """The poses that a model reaches, with its joints."""

    def __init__(self, model: Model, r: Array, R: Array):
        self.kinematics, m = Kinematics(model, quick=True), model.mechanism
        found = self.kinematics.inverse(r, R)
        self.at = found[found.solved]
        self.controlled, self.more = m.controlled, len(m.joints) > len(m.controlled)

    @classmethod
    def over_workspace(cls, model: Model, n: int, seed: int) -> TargetPoses:
        """Draw n poses over the model's workspace; ModelError if none is reached."""
        rng = np.random.default_rng(seed)
        wanted = cls(model, *poses_in_workspace(model.mechanism, n, rng))
        if not len(wanted.at):
            raise ModelError(f"{model.mechanism.name} reaches no pose of its workspace")
        return wanted

    @classmethod
    def on_bed(cls, model: Model, bed: Bed, machine: Machine) -> TargetPoses:
        """Take poses on a bed that both the model and a machine reach.

        The rim of the bed is outside the workspace's box.
        """
        r, R = bed.poses(model, BED_POSES)
        reached = np.isfinite(machine.readings(r, R)).all(axis=1)
        return cls(model, r[reached], R[reached])

    @cached_property
    def controlled_jacobian(self) -> Array:
        """Derivative (N, m, n) of the controlled coordinates by the joints.

        With more joints than coordinates, the errors are those of the joints (rad or m), because
        lines that pull against each other must not slacken either.
        """
        q, columns = self.at.joints, []
        if self.more:
            return np.broadcast_to(np.diag(self.winds), (len(q), q.shape[1], q.shape[1]))
        for step in STEP * np.eye(q.shape[1]):
            ahead, back = (self.kinematics.direct(q + s * step, start=self.at) for s in (1, -1))
            change = compute_pose_difference(back, ahead) / (2 * STEP)
            columns.append(change[:, self.controlled])
        return np.stack(columns, axis=2)

    @property
    def weights(self) -> Array:
        """Weights (m,) of the rows of `controlled_jacobian`: an angle weighs as the motion of the
        platform's joints that it causes."""
        if self.more:
            return np.ones(len(self.winds))
        length = self.kinematics.model.mechanism.length
        return np.array([1.0 if i < 3 else length for i in self.controlled])

    @property
    def winds(self) -> Array:
        m = self.kinematics.model.mechanism
        return np.array(m.winds or (1.0,) * len(m.joints))


def compute_pose_difference(wanted: Solutions, found: Solutions) -> Array:
    """Return the difference (N, 6) of poses: m, and rad about the base axes."""
    turned = rotation_vector(found.rotation @ wanted.rotation.transpose(0, 2, 1))
    return np.hstack([found.position - wanted.position, turned])


def fit_numbers(
    model: Model,
    start: Array,
    machine: Callable[[Array], Machine],
    bed: Bed | None = None,
    present: Refinement | None = None,
) -> Array:
    """Return the numbers (k,) with which a machine moves the robot closest to the wanted poses.

    The fit is a least-squares fit of the controlled coordinates, from `start`. Heights on a
    printer's `bed` have more weight, so that errors that the firmware cannot represent (leaning
    towers) do not spoil them. `present`, knowledge of the present machine, refines the numbers.
    """
    from scipy.optimize import least_squares

    wanted = TargetPoses.over_workspace(model, N_FIT_POSES, seed=2)
    parts = [(wanted.at, wanted.weights[:, None] * wanted.controlled_jacobian)]
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
    numbers = np.asarray(least_squares(missed, start, x_scale=scale, **tight).x)
    return numbers if present is None else present.refine(model, numbers, machine)


def loss(model: Model, machine: Machine) -> dict[str, Any]:
    """Return the loss: reached minus commanded pose, at poses that the fit did not use.

    For robots with more joints than degrees of freedom, also the error of the lines (m).

    `without_frame` is the loss after the commanded poses were moved as a rigid body to where they
    agree best with the reached ones: `shift` (m, of their middle) and `turn` (rad), about the base
    axes. Numbers for another frame have a large loss and a small one without their frame.
    """
    wanted = TargetPoses.over_workspace(model, N_VALIDATION_POSES, seed=1)
    q = machine.readings(wanted.at.position, wanted.at.rotation)
    start = wanted.at[np.isfinite(q).all(axis=1)]
    found = wanted.kinematics.direct(q[np.isfinite(q).all(axis=1)], start=start)
    start, found = start[found.solved], found[found.solved]
    document = summary(model, start, found)
    if len(found):
        moved, shift, turn = move_to_frame(model, start, found)
        document["without_frame"] = {"shift": shift, "turn": turn} | summary(model, moved, found)
    document |= {"poses": len(found), "not_reached": len(q) - len(found)}
    if wanted.more:
        lines = np.abs((q - wanted.at.joints) * wanted.winds)
        document |= {"line_mean": np.nanmean(lines), "line_max": np.nanmax(lines)}
    return document


def move_to_frame(
    model: Model, wanted: Solutions, found: Solutions
) -> tuple[Solutions, Array, Array]:
    """Return the wanted poses moved as a rigid body to the found ones (least squares).

    Also return the shift (3,) in m of their middle, and the turn (3,) in rad.
    """
    middle, centre = wanted.position.mean(axis=0), found.position.mean(axis=0)
    away = wanted.position - middle
    agreement = (found.position - centre).T @ away / len(away)
    if set(model.mechanism.controlled) & {3, 4, 5}:  # an orientation weighs like the poses' spread
        turned = (found.rotation @ wanted.rotation.transpose(0, 2, 1)).mean(axis=0)
        agreement = agreement + np.mean(away**2) * turned
    turn = nearest_rotation(agreement)
    moved = replace(wanted, position=centre + away @ turn.T, rotation=turn @ wanted.rotation)
    return moved, centre - middle, rotation_vector(turn)


def summary(model: Model, wanted: Solutions, found: Solutions) -> dict[str, Any]:
    """Return mean and largest error of the controlled coordinates, and where it is largest.

    The largest error of the orientation is stated with the commanded orientation (rotation vector
    in rad), that of the position with the commanded position (m).
    """
    change = compute_pose_difference(wanted, found)
    document: dict[str, Any] = {}
    places = {"position": wanted.position, "orientation": rotation_vector(wanted.rotation)}
    for kind, part in (("position", range(3)), ("orientation", range(3, 6))):
        columns = [i for i in part if i in model.mechanism.controlled]
        norm = np.linalg.norm(change[:, columns], axis=1)
        if columns and len(norm):
            worst = int(np.nanargmax(norm))
            document |= {
                f"{kind}_mean": np.nanmean(norm),
                f"{kind}_max": norm[worst],
                f"{kind}_worst_at": places[kind][worst],
            }
    return document
