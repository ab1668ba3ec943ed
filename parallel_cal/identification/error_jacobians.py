"""How the errors of a model follow from the noise of what was measured, and from the parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parallel_cal.identification.image_poses import ShownPoses, find_shown_changes
from parallel_cal.identification.linearisation import follow_closure
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.prediction_errors import (
    find_judgeable_samples,
    keep_moved_coordinates,
)
from parallel_cal.model.model import Model


@dataclass(frozen=True)
class ErrorJacobian:
    """Derivatives of one kind of error with k components, zero where one is not `known` (N, k).

    `by_measured` (N, k, nq+6+nu) are those by the measured (q, r, w), `by_parameter` (N, k, n_free)
    those of the prediction. `reading_sigma` (N, k) is the standard deviation of the reading that
    the error compares with its prediction; zero for errors of the pose and of the joints.
    """

    known: np.ndarray
    by_measured: np.ndarray
    by_parameter: np.ndarray
    reading_sigma: np.ndarray

    def compute_covariance(self, S: np.ndarray) -> np.ndarray:
        """Covariance (N, k, k) of the errors for the covariance S of (q, r, w)."""
        found = self.by_measured @ S @ self.by_measured.transpose(0, 2, 1)
        diagonal = np.einsum("nii->ni", found)  # a view
        diagonal += self.reading_sigma**2
        return np.asarray(found)


def differentiate_errors(
    model: Model,
    observations: Observations,
    rows: np.ndarray,
    by_free: np.ndarray,
    shown: ShownPoses | None = None,
) -> dict[str, ErrorJacobian]:
    """Differentiate each kind of error by what was measured, and by the free parameters: `rows` and
    `by_free` are the derivatives of the rows by them from `Linearisation.blocks`.

    Where only an image shows a pose (`shown`), this pose counts as measured.
    """
    n, m, s = len(model.joints), model.mechanism, model.structure
    count, _, quantities = rows.shape
    measured = observations.measured[:, n : n + 6].copy()
    if shown:
        measured[shown.known] = [i in m.moved for i in range(6)]

    pose, read = np.zeros((count, 6, quantities)), np.zeros((count, len(s.channels), quantities))
    pose_by_free = np.zeros((count, 6, by_free.shape[2]))
    by = np.concatenate([rows[:, :, :n], by_free], axis=2)
    to_pose, to_reading = follow_closure(model, rows, by)
    pose[:, range(6), range(n, n + 6)] = 1.0
    pose[:, m.moved, :n] -= to_pose[:, :, :n]
    read[:, :, :n] = -to_reading[:, :, :n]
    pose_by_free[:, m.moved], read_by_free = to_pose[:, :, n:], to_reading[:, :, n:]
    if shown and by_free.shape[2]:
        # The error of a pose that an image shows follows from the errors of its pixels.
        changes = find_shown_changes(model, observations, rows, read_by_free)
        pose_by_free[:, m.moved] = np.where(
            shown.known[:, None, None], changes, pose_by_free[:, m.moved]
        )
    pose, pose_by_free = (np.where(measured[:, :, None], one, 0.0) for one in (pose, pose_by_free))

    found = {}
    for kind, part in (("position", range(3)), ("orientation", range(3, 6))):
        known = find_judgeable_samples(model, measured, part)
        moved = [
            keep_moved_coordinates(model, one[:, part].transpose(0, 2, 1), part).transpose(0, 2, 1)
            for one in (pose, pose_by_free)
        ]
        none = np.zeros((count, 3))
        found[kind] = ErrorJacobian(np.tile(known[:, None], 3), moved[0], moved[1], none)
    found["joint"] = _differentiate_joint_errors(model, observations, rows, by_free)
    in_pixels = s.channel_units == "px"
    sigma = observations.get_reading_sigma(model)
    for kind, factor in (
        ("reading", np.where(in_pixels, 0.0, np.nan_to_num(s.reading_lengths))),
        ("pixel", in_pixels.astype(float)),
    ):
        known = np.isfinite(observations.reading) & (factor > 0)
        scale = known * factor
        found[kind] = ErrorJacobian(
            known,
            scale[:, :, None] * read,
            scale[:, :, None] * read_by_free,
            np.where(known, factor * sigma, 0.0),
        )
    return found


def _differentiate_joint_errors(
    model: Model, observations: Observations, rows: np.ndarray, by_free: np.ndarray
) -> ErrorJacobian:
    """Differentiate the measured joints minus those of the measured pose, by inverse kinematics."""
    n, m, closure = len(model.joints), model.mechanism, model.structure.phi.shape[0]
    solved_for = [*range(n), *[n + i for i in m.parasitic], *m.passive_columns]
    given = [n + i for i in m.controlled]
    inverse = -np.linalg.pinv(rows[:, :closure, solved_for])[:, :n]
    joint = np.zeros((len(rows), n, rows.shape[2]))
    joint[:, range(n), range(n)] = 1.0
    joint[:, :, given] -= inverse @ rows[:, :closure, given]
    return ErrorJacobian(
        np.tile(np.all(observations.measured[:, given], axis=1, keepdims=True), n),
        joint,
        inverse @ by_free[:, :closure],
        np.zeros((len(rows), n)),
    )
