"""Express the poses of a dataset in another frame."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from parallel_cal.base.errors import DatasetError
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.recording import Array

MAX_ROUNDING = 1e-9  # of a rotation matrix: a smaller entry is zero


def find_measured_after_turn(measured: NDArray[np.bool_], turn: Array) -> NDArray[np.bool_]:
    """Mask (N, 6) of the coordinates that follow, after a turn (6, 6) of the axes, from those that
    were measured (N, 6)."""
    needs = np.abs(turn) > MAX_ROUNDING
    return np.all(measured[:, None, :] | ~needs, axis=2)


def transform_poses(dataset: Dataset, r: Array, R: Array, frame: str) -> Dataset:
    """Return the samples with poses and covariances transformed: x -> R x + r, and named `frame`.

    A new coordinate is measured if all coordinates were measured from which it follows. Raise
    DatasetError if R mixes measured coordinates with others: a rotation in the plane keeps x and y
    of a sample without z.
    """
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = R
    measured = find_measured_after_turn(dataset.measured, turn)
    if (measured.sum(axis=1) < dataset.measured.sum(axis=1)).any():
        raise DatasetError(
            f"{dataset.source or 'samples'}: single coordinates of a position or rotation were "
            "measured, and the transformation to another frame mixes them with those that were "
            "not; expected whole positions and rotations, or a frame that is turned only about "
            "the axis that was not measured"
        )
    position = np.where(dataset.measured[:, :3], dataset.r, 0.0) @ R.T + r
    turned = np.any(dataset.measured[:, 3:], axis=1)[:, None, None]
    known = np.nan_to_num(dataset.pose_cov)
    diagonal = np.diagonal(dataset.pose_cov, axis1=1, axis2=2)
    given = ~np.isnan(diagonal)
    covariance = turn @ known @ turn.T  # NaN as zero, and restored below
    gaps = ~(given[:, :, None] & given[:, None, :])
    covariance[gaps] = np.nan
    return dataclasses.replace(
        dataset,
        r=np.where(measured[:, :3], position, dataset.r),
        R=np.where(turned, R @ dataset.R, dataset.R),
        measured=measured,
        pose_cov=covariance,
        frame=frame,
    )
