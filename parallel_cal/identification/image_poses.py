"""Errors of the pose from readings that show poses, such as the pixels of an image.

No pose was measured there. The change of the predicted pose that explains the residuals of one
sample best stands for measured minus predicted; its covariance is that of the readings' noise. As
with a registered pose device, an error that all samples share is not visible: the sensor's own
frames have absorbed it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parallel_cal.identification.linearisation import Linearisation
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.thresholds import (
    IMAGE_POSE_STEPS,
    MAX_ROBOT_ERROR_STEPS,
    RELATIVE_RANK,
)
from parallel_cal.model.configuration import Configuration
from parallel_cal.model.model import Model


@dataclass(frozen=True)
class ShownPoses:
    """Changes (N, 6) of predicted poses, m and rad about base axes, that the readings show, and
    their covariance (N, 6, 6); NaN where the readings of a sample do not determine the pose. Zero
    in coordinates that the mechanism does not move."""

    change: np.ndarray
    covariance: np.ndarray

    @property
    def known(self) -> np.ndarray:
        """Mask (N,) of the samples whose readings determine the pose."""
        return np.isfinite(self.change).all(axis=1)


def find_shown_poses(model: Model, observations: Observations, x: np.ndarray) -> ShownPoses | None:
    """Find the poses that the readings show, from the configurations x (N, nq+12) that the model
    predicts; None without a sensor that shows poses."""
    shows = [sensor.shows_pose for sensor in model.sensors for _ in sensor.channels]
    if not any(shows):
        return None
    n, closure = len(model.joints), model.structure.phi.shape[0]
    moved = model.mechanism.moved
    weight = np.array(shows) * np.isfinite(observations.reading)
    weight = weight / observations.get_reading_sigma(model)
    change = np.full((len(x), 6), np.nan)
    covariance = np.full((len(x), 6, 6), np.nan)
    solved = np.flatnonzero(np.isfinite(x).all(axis=1) & ~_has_measured_pose(model, observations))
    observed, here = observations.select(solved), x[solved]
    linearise = Linearisation(model, observed, np.zeros(len(model.values), dtype=bool), True)
    for _ in range(IMAGE_POSE_STEPS):
        phi, C, _ = linearise.blocks(model.values, here)
        J = C[:, closure:, [n + i for i in moved]] * weight[solved, :, None]
        left, sizes, right = np.linalg.svd(J, full_matrices=False)
        enough = (weight[solved] > 0).sum(axis=1) > len(moved)
        told = enough & (sizes[:, -1] > RELATIVE_RANK * sizes[:, 0])
        inverse = np.where(told[:, None], 1 / np.where(told[:, None], sizes, 1.0), np.nan)
        pinv = right.transpose(0, 2, 1) * inverse[:, None, :]
        residual = (phi[:, closure:] * weight[solved])[:, :, None]
        step = np.zeros((len(here), n + 6))
        step[:, [n + i for i in moved]] = -(pinv @ (left.transpose(0, 2, 1) @ residual))[:, :, 0]
        here = Configuration.from_rows(here).apply_change(np.nan_to_num(step)).rows
    total = Configuration.from_rows(here).change_from(Configuration.from_rows(x[solved]))[:, n:]
    spread = np.zeros((len(here), 6, 6))
    spread[np.ix_(range(len(here)), moved, moved)] = pinv @ pinv.transpose(0, 2, 1)
    change[solved] = np.where(told[:, None], total, np.nan)
    covariance[solved] = np.where(told[:, None, None], spread, np.nan)
    return ShownPoses(change, covariance)


def _has_measured_pose(model: Model, observations: Observations) -> np.ndarray:
    """Mask (N,) of the samples at which a pose device measured something."""
    return np.asarray(observations.measured[:, len(model.joints) :].any(axis=1))


def estimate_robot_error(shown: ShownPoses) -> tuple[float, float] | None:
    """Estimate the rms position error of the robot without the noise of the readings, and its
    standard deviation (m); None for fewer than two samples.

    Maximum likelihood for errors of the same size along all axes that the readings see with their
    own noise: directions that an image shows precisely count most.
    """
    known = shown.known
    if known.sum() < 2:
        return None
    axes = np.flatnonzero(np.diagonal(shown.covariance[known], axis1=1, axis2=2)[:, :3].min(0) > 0)
    size, vectors = np.linalg.eigh(shown.covariance[known][:, axes[:, None], axes])
    along = np.einsum("nji,nj->ni", vectors, shown.change[known][:, axes]) ** 2
    variance = float(np.maximum(np.mean(along - size), np.mean(size) * 1e-3))
    for _ in range(MAX_ROBOT_ERROR_STEPS):
        total = variance + size
        information = 0.5 * np.sum(1 / total**2)
        slope = 0.5 * np.sum((along - total) / total**2)
        better = max(variance + slope / information, 0.0)
        if abs(better - variance) < 1e-6 * (better + variance):
            break
        variance = better
    count = len(axes)
    rms = float(np.sqrt(count * variance))
    sigma = float(count * information**-0.5)  # of the variance of the norm
    return rms, sigma / (2 * rms) if rms**2 > sigma else float(np.sqrt(sigma))
