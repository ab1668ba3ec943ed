"""Tell effects that change slowly from noise that drifts.

A device that walks at random imitates a steady drift and a bump: both make neighbours in time
similar. What differs is how: an effect of time predicts the whole session from a few numbers, a
walk only the next sample from the last one. So the two are compared by their likelihood, each with
the noise that suits it best: white noise and a process of first order with a memory, whose limit
for a long memory is a random walk.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parallel_cal.diagnosis.field import Field
from parallel_cal.diagnosis.thresholds import (
    DRIFT_MEMORIES,
    DRIFT_VARIANCES,
    MAX_DRIFT_SAMPLES,
    MAX_DRIFT_STEPS,
    MIN_DRIFT_GAIN,
)
from parallel_cal.identification.linearisation import Linearisation
from parallel_cal.identification.thresholds import LSTSQ_RANK_TOLERANCE
from parallel_cal.posterior.scene import Scene


def compute_drift_p_value(without: Scene, with_effect: Scene, parameters: int) -> float:
    """Compute how likely noise that drifts makes an effect with some `parameters` explain as much:
    the ratio of the likelihoods, judged as by Wilks (1938)."""
    from scipy.special import chdtrc

    gain = compute_drift_log_likelihood(ErrorSeries.of(with_effect))
    gain -= compute_drift_log_likelihood(ErrorSeries.of(without))
    return float(chdtrc(max(parameters, 1), max(2 * gain, 0.0)))


@dataclass(frozen=True)
class ErrorSeries:
    """Errors (N, k) at times (N,) s, in order, their white noise `sigma` (N, k), and how they
    change with the free parameters of the model: columns (N, k, p). An error that is exactly zero
    was not measured."""

    error: np.ndarray
    sigma: np.ndarray
    columns: np.ndarray
    time: np.ndarray

    @classmethod
    def of(cls, scene: Scene) -> ErrorSeries:
        """The pose errors of a scene, or else those of readings or of the closure; of very many
        samples, averages of neighbours in time."""
        field = Field.of(scene)
        used = np.any(field.error != 0, axis=0)
        error, sigma = field.error[:, used], field.sigma[:, used]
        columns = _differentiate_errors(scene, field)[:, used]
        order = np.argsort(scene.dataset.time, kind="stable")
        parts = np.array_split(order, min(len(order), MAX_DRIFT_SAMPLES))
        weight = np.where(error != 0, sigma**-2.0, 0.0)
        total = np.array([weight[part].sum(axis=0) for part in parts])
        known = np.where(total > 0, total, np.inf)

        def average(values: np.ndarray) -> np.ndarray:
            return np.array([(weight[p] * values[p]).sum(axis=0) for p in parts]) / known

        by_column = [average(columns[:, :, j]) for j in range(columns.shape[2])]
        time = np.array([scene.dataset.time[part].mean() for part in parts])
        sigma = np.where(total > 0, known, 1.0) ** -0.5
        return cls(average(error), sigma, np.stack(by_column, axis=2), time)


def _differentiate_errors(scene: Scene, field: Field) -> np.ndarray:
    """d errors / d free parameters (N, k, p), in their prior sigmas, for the errors of a field."""
    model = scene.model
    n, closure = len(model.joints), model.structure.phi.shape[0]
    linearise = Linearisation(model, scene.observations, scene.free, True)
    _, C, J = linearise.blocks(model.values, scene.x)
    J = J * model.table.prior_sigma[scene.free]
    moved = list(model.mechanism.moved)
    by_pose = C[:, :, [n + i for i in moved]]
    moves = -np.linalg.pinv(by_pose[:, :closure]) @ J[:, :closure]
    if field.measured.any():
        found = np.zeros((len(J), 6, J.shape[2]))
        found[:, moved] = -moves
        return np.where(field.measured[:, :, None], found, 0.0)
    if np.isfinite(scene.reading_residuals).any():
        return np.asarray(-(J[:, closure:] + by_pose[:, closure:] @ moves))
    return np.asarray(scene.whitener @ J)


def compute_drift_log_likelihood(series: ErrorSeries) -> float:
    """Compute the log likelihood of a session's errors, up to a constant, if each component is
    white noise, proportional to its sigma, and a process of first order.

    It is the largest over the free parameters, the memory and variance of the process and the scale
    of both: given the noise, the parameters are those of weighted least squares, and so in turns.
    Without this a walk would distort the geometry, and count against itself.
    """
    white = (series.sigma / np.median(series.sigma, axis=0)) ** 2
    rows = np.concatenate([series.error[:, :, None], series.columns], axis=2)
    error, likely = series.error, -np.inf
    for _ in range(MAX_DRIFT_STEPS):
        kept, variance, scale, now = _fit_noise(error, series.error != 0, white, series.time)
        if now < likely + MIN_DRIFT_GAIN:
            break
        likely = now
        # Rows whose noise is white in each component; zero where not measured.
        seen = (series.error != 0)[:, :, None]
        innovations, total = _predict(
            rows, seen, white[:, :, None], kept[:, :, None], variance[:, None]
        )
        filtered = seen * innovations / np.sqrt(total) / scale[:, None]
        filtered = filtered.reshape(-1, rows.shape[2])
        step = np.linalg.lstsq(filtered[:, 1:], filtered[:, 0], rcond=LSTSQ_RANK_TOLERANCE)[0]
        error = np.where(series.error != 0, series.error - series.columns @ step, 0.0)
    return likely


def _fit_noise(
    error: np.ndarray, seen: np.ndarray, white: np.ndarray, time: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Fit the noise of errors (N, k), measured where `seen`, with white noise of the relative
    variance `white` (N, k): the share (N - 1, k) of the process that is kept from sample to sample,
    its variance (k,), the scale (k,) of both, and the log likelihood."""
    steps = np.diff(time)
    usual = float(np.median(steps[steps > 0])) if np.any(steps > 0) else 1.0
    kept = np.exp(-steps[:, None] / (usual * np.array(DRIFT_MEMORIES)))
    variance = np.array((0.0, *DRIFT_VARIANCES))
    n_components, n_memories = error.shape[1], len(DRIFT_MEMORIES)
    innovations, total = _predict(
        np.broadcast_to(error[:, :, None, None], (*error.shape, n_memories, len(variance))),
        seen[:, :, None, None],
        white[:, :, None, None],
        kept[:, None, :, None],
        variance,
    )
    squares = np.sum(seen[:, :, None, None] * innovations**2 / total, axis=0)
    count = seen.sum(axis=0)[:, None, None]
    spread = np.sum(seen[:, :, None, None] * np.log(total), axis=0)
    likely = -count / 2 * np.log(np.maximum(squares / count, 1e-300)) - spread / 2
    best = [np.unravel_index(np.argmax(one), one.shape) for one in likely]
    memory, size = np.array(best).T
    each = np.arange(n_components)
    scale = np.sqrt(np.maximum(squares[each, memory, size] / count[:, 0, 0], 1e-300))
    return kept[:, memory], variance[size], scale, float(likely[each, memory, size].sum())


def _predict(
    rows: np.ndarray, seen: np.ndarray, white: np.ndarray, kept: np.ndarray, variance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the prediction of each row from those before it, and their variance, by a Kalman
    filter of a process of first order (Harvey 1989, section 3.4)."""
    innovations, totals = np.empty_like(rows), np.empty_like(rows)
    state, spread = np.zeros(rows.shape[1:]), np.broadcast_to(variance, rows.shape[1:])
    for k, row in enumerate(rows):
        if k:
            state, spread = kept[k - 1] * state, kept[k - 1] ** 2 * (spread - variance) + variance
        totals[k] = spread + white[k]
        innovations[k] = row - state
        gain = seen[k] * spread / totals[k]
        state, spread = state + gain * innovations[k], (1 - gain) * spread
    return innovations, totals
