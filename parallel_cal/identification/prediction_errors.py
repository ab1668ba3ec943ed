"""Errors of a model at measured samples: position, orientation and joint errors."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from parallel_cal.identification.image_poses import ShownPoses, find_shown_poses
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.predictions import (
    axes_of_device,
    condition_columns,
    predict_poses,
    reading_residuals,
    turns_between,
)
from parallel_cal.kinematics.kinematics import Kinematics, Solutions
from parallel_cal.model.configuration import Configuration
from parallel_cal.model.model import Model
from parallel_cal.recordings.transforming import find_measured_after_turn

ERRORS = ("position", "orientation", "joint", "reading", "pixel")


@dataclass(frozen=True)
class Summary:
    """Mean and rms of the norms of each kind of error (table 5.15), SI or px, None if not measured;
    the rms of the closure's rows combines all kinds if the closure is redundant."""

    position_mean: float | None = None
    position_rms: float | None = None
    orientation_mean: float | None = None
    orientation_rms: float | None = None
    joint_mean: float | None = None
    joint_rms: float | None = None
    reading_mean: float | None = None
    reading_rms: float | None = None
    pixel_mean: float | None = None
    pixel_rms: float | None = None
    closure_rms: float | None = None

    def mean(self, kind: str) -> float | None:
        """The mean norm of one of ERRORS."""
        value: float | None = getattr(self, f"{kind}_mean")
        return value

    def rms(self, kind: str) -> float | None:
        """The rms norm of one of ERRORS."""
        value: float | None = getattr(self, f"{kind}_rms")
        return value

    @property
    def is_known(self) -> bool:
        """Whether anything was measured."""
        return any(value is not None for value in vars(self).values())

    def document(self) -> dict[str, float | None]:
        return dict(vars(self))


@dataclass(frozen=True)
class Errors:
    """Measured minus predicted (table 5.9).

    position (N, 3) m and orientation (N, 3) rad about base axes from forward kinematics; joint (N,
    nq) from inverse kinematics; reading (N, n_channels) m and pixel (N, n_channels) px of the other
    sensors from forward kinematics; closure (N, n_rows) m at the measured values; NaN if not known.
    The reading of an angle is the arc at the characteristic length.
    Where no pose was measured but pixels show one, position and orientation are those of the
    `image_poses`.
    """

    position: np.ndarray
    orientation: np.ndarray
    joint: np.ndarray
    reading: np.ndarray
    closure: np.ndarray
    pixel: np.ndarray

    def norms(self, kind: str) -> np.ndarray:
        """Norms (N,) over the known components of a sample, NaN if none is known; for pixels the
        rms distance of a corner from its prediction."""
        part = getattr(self, kind)
        known = np.isfinite(part)
        norms = np.linalg.norm(np.where(known, part, 0.0), axis=1)
        if kind == "pixel":
            norms = norms / np.sqrt(np.maximum(known.sum(axis=1), 2) / 2)
        return np.where(known.any(axis=1), norms, np.nan)

    def select(self, index: np.ndarray) -> Errors:
        return Errors(**{name: array[index] for name, array in self.parts().items()})

    def blank(self) -> Errors:
        """Errors of the same samples, all unknown."""
        return Errors(**{name: np.full_like(a, np.nan) for name, a in self.parts().items()})

    def only_at(self, samples: np.ndarray) -> Errors:
        """Errors at a mask (N,) of the samples, NaN at the others."""
        return Errors(**{name: where_known(samples, a) for name, a in self.parts().items()})

    @property
    def judged(self) -> np.ndarray:
        """Mask (N,) of samples with a known error of the pose or of a reading; if none has one, of
        those with a known error of the joints, which contradict each other."""
        kinds = ("position", "orientation", "reading", "pixel")
        known = np.any([np.isfinite(self.norms(kind)) for kind in kinds], axis=0)
        return np.asarray(known if known.any() else np.isfinite(self.norms("joint")))

    def parts(self) -> dict[str, np.ndarray]:
        """The arrays by name."""
        return {part.name: getattr(self, part.name) for part in fields(self)}

    @cached_property
    def summary(self) -> Summary:
        """Mean and rms of the norms of each kind, None where not measured."""
        entries: dict[str, float | None] = {}
        for kind in ERRORS:
            norms = self.norms(kind)
            norms = norms[np.isfinite(norms)]
            entries[f"{kind}_mean"] = float(norms.mean()) if len(norms) else None
            entries[f"{kind}_rms"] = _rms(norms)
        closure = _rms(self.closure[np.isfinite(self.closure)])
        return Summary(**entries, closure_rms=closure)

    def document(self) -> dict[str, float | None]:
        """The `summary` for a document."""
        return self.summary.document()


def _rms(values: np.ndarray) -> float | None:
    return float(np.sqrt((values**2).mean())) if len(values) else None


def compute_mean_and_sigma(values: np.ndarray, groups: np.ndarray) -> tuple[float, float]:
    """Mean of the values (N,), and its standard deviation from the scatter between groups.

    Visits of one pose are one group: together they are one proof. The standard deviation is NaN for
    fewer than two groups.
    """
    _, at, sizes = np.unique(groups, return_inverse=True, return_counts=True)
    mean, count = float(values.mean()), len(sizes)
    if count < 2:
        return mean, math.nan
    totals = np.bincount(at, values) - sizes * mean
    return mean, math.sqrt(count / (count - 1) * float(totals @ totals)) / len(values)


def compute_rms_and_sigma(squares: np.ndarray, groups: np.ndarray) -> tuple[float, float | None]:
    """Root of the mean of squares (N,), and its standard deviation from the scatter between groups
    (as in `compute_mean_and_sigma`); None if it is not known."""
    mean, sigma = compute_mean_and_sigma(squares, groups)
    root = math.sqrt(mean)
    return root, sigma / (2 * root) if root > 0 and math.isfinite(sigma) else None


def compute_rms_sigmas(found: Errors, groups: np.ndarray) -> dict[str, float]:
    """Standard deviation of the rms of each known kind of error, from the scatter between groups
    (N,) of samples; without the kinds for which it is not known."""
    sigmas = {}
    for kind in ERRORS:
        norms = found.norms(kind)
        known = np.isfinite(norms)
        if not known.any():
            continue
        _, sigma = compute_rms_and_sigma(norms[known] ** 2, groups[known])
        if sigma is not None:
            sigmas[kind] = sigma
    return sigmas


@dataclass(frozen=True)
class PoseErrors:
    """Measured minus predicted `position` (N, 3) m and `orientation` (N, 3) rad as in `Errors`,
    with the predicted poses in {B} (`reached`) and as the device shows them (`pose`), the
    configurations (N, nq+12+nu) with the latter, and the poses that images show."""

    position: np.ndarray
    orientation: np.ndarray
    reached: Solutions
    pose: Solutions
    configurations: np.ndarray
    shown: ShownPoses | None

    @classmethod
    def of(cls, model: Model, observations: Observations) -> PoseErrors:
        n, m = len(model.joints), model.mechanism
        seen = model.configuration(observations.x)
        measured = observations.measured[:, : n + 6]
        reached, pose = predict_poses(model, observations)
        turn = turns_between(seen.R, pose.rotation)
        placed, orientation = (
            find_judgeable_samples(model, measured[:, n:], part) for part in (range(3), range(3, 6))
        )
        apart = np.where(measured[:, n : n + 3], seen.r - pose.position, 0.0)
        apart = keep_moved_coordinates(model, apart, range(3))
        turn = np.where(measured[:, n + 3 :], turn, 0.0)
        turn = keep_moved_coordinates(model, turn, range(3, 6))
        predicted = Configuration(seen.q, pose.position, pose.rotation, pose.passive).rows
        position = where_known(placed & pose.solved, apart)
        turned = where_known(orientation & pose.solved, turn)
        if shown := find_shown_poses(model, observations, predicted):
            judged = [any(i in m.moved for i in part) for part in (range(3), range(3, 6))]
            position = np.where(shown.known[:, None] & judged[0], shown.change[:, :3], position)
            turned = np.where(shown.known[:, None] & judged[1], shown.change[:, 3:], turned)
        return cls(position, turned, reached, pose, predicted, shown)


def errors(model: Model, observations: Observations) -> Errors:
    """Compare measured and predicted values at every sample: the pose and the readings predicted
    from the joints, and the joints from the pose."""
    found = PoseErrors.of(model, observations)
    reached, pose, predicted = found.reached, found.pose, found.configurations
    closure = _compute_closure(model, observations, pose)
    residuals = where_known(pose.solved, reading_residuals(model, observations, predicted))
    relative = [c for sensor in model.sensors if sensor.relative for c in sensor.channels]
    for k in np.flatnonzero(np.isin(model.structure.channels, relative)):
        known = np.isfinite(residuals[:, k])
        if known.any():
            residuals[known, k] -= residuals[known, k].mean()
    in_pixels = model.structure.channel_units == "px"
    return Errors(
        found.position,
        found.orientation,
        _compute_joint_errors(Kinematics(model), observations, reached, pose),
        residuals * model.structure.reading_lengths,
        where_known(find_fully_measured_samples(model, observations), closure),
        np.where(in_pixels, residuals, np.nan),
    )


def _compute_closure(model: Model, observations: Observations, reached: Solutions) -> np.ndarray:
    """The rows of the closure (N, rows) at the measured joints and poses, without what passive
    coordinates explain; these are near the predicted ones."""
    s, n = model.structure, len(model.joints)
    phi, passive = s.phi.shape[0], model.mechanism.passive_columns
    if not passive:
        return s.residuals(observations.x, observations.a, model.values)[0][:, :phi]
    x = observations.x.copy()
    x[:, n + 12 :] = np.where(reached.solved[:, None], reached.passive, x[:, n + 12 :])
    rows, C, _ = s.rows_batch(x, observations.a, model.values)
    U = C.reshape(len(x), -1, rows.shape[1]).transpose(0, 2, 1)[:, :phi, passive]
    rows = rows[:, :phi, None]
    return np.asarray((rows - U @ (np.linalg.pinv(U) @ rows))[:, :, 0])


def _compute_joint_errors(
    kinematics: Kinematics, observations: Observations, reached: Solutions, pose: Solutions
) -> np.ndarray:
    """Measured minus predicted joints (N, nq); NaN if a controlled coordinate was not measured.

    Redundant joints contradict each other even if nothing else was measured: then the predicted
    ones are those of the pose that fits all of them best.
    `reached` are the predicted poses in {B}, `pose` the same poses as the device shows them.
    """
    model, n = kinematics.model, len(kinematics.model.joints)
    m, apart = model.mechanism, np.full((len(observations), n), np.nan)
    if model.structure.equations > len(m.moves):
        pose_unknown = ~observations.measured[:, n : n + 6].any(axis=1)
        alone = np.flatnonzero(pose_unknown & (not model.sensors))
        apart[alone] = _compute_disagreement(kinematics, observations.select(alone), reached[alone])
    known = find_known_coordinates(model, observations.measured[:, n : n + 6])
    given = np.flatnonzero(known[:, m.controlled].all(axis=1))
    if not len(given):
        return apart
    read, seen = observations.select(given), model.configuration(observations.x[given])
    # Take the predicted orientation, not the identity, if it was not measured: the position of the
    # target depends on it.
    turned_known = np.asarray(read.measured[:, n + 3 : n + 6].all(axis=1))
    kept = turned_known[:, None, None] | ~np.isfinite(pose.rotation[given])
    at_target = Configuration(seen.q, seen.r, np.where(kept, seen.R, pose.rotation[given])).rows
    position, turned = model.structure.to_base(at_target[:, n:], model.values)
    at = condition_columns(model, read)
    # Search in the measured assembly mode: an arm's wrist may be flipped relative to home.
    turned = turned.reshape(-1, 3, 3)
    found = kinematics.inverse(position, turned, at, reached[given], keep_branch=True)
    difference = seen.q - found.joints
    # Whole turns of a revolute joint change nothing; those of a spool (period 0) do.
    difference = difference - m.joint_periods * np.round(difference / (2 * np.pi))
    apart[given] = where_known(found.solved, difference)
    return apart


def _compute_disagreement(
    kinematics: Kinematics, observations: Observations, reached: Solutions
) -> np.ndarray:
    """Joint readings (N, nq) minus those of the poses that were `reached`, in {B}."""
    if not len(observations):
        return np.full((0, len(kinematics.model.joints)), np.nan)
    at = condition_columns(kinematics.model, observations)
    found = kinematics.inverse(reached.position, reached.rotation, at, reached, keep_branch=True)
    difference = observations.x[:, : len(kinematics.model.joints)] - found.joints
    return where_known(reached.solved & found.solved, difference)


def find_fully_measured_samples(model: Model, observations: Observations) -> np.ndarray:
    n = len(model.joints)
    known = find_known_coordinates(model, observations.measured[:, n : n + 6])
    return np.asarray(known[:, model.mechanism.moved].all(axis=1))


def find_judgeable_samples(model: Model, measured: np.ndarray, part: range) -> np.ndarray:
    """Samples (N,) whose position (or orientation) can be judged: every coordinate of it that the
    mechanism moves was measured (N, 6); if it moves none, all three were."""
    moved = [i for i in part if i in model.mechanism.moved]
    return np.asarray(find_known_coordinates(model, measured)[:, moved or list(part)].all(axis=1))


def find_known_coordinates(model: Model, measured: np.ndarray) -> np.ndarray:
    """Coordinates (N, 6) that the device measured, or that follow in {B} from those that it
    measured: its x and y may be x and z of a robot that moves in a vertical plane."""
    turn = np.kron(np.eye(2), axes_of_device(model))
    return np.asarray(measured | find_measured_after_turn(measured, turn))


def keep_moved_coordinates(model: Model, difference: np.ndarray, part: range) -> np.ndarray:
    """Return errors (..., 3) of the position or the orientation, in axes of the device, without the
    coordinates of {B} that the mechanism holds while it moves others: a planar robot has no error
    across its plane. If it moves none of the three, the errors are unchanged."""
    moved = np.array([i in model.mechanism.moved for i in part])
    if moved.all() or not moved.any():
        return difference
    to_base = axes_of_device(model)
    return np.asarray(difference @ (to_base.T @ (moved[:, None] * to_base)))


def where_known(known: np.ndarray, difference: np.ndarray) -> np.ndarray:
    return np.where(known[:, None], difference, np.nan)


def improvement(before: Summary, after: Summary) -> dict[str, float | None]:
    """Factors of improvement: sum of error norms before over after (table 5.9, eq. 5.20)."""
    factors: dict[str, float | None] = {}
    for kind in ERRORS:
        a, b = before.mean(kind), after.mean(kind)
        factors[kind] = a / b if a is not None and b else None
    return factors


def held_out_ratio(before: Summary, after: Summary) -> float | None:
    """Error after over before, of the pixels of an image; else the geometric mean over the measured
    parts of the pose; without a pose, of the other sensors' readings, or of the joints."""

    def ratios(*kinds: str) -> list[float]:
        pairs = [(before.rms(kind), after.rms(kind)) for kind in kinds]
        return [b / a for a, b in pairs if a and b]

    known = ratios("pixel") or ratios("position", "orientation") or ratios("reading", "joint")[:1]
    return math.exp(sum(math.log(r) for r in known) / len(known)) if known else None
