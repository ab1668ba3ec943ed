"""Nulls: residuals of sessions with the noise as it was found, and without any law."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parallel_cal.base.confidence import SIGNIFICANCE_LEVEL
from parallel_cal.diagnosis.noise_shape import NoiseShape, noise_shape
from parallel_cal.diagnosis.thresholds import CREDIBLE, OUTLIER_SIGNIFICANCE_LEVEL
from parallel_cal.posterior.scene import Scene

MEMORIES = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)  # of noise, in steps between samples
TRIALS = 12  # sessions drawn to compare the memory of noise


@dataclass(frozen=True)
class Noise:
    """How noise departs from white noise: `memory` (s) in which its correlation falls to 1/e, 0 if
    it has none; `growth` (N,), its size at each sample; `outliers`, sizes of the few samples that
    exceed the others."""

    memory: float
    growth: np.ndarray
    outliers: np.ndarray


def characterise_noise(scene: Scene, residual: np.ndarray) -> Noise:
    """Find the shape of noise in a residual (n,), which no law explains."""
    from scipy.special import chdtrc

    places = scene.places
    shape = noise_shape(_by_sensor(scene, residual), scene.dataset.time, places)
    growth = np.ones(len(places))
    if shape.growth_p < 1 - CREDIBLE and shape.growth > 1:
        # Linear in the distance from the centre, of mean square one.
        away = np.linalg.norm(places - places.mean(axis=0), axis=1)
        size = np.sqrt(np.mean(scene.by_sample(residual) ** 2, axis=1))
        slope, base = np.polyfit(away, size, 1)
        fitted = np.maximum(base + slope * away, 0.2 * size.mean())
        growth = np.asarray(fitted / np.sqrt(np.mean(fitted**2)))
    squares = np.sum(scene.by_sample(residual) ** 2, axis=1) / growth**2
    k = np.maximum(scene.informative, 1)
    scale = np.median(squares / np.maximum(k - 2 / 3, 0.3))
    p = chdtrc(k, squares / max(scale, 1e-300)) * len(squares)
    outliers = np.sqrt(squares / (k * max(scale, 1e-300)))[p < OUTLIER_SIGNIFICANCE_LEVEL]
    known_order = "time" in scene.dataset.conditions
    memory = 0.0
    if known_order and shape.correlation_p < 1 - CREDIBLE:
        memory = _match_memory(scene, shape, growth)
    return Noise(memory, growth, outliers)


def draw_residuals(scene: Scene, noise: Noise, count: int, seed: int = 0) -> np.ndarray:
    """Draw residuals (n, count) of sessions with this noise, before any projection."""
    rng = np.random.default_rng(seed)
    M, sigma, by_channel = _noise_maps(scene)
    N = len(M)
    time = scene.dataset.time
    order = np.argsort(time, kind="stable")
    # Correlation of each sample, in the order of time, with the one before.
    apart = np.diff(np.sort(time), prepend=np.min(time))
    steps = np.exp(-apart / noise.memory) if noise.memory > 0 else np.zeros(N)
    out = np.empty((N, scene.rows, count))
    for c in range(count):
        e = rng.standard_normal((N, M.shape[2] + by_channel.shape[2]))
        for k in range(1, N if noise.memory > 0 else 1):
            e[k] = steps[k] * e[k - 1] + np.sqrt(1 - steps[k] ** 2) * e[k]
        own = np.empty_like(e)
        own[order] = e
        size = noise.growth.copy()
        if len(noise.outliers):
            size[rng.choice(N, len(noise.outliers), replace=False)] *= noise.outliers
        own *= size[:, None]
        q = M.shape[2]
        errors = (sigma @ own[:, :q, None])[:, :, 0]
        out[:, :, c] = np.einsum("nrk,nk->nr", M, errors)
        out[:, :, c] += np.einsum("nrk,nk->nr", by_channel, own[:, q:])
    return out.reshape(N * scene.rows, count)


def compute_threshold(maxima: np.ndarray) -> float:
    """The evidence that the best hypothesis of a session without a law exceeds in one of a hundred
    sessions: the quantile of the Gumbel distribution with the mean and deviation of the maxima, but
    no less than theirs."""
    deviation = float(np.std(maxima)) * 6**0.5 / np.pi
    mode = float(np.mean(maxima)) - np.euler_gamma * deviation
    fitted = mode - deviation * float(np.log(-np.log1p(-SIGNIFICANCE_LEVEL)))
    return max(fitted, float(np.quantile(maxima, 1 - SIGNIFICANCE_LEVEL)))


def _noise_maps(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """d residual/d(q, r, w) (N, rows, nq + 6), a root of their covariance, and d residual/d(noise
    of each channel, in sigmas) (N, rows, n_channels)."""
    seen = scene.observations
    both = seen.measured[:, :, None] & seen.measured[:, None, :]
    S = np.where(both, seen.S, 0.0)
    squares, turn = np.linalg.eigh(S)
    root = turn * np.sqrt(np.maximum(squares, 0.0))[:, None, :]
    closure = scene.model.structure.phi.shape[0]
    by_channel = -scene.whitener[:, :, closure:] * scene.model.structure.standard_uncertainty
    return scene.measured_jacobian, root, by_channel


def _by_sensor(scene: Scene, residual: np.ndarray) -> np.ndarray:
    """The errors of the sensors (N, nq + 6 + n_channels), in sigmas, that are likeliest to have
    left a residual: what is correlated there is hardly so in rows of the closure."""
    M, _, by_channel = _noise_maps(scene)
    rows = scene.by_sample(residual)
    variance = np.diagonal(scene.observations.S, axis1=1, axis2=2)
    sigma = np.sqrt(np.where(scene.observations.measured, variance, 0.0))
    sensed = np.einsum("nrk,nr->nk", M, rows) * sigma
    return np.hstack([sensed, np.einsum("nrk,nr->nk", by_channel, rows)])


def _match_memory(scene: Scene, shape: NoiseShape, growth: np.ndarray) -> float:
    """The shortest memory whose drawn sessions are as correlated as the residual; the geometry
    takes part of the correlation away, from these as from the data."""
    step = float(np.median(np.diff(np.sort(scene.dataset.time))))
    if step <= 0:
        return 0.0
    for times in MEMORIES:
        noise = Noise(times * step, growth, np.zeros(0))
        drawn = scene.project_off_geometry(draw_residuals(scene, noise, TRIALS, seed=1))
        found = np.mean([_correlation(_by_sensor(scene, r), scene.dataset.time) for r in drawn.T])
        if found >= shape.correlation:
            return times * step
    return MEMORIES[-1] * step


def _correlation(z: np.ndarray, time: np.ndarray) -> float:
    """Correlation of neighbours in time, as in `noise_shape`."""
    series = z[np.argsort(time, kind="stable")]
    return float(np.sum(series[1:] * series[:-1]) / max(float(np.sum(series**2)), 1e-300))
