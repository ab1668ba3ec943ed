"""Express the poses of a dataset in another frame."""

from __future__ import annotations

import dataclasses

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.recording import Array


def transform_poses(dataset: Dataset, r: Array, R: Array, frame: str) -> Dataset:
    """Return the samples with poses and covariances transformed: x -> R x + r, and named `frame`.

    The position must be measured in all directions or in none, and so must the rotation; otherwise
    raise DatasetError.
    """
    for part in (dataset.measured[:, :3], dataset.measured[:, 3:]):
        if (part.any(axis=1) != part.all(axis=1)).any():
            raise DatasetError(
                f"{dataset.source or 'samples'}: single coordinates of a position or rotation were "
                "measured; expected all or none: only whole positions and rotations can be "
                "transformed to another frame"
            )
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = R
    placed, turned = dataset.measured[:, :1], dataset.measured[:, 3, None, None]
    known = np.nan_to_num(dataset.pose_cov)
    diagonal = np.diagonal(dataset.pose_cov, axis1=1, axis2=2)
    given = ~np.isnan(diagonal)
    covariance = turn @ known @ turn.T  # NaN as zero, and restored below
    gaps = ~(given[:, :, None] & given[:, None, :])
    covariance[gaps] = np.nan
    return dataclasses.replace(
        dataset,
        r=np.where(placed, dataset.r @ R.T + r, dataset.r),
        R=np.where(turned, R @ dataset.R, dataset.R),
        pose_cov=covariance,
        frame=frame,
    )
