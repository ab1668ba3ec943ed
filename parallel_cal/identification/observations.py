"""Observations: a dataset as measured configurations with their covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.base.rotation import rotation_matrix, rotation_vector
from parallel_cal.identification.readings import doubt_readings
from parallel_cal.identification.thresholds import BLOCKS
from parallel_cal.model.configuration import Configuration
from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.samples import READING

ASSUMED = "assumed"  # source of a noise that was not measured
GUESS = "(if you do not know it: state a guess and noise.assumed: true)"
SCATTER = "scatter within dwells"  # source of a noise that is not stated


@dataclass(frozen=True)
class Observations:
    """N measured samples of one mechanism.

    x (N, nq+12) configurations (q, r, R9); S (N, nq+6, nq+6) covariance of (q, r, w); measured (N,
    nq+6) mask; a (N, n_conditions); group (N,) equal for replicates; reading (N, n_channels) of the
    model's sensors (m), NaN if not read. `noise_from` names the source of S for joints and pose,
    and of the readings' noise if it is not stated. `doubts` explains why the joint readings are
    implausible, if the caller insisted on them.
    """

    x: np.ndarray
    S: np.ndarray
    measured: np.ndarray
    a: np.ndarray
    group: np.ndarray
    reading: np.ndarray
    noise_from: dict[str, str]
    doubts: str = ""

    def __len__(self) -> int:
        return len(self.x)

    def __repr__(self) -> str:
        return f"Observations({len(self)} samples, noise from {self.noise_from})"

    @property
    def noise_assumed(self) -> bool:
        """Whether the noise is only assumed: S gives weights, but chi2 and sigma prove nothing."""
        return ASSUMED in self.noise_from.values()

    def select(self, index: np.ndarray) -> Observations:
        names = ("x", "S", "measured", "a", "group", "reading")
        return replace(self, **{name: getattr(self, name)[index] for name in names})


def blocks(dataset: Dataset) -> np.ndarray:
    """Number (N,) of the block that a sample belongs to: visits of one pose, or a stretch of a
    continuous motion."""
    if dataset.mode == "continuous":
        return np.arange(len(dataset)) // max(1, len(dataset) // BLOCKS)
    return np.unique(dataset.pose_id, return_inverse=True)[1]


def observe(
    model: Model, dataset: Dataset, joint_sigma: float | None = None, insist: bool = False
) -> Observations:
    """Make observations for a model: joints in its order, noise from option, recording or file.

    FitError for joint readings that no such robot shows, unless the caller insists.
    """
    missing = [j for j in model.joints if j not in dataset.joint_names]
    if missing:
        raise FitError(
            f"{dataset.source}: joint {', '.join(missing)} is missing; recorded are "
            f"{', '.join(dataset.joint_names)}. Rename the joints in the model file"
        )
    order = [dataset.joint_names.index(j) for j in model.joints]
    reading = _readings(model, dataset)
    n = len(order)
    x = Configuration(dataset.q[:, order], dataset.r, dataset.R).rows
    measured = np.ones((len(x), n + 6), dtype=bool)
    measured[:, n:] = dataset.measured
    # Set unmeasured coordinates to home: they are projected out, but must be finite.
    home = model.mechanism.home.configuration
    for k in range(n, n + 3):
        x[~measured[:, k], k] = home[k]
    R, R0 = Configuration.from_rows(x).R, Configuration.from_rows(home).R
    w = np.where(measured[:, n + 3 :], rotation_vector(R @ R0.T), 0.0)
    turned = ~measured[:, n + 3 :].all(axis=1)
    R[turned] = rotation_matrix(w[turned]) @ R0  # in place: a view of x
    joint, joint_from = _joint_sigma(model, dataset, joint_sigma, order)
    pose, pose_from = _pose_covariance(model, dataset)
    S = np.zeros((len(x), measured.shape[1], measured.shape[1]))
    S[:, range(n), range(n)] = joint**2
    S[:, n:, n:] = pose
    a = conditions(model, dataset)
    noise_from = {"joint": joint_from, "pose": pose_from}
    if set(model.structure.channels_without_sigma) & set(_list_read_channels(dataset)):
        noise_from["reading"] = ASSUMED
    group = np.asarray(dataset.pose_id)
    doubts = doubt_readings(model, x, measured, a, dataset.source)
    if doubts and not insist:
        raise FitError(doubts)
    return Observations(x, S, measured, a, group, reading, noise_from, doubts)


def _joint_sigma(
    model: Model, dataset: Dataset, given: float | None, order: list[int]
) -> tuple[np.ndarray, str]:
    """Joint noise (nq,), and its source: option, dataset, model file, scatter."""
    if given is not None:
        if not 0 < given < np.inf:
            raise FitError(f"joint sigma {given} rad: expected a positive number")
        return np.full(len(order), given), "option"
    if dataset.joint_sigma is not None:
        return np.asarray(dataset.joint_sigma, dtype=float)[order], "dataset"
    if model.noise.joint is not None:
        return np.full(len(order), model.noise.joint), _get_noise_source(model)
    scatter = _pool_scatter(dataset.scatter_q[:, order])
    if not (scatter > 0).all():
        raise FitError(
            f"{dataset.source or 'samples'}: the noise of the joint readings is not "
            f"known; give --joint-sigma "
            f"(rad or m) or noise.joint in the model file {GUESS}"
        )
    return scatter, SCATTER


def _get_noise_source(model: Model) -> str:
    return ASSUMED if model.noise.assumed else "model file"


def _pool_scatter(scatter: np.ndarray) -> np.ndarray:
    """Root mean square of the known values of each column, else NaN."""
    known = np.isfinite(scatter)
    total = np.sum(np.where(known, scatter, 0.0) ** 2, axis=0)
    return np.sqrt(np.where(known.any(axis=0), total / np.maximum(known.sum(axis=0), 1), np.nan))


def _pose_covariance(model: Model, dataset: Dataset) -> tuple[np.ndarray, str]:
    """Covariance (N, 6, 6) and its source: the device, the model file, or the scatter within
    dwells."""
    covariance = np.nan_to_num(np.array(dataset.pose_cov, dtype=float))
    lacking = ~(np.diagonal(covariance, axis1=1, axis2=2) > 0)
    wanted = np.any(lacking & dataset.measured, axis=0)
    # Noise where the device states none; 1 where none is needed.
    noise = model.noise
    given = np.repeat([noise.position or np.nan, noise.orientation or np.nan], 3)
    sigma = np.where(np.isfinite(given), given, _pool_scatter(dataset.scatter_pose))
    if not (sigma[wanted] > 0).all():
        raise FitError(
            f"{dataset.source}: the noise of the device is not known; record a covariance, or give "
            f"noise.position (m) and noise.orientation (rad) in the model file {GUESS}"
        )
    sigma = np.where(sigma > 0, sigma, 1.0)
    for i in np.flatnonzero(lacking.any(axis=1)):
        bad = lacking[i]
        covariance[i][bad, :], covariance[i][:, bad] = 0.0, 0.0
        covariance[i][bad, bad] = sigma[bad] ** 2
    _check_definite(covariance, dataset)
    if not wanted.any():
        return covariance, "dataset"
    return covariance, _get_noise_source(model) if np.isfinite(given[wanted]).any() else SCATTER


def _check_definite(covariance: np.ndarray, dataset: Dataset) -> None:
    """Raise FitError for a matrix that is no covariance."""
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    seen = dataset.measured[:, :, None] & dataset.measured[:, None, :]
    correlation = np.where(seen, covariance / (sigma[:, :, None] * sigma[:, None, :]), np.eye(6))
    skew = np.abs(correlation - correlation.transpose(0, 2, 1)).max(axis=(1, 2))
    least = np.linalg.eigvalsh(correlation)[:, 0]
    for i in np.flatnonzero((skew > 1e-6) | (least < -1e-6)):
        raise FitError(
            f"{dataset.source}: sample {dataset.numbers[i]}: the recorded pose covariance is not "
            "symmetric, or gives a combination of coordinates a negative variance; correct the "
            "device's driver, or set all but the diagonal to zero"
        )


def conditions(model: Model, dataset: Dataset) -> np.ndarray:
    """Recorded conditions (N, n_conditions); FitError if one that the effects need is missing."""
    missing = [c for c in model.conditions if c not in dataset.conditions]
    if missing:
        names = ", ".join(effect.name for effect in model.effects if effect.needs)
        raise FitError(
            f"{dataset.source}: {', '.join(missing)} was not recorded, but the model's effects "
            f"({names}) need it"
        )
    columns: Any = [np.asarray(dataset.conditions[c], dtype=float) for c in model.conditions]
    return np.stack(columns, axis=1) if columns else np.zeros((len(dataset.q), 0))


def _readings(model: Model, dataset: Dataset) -> np.ndarray:
    """(N, n_channels): the dataset's columns `reading.CHANNEL`, NaN if not read."""
    channels, read = model.structure.channels, _list_read_channels(dataset)
    if missing := [c for c in channels if c not in read]:
        raise FitError(
            f"{dataset.source}: no measurement with {', '.join(missing)}, which the model's "
            f"sensors expect (recorded: {', '.join(read) or 'no reading'}); measure it, or "
            "remove the sensor from the model"
        )
    if strange := [c for c in read if c not in channels]:
        raise FitError(
            f"{dataset.source}: readings of {', '.join(strange)}, but the model's sensors have "
            f"{', '.join(channels) or 'no channel'}: describe the set-up in the model file"
        )
    columns = [dataset.conditions[READING + c] for c in channels]
    return np.stack(columns, axis=1) if columns else np.zeros((len(dataset.q), 0))


def _list_read_channels(dataset: Dataset) -> list[str]:
    """Channels with at least one reading."""
    names = [k for k in dataset.conditions if k.startswith(READING)]
    return [k.removeprefix(READING) for k in names if np.isfinite(dataset.conditions[k]).any()]
