"""Predict how well a set of poses would determine the parameters, before any measurement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parallel_cal.identification.estimate import EstimationProblem
from parallel_cal.identification.linearisation import Linearisation
from parallel_cal.identification.observability import Spectrum, spectrum
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.prior import Knowledge, Prior
from parallel_cal.identification.registration import frames_of
from parallel_cal.identification.thresholds import MAX_NAMED_DIRECTIONS
from parallel_cal.kinematics.kinematics import Solutions
from parallel_cal.model.configuration import Configuration
from parallel_cal.model.mechanism import POSE, list_shown_displacements
from parallel_cal.model.model import Model
from parallel_cal.model.words import direction_in_words, parameters_in_words
from parallel_cal.planning.indices import Indices, indices, prediction_rms
from parallel_cal.planning.posepool import Pool
from parallel_cal.planning.selection import SelectionProblem
from parallel_cal.planning.update import UpdatePlan, order_for_update
from parallel_cal.planning.visibility import predict_shown_readings

MIN_SHOWN_MOTION_M = 1e-9  # of a pose, by a direction that no pose determines
SAME_SIZE = 1e-6  # of the changes by single lengths: a common factor changes no reading

# Prior information if the tolerances are not a prior: every parameter to 100 tolerances. It keeps
# the information matrix invertible while the selected poses are too few.
VAGUE_INFORMATION = 1e-4


@dataclass(frozen=True)
class Expectation:
    """Expected result of an identification from a set of poses, if model and noise are right.

    sigma (n_free,) of the free parameters in their units, infinite if not identifiable; rms model
    uncertainty of the pose at validation poses (m, rad); pose (m) combines both, with angles times
    the mechanism's length. `undetermined_rms` (m) is the part of position_rms that no pose of the
    pool could reduce: directions of the parameters that the measurements do not determine stay as
    uncertain as their tolerances. Where no pose was measured, nothing shows where {B} is: errors
    are then those after {B} was placed as well as possible.
    """

    indices: Indices
    sigma: np.ndarray
    position_rms: float
    orientation_rms: float
    pose_rms: float
    undetermined_rms: float = 0.0


class View:
    """A linearised pool and validation poses, which give the information of every subset."""

    def __init__(self, sought: EstimationProblem, measured: np.ndarray, pool: Pool, unseen: Pool):
        self._sought, self._pool, self._measured = sought, pool, measured
        model, free = sought.model, sought.free
        self._A = white_blocks(model, free, measured, pool.poses, pool.a)
        self._scaled = self._A * sought.tolerance
        self._G = prediction_blocks(model, free, measured, unseen) * sought.tolerance
        self.is_without_device = not measured[len(model.joints) :].any()
        if self.is_without_device:
            self._G = remove_base_motion(model, self._G, unseen)
        self.rank = self._spectrum(np.arange(len(self._A))).rank

    @property
    def model(self) -> Model:
        return self._sought.model

    def rows(self, groups: np.ndarray) -> np.ndarray:
        return np.asarray(self._pool.groups[groups].ravel())

    def order_for_update(self, rows: np.ndarray, prior: Prior) -> UpdatePlan:
        """Order some poses of the pool by what they tell about the drift since the last fit."""
        model, poses, a = self.model, self._pool.poses[rows], self._pool.a[rows]
        seen = as_observations(model, self._measured, poses, a)
        return order_for_update(model, self._sought.free, prior, self._scaled[rows], seen)

    def problem(self, criterion: str) -> SelectionProblem:
        p = self._scaled.shape[2]
        blocks = self._scaled[self._pool.groups.ravel()]
        weight = np.eye(p) if criterion == "A" else self._weight(range(6))
        # Touches show little of some directions, however many there are: there a fit relies on the
        # tolerances.
        relies = self._sought.prior or self.is_without_device
        before = np.eye(p) * (1.0 if relies else VAGUE_INFORMATION)
        if isinstance(self._sought.prior, Prior):
            table = self._sought.model.table
            before = Knowledge.of(self._sought.prior, table, self._sought.free).information
        blocks = blocks.reshape(len(self._pool.groups), -1, p)
        return SelectionProblem(blocks, before, weight, criterion, self.rank)

    def expectation(self, rows: np.ndarray) -> Expectation:
        """Compute the expectation from the covariance of the fit, without VAGUE_INFORMATION."""
        seen = self._spectrum(rows)
        counted = indices(
            self._scaled[rows].reshape(-1, self._scaled.shape[2]), len(rows), self.rank
        )
        sigma = np.where(seen.lost, np.inf, np.sqrt(np.diag(seen.covariance)))
        blind = seen.rank < self.rank and not (self._sought.prior or self.is_without_device)
        scale = self._sought.tolerance
        covariance = seen.covariance / np.outer(scale, scale)
        # A fit leaves the parameters at the drawing along directions that it does not see.
        table, free = self._sought.model.table, self._sought.free
        unseen = seen.directions[seen.rank :] * (table.prior_sigma[free] / scale)
        unknown = np.zeros_like(covariance) if self._sought.prior else unseen.T @ unseen
        undetermined = prediction_rms(unknown, self._weight(range(3)))
        covariance = covariance + unknown
        errors = [
            np.inf if blind else prediction_rms(covariance, self._weight(part))
            for part in (range(3), range(3, 6), range(6))
        ]
        errors[1] /= self._sought.model.mechanism.length
        return Expectation(counted, sigma, errors[0], errors[1], errors[2], undetermined)

    @property
    def sees_size(self) -> bool:
        """Whether some pose of the pool shows a common factor of all free lengths: False if a robot
        of another size gives the same readings at joints that turn."""
        table, free = self._sought.model.table, self._sought.free
        model = self._sought.model
        if not self.is_without_device or set(model.mechanism.joint_units) != {"rad"}:
            return True  # the device or the joints are rulers
        lengths = np.where([p.unit == "m" for p in table], model.values, 0.0)[free]
        rows = self._A.reshape(-1, self._A.shape[2])
        shown = np.linalg.norm(rows @ lengths)
        return bool(shown > SAME_SIZE * np.linalg.norm(rows * lengths)) or not lengths.any()

    def warnings(self) -> list[str]:
        """List directions that no pose of the pool determines."""
        if self._sought.prior:
            return []
        seen, table = self._spectrum(np.arange(len(self._A))), self._sought.model.table
        free = self._sought.free
        words = []
        matters = np.ones(len(seen.unidentifiable), dtype=bool)
        if self.is_without_device:  # others move {B} as a whole, which is nothing to identify
            unseen = seen.directions[seen.rank :] * (table.prior_sigma / table.tolerance)[free]
            moved = np.abs(np.einsum("nik,jk->jni", self._G, unseen)).max(axis=(1, 2), initial=0.0)
            matters = moved > MIN_SHOWN_MOTION_M
        unknown = [d for d, m in zip(seen.unidentifiable, matters, strict=True) if m]
        if self.is_without_device and len(unknown) > MAX_NAMED_DIRECTIONS:
            part_of = {name for parts in unknown for name in parts}
            together = parameters_in_words((n for n in table.names if n in part_of), table)
            return [
                f"no pose determines {len(unknown)} combinations of {together}: there a fit keeps "
                "the drawing"
            ]
        for parts in unknown:
            them = "it" if len(parts) == 1 else "one of them"
            words.append(f"no pose determines {direction_in_words(parts, table)}: fix {them}")
        return words

    def _spectrum(self, rows: np.ndarray) -> Spectrum:
        J, sought = self._A[rows].reshape(-1, self._A.shape[2]), self._sought
        return spectrum(J, sought.model.table, sought.free, sought.prior, held=1.0)

    def _weight(self, part: range) -> np.ndarray:
        G = self._G[:, list(part)]
        return np.asarray(np.einsum("nij,nik->jk", G, G) / len(G))


def white_blocks(
    model: Model, free: np.ndarray, measured: np.ndarray, poses: Solutions, a: np.ndarray
) -> np.ndarray:
    """Return the whitened identification Jacobian (N, rows, n_free) at exact poses."""
    observations = as_observations(model, measured, poses, a)
    linearise = Linearisation(model, observations, free, weighted=True)
    return linearise(model.values, observations.x).jacobian


def prediction_blocks(
    model: Model, free: np.ndarray, measured: np.ndarray, pool: Pool
) -> np.ndarray:
    """Return d(r, length w)/d(free parameters) (N, 6, n_free) at fixed joints: -J_x^-1 J_v."""
    observations = as_observations(model, measured, pool.poses, pool.a)
    linearise = Linearisation(model, observations, free, weighted=True)
    rows = model.structure.phi.shape[0]
    C, J = (block[:, :rows] for block in linearise.blocks(model.values, observations.x)[1:])
    moved = model.mechanism.moved
    G = np.zeros((len(C), 6, J.shape[2]))
    follows = -np.linalg.pinv(C[:, :, model.mechanism.dependent_columns]) @ J
    G[:, moved] = follows[:, : len(moved)]
    G[:, 3:] *= model.mechanism.length
    return G


def remove_base_motion(model: Model, G: np.ndarray, pool: Pool) -> np.ndarray:
    """Return derivatives (N, 6, n_free) of predicted poses without their part that a small
    displacement of {B} explains: where {B} is shows in no reading of a touch."""
    r, n, length = pool.poses.position, len(G), model.mechanism.length
    moves = np.zeros((n, 6, 6))
    moves[:, range(3), range(3)] = 1.0
    moves[:, :3, 3:] = np.cross(np.eye(3)[None], r[:, None]).transpose(0, 2, 1) / length
    moves[:, range(3, 6), range(3, 6)] = 1.0
    held = np.setdiff1d(np.arange(6), model.mechanism.moved)
    moves[:, held] = 0.0
    # A displacement that would move a coordinate that the mechanism holds is none of the robot.
    shown = [POSE.index(c) for c in list_shown_displacements(model.mechanism.moves)]
    left = G.copy()
    for part in (slice(0, 3), slice(3, 6)):  # {B} is placed by positions, or by orientations
        D = moves[:, part][:, :, shown].reshape(3 * n, -1)
        flat = G[:, part].reshape(3 * n, -1)
        left[:, part] = (flat - D @ np.linalg.lstsq(D, flat, rcond=None)[0]).reshape(n, 3, -1)
    return left


def as_observations(
    model: Model, measured: np.ndarray, poses: Solutions, a: np.ndarray
) -> Observations:
    """Make observations of poses without measurement errors, weighted by the model's noise.

    The poses are those of {P} in {B}; the observations are of the target in the device's frame.
    """
    noise, at = model.noise, frames_of(model)
    x = Configuration(poses.joints, *at.see(poses.position, poses.rotation), poses.passive).rows
    device = [noise.position or 0.0] * 3 + [noise.orientation or 0.0] * 3
    passive = [0.0] * len(model.mechanism.passive)
    sigma = np.concatenate([np.nan_to_num(model.joint_noise), device, passive])
    S = np.broadcast_to(np.diag(np.square(sigma)), (len(x), len(sigma), len(sigma)))
    mask = np.broadcast_to(measured, (len(x), len(sigma)))
    source = {"joint": "model file", "pose": "model file"}
    return Observations(
        x, S, mask, a, np.arange(len(x)), predict_shown_readings(model, x, a), source
    )
