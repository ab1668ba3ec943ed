"""Errors of the pose from readings that show poses, such as the pixels of an image.

No pose was measured there. The change of the predicted pose that explains the residuals of one
sample best stands for measured minus predicted; its covariance is that of the readings' noise. As
with a registered pose device, an error that all samples share is not visible: the sensor's own
frames have absorbed it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from parallel_cal.identification.linearisation import Linearisation, follow_closure
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.predictions import predict_configurations
from parallel_cal.identification.thresholds import (
    IMAGE_POSE_STEPS,
    MAX_IMAGE_POSE_SIGMA_RATIO,
    MAX_SCORING_STEPS,
    MIN_IMAGE_NOISE_DOF,
    MIN_IMAGE_NOISE_SHARE,
    RELATIVE_RANK,
)
from parallel_cal.model.model import Model

IMAGE_SCATTER = "scatter within images"  # source of a noise that is not stated


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
    """Find the poses that the readings show, from the configurations x (N, nq+12+nu) that the model
    predicts; None without a sensor that shows poses."""
    if not _shows_pose(model).any():
        return None
    n = len(model.joints)
    alone = ~observations.measured[:, n : n + 6].any(axis=1)  # no pose device measured there
    solved = np.flatnonzero(np.isfinite(x).all(axis=1) & alone)
    fitted = _fit_poses(model, observations.select(solved), x[solved], model.mechanism.moved)
    change, covariance = np.full((len(x), 6), np.nan), np.full((len(x), 6, 6), np.nan)
    change[solved], covariance[solved] = fitted.change, fitted.covariance
    # Few corners, or corners on one line, show a pose with an error that would hide all others.
    variance = np.diagonal(covariance, axis1=1, axis2=2).reshape(-1, 2, 3).sum(axis=2)
    finite = variance[np.isfinite(variance).all(axis=1)]
    usual = np.median(finite, axis=0) if len(finite) else np.full(variance.shape[1], np.nan)
    with np.errstate(invalid="ignore"):
        vague = variance > MAX_IMAGE_POSE_SIGMA_RATIO**2 * usual
    change[vague.any(axis=1)], covariance[vague.any(axis=1)] = np.nan, np.nan
    return ShownPoses(change, covariance)


def find_shown_changes(
    model: Model, observations: Observations, rows: np.ndarray, readings: np.ndarray
) -> np.ndarray:
    """Changes (N, n_moved, m) of the poses that small changes of the readings (N, n_channels, m)
    show, by least squares in units of their noise; `rows` are the derivatives by (q, r, w) from
    `Linearisation.blocks`."""
    n, closure = len(model.joints), model.structure.phi.shape[0]
    used = _shows_pose(model) & np.isfinite(observations.reading)
    weight = used / np.where(used, observations.get_reading_sigma(model), 1.0)
    by_pose = rows[:, closure:, [n + i for i in model.mechanism.moved]] * weight[:, :, None]
    return np.asarray(np.linalg.pinv(by_pose) @ (readings * weight[:, :, None]))


def add_joint_noise(
    shown: ShownPoses, model: Model, observations: Observations, x: np.ndarray
) -> ShownPoses:
    """Add the noise of the joints, which moves the predicted poses, to the covariance of the
    changes, at the configurations x (N, nq+12+nu) that the model predicts."""
    known = np.flatnonzero(shown.known)
    n, moved = len(model.joints), model.mechanism.moved
    none = np.zeros(len(model.values), dtype=bool)
    linearise = Linearisation(model, observations.select(known), none, weighted=True)
    to_pose = follow_closure(model, linearise.blocks(model.values, x[known])[1])[0]
    covariance = shown.covariance.copy()
    covariance[np.ix_(known.tolist(), moved, moved)] += np.einsum(
        "nij,njk,nlk->nil", to_pose, observations.S[known, :n, :n], to_pose
    )
    return replace(shown, covariance=covariance)


def measure_image_noise(model: Model, observations: Observations) -> Observations:
    """Measure the noise of images where it is not stated: what remains of their pixels after each
    image has got a pose of its own.

    The robot has no influence on it, so that chi2 can show an error of the robot's model. The
    parameters of the lens take their degrees of freedom.
    """
    shows = _shows_pose(model)
    unknown = [kind for kind in observations.unknown if (kind.channels & shows).any()]
    if not unknown:
        return observations
    x = predict_configurations(model, observations)
    fitted = _fit_poses(model, observations, x, list(range(6)))
    channels, sigma = np.array(model.structure.channels), observations.get_reading_sigma(model)
    sigma = np.array(sigma)
    for sensor in (s for s in model.sensors if s.name in {kind.name for kind in unknown}):
        own = np.isin(channels, sensor.channels)
        residual = fitted.residual[:, own]
        rows = int(np.isfinite(residual).sum())
        images = int(np.isfinite(residual).any(axis=1).sum())
        own_parameters = model.table.matching([f"{sensor.name}.*"]) & ~np.asarray(model.fixed)
        dof = rows - 6 * images - int(own_parameters.sum())
        if dof < MIN_IMAGE_NOISE_DOF:
            return observations
        measured = float(np.sqrt(np.nansum(residual**2) / dof))
        sigma[:, own] = max(measured, MIN_IMAGE_NOISE_SHARE * sensor.guessed_sigma)
    known = tuple(kind for kind in observations.unknown if kind not in unknown)
    sources = dict(observations.noise_from)
    if not any(kind.channels.any() for kind in known):
        sources["reading"] = IMAGE_SCATTER
    return replace(observations, reading_sigma=sigma, unknown=known, noise_from=sources)


@dataclass(frozen=True)
class _Fitted:
    """Poses that images show: changes (n, 6), covariance (n, 6, 6), and what remains of the
    readings (n, n_channels) of sensors that show poses; NaN where they do not determine a pose."""

    change: np.ndarray
    covariance: np.ndarray
    residual: np.ndarray


def _shows_pose(model: Model) -> np.ndarray:
    """Mask (n_channels,) of the channels of sensors that show poses."""
    return np.array([s.shows_pose for s in model.sensors for _ in s.channels], dtype=bool)


def _fit_poses(
    model: Model, observations: Observations, x: np.ndarray, coordinates: list[int]
) -> _Fitted:
    """Fit some of the six coordinates of the pose to the readings of each sample, from x."""
    n, closure = len(model.joints), model.structure.phi.shape[0]
    moved = [n + i for i in coordinates]
    weight = _shows_pose(model) * np.isfinite(observations.reading)
    weight = weight / observations.get_reading_sigma(model)
    linearise = Linearisation(model, observations, np.zeros(len(model.values), dtype=bool), True)
    here = x
    for _ in range(IMAGE_POSE_STEPS):
        phi, C, _ = linearise.blocks(model.values, here)
        left, sizes, right = np.linalg.svd(
            C[:, closure:, moved] * weight[:, :, None], full_matrices=False
        )
        enough = (weight > 0).sum(axis=1) > len(moved)
        told = enough & (sizes[:, -1] > RELATIVE_RANK * sizes[:, 0])
        inverse = 1 / np.where(told[:, None], sizes, np.inf)
        pinv = right.transpose(0, 2, 1) * inverse[:, None, :]
        residual = (phi[:, closure:] * weight)[:, :, None]
        step = np.zeros((len(here), C.shape[2]))
        step[:, moved] = -(pinv @ (left.transpose(0, 2, 1) @ residual))[:, :, 0]
        here = model.configuration(here).apply_change(step).rows
    change = model.configuration(here).change_from(model.configuration(x))[:, n : n + 6]
    spread = np.zeros((len(here), 6, 6))
    spread[np.ix_(range(len(here)), coordinates, coordinates)] = pinv @ pinv.transpose(0, 2, 1)
    rest = linearise.blocks(model.values, here)[0][:, closure:]
    return _Fitted(
        np.where(told[:, None], change, np.nan),
        np.where(told[:, None, None], spread, np.nan),
        np.where((weight > 0) & told[:, None], rest, np.nan),
    )


def estimate_robot_error(shown: ShownPoses) -> tuple[float, float] | None:
    """Estimate the rms position error of the robot without the noise of the readings, and its
    standard deviation (m); None for fewer than two samples.

    Maximum likelihood for errors of the same size along all axes that the readings see with their
    own noise: directions that an image shows precisely count most. The error contains the scatter
    of the joints, unless `add_joint_noise` has added it to the covariance.
    """
    known = shown.known
    if known.sum() < 2:
        return None
    axes = np.flatnonzero(np.diagonal(shown.covariance[known], axis1=1, axis2=2)[:, :3].min(0) > 0)
    size, vectors = np.linalg.eigh(shown.covariance[known][:, axes[:, None], axes])
    along = np.einsum("nji,nj->ni", vectors, shown.change[known][:, axes]) ** 2
    variance = float(np.maximum(np.mean(along - size), np.mean(size) * 1e-3))
    for _ in range(MAX_SCORING_STEPS):
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
