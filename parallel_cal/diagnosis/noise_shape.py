"""Test whether noise is white: uncorrelated in time, and equal over the workspace."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from parallel_cal.base.confidence import SIGNIFICANCE_LEVEL
from parallel_cal.diagnosis.field import Field
from parallel_cal.diagnosis.statistics import permutation_p_values
from parallel_cal.diagnosis.thresholds import (
    MIN_INFLATION,
    PERMUTATIONS,
)
from parallel_cal.posterior.scene import Scene

EQUAL_DISTANCE = 1e-9  # relative: below it, distances differ by rounding


@dataclass(frozen=True)
class NoiseShape:
    """How residuals depart from white noise.

    `correlation` of neighbours in time and the time `memory` (s) in which it falls to 1/e;
    `growth`: rms in the outer third of the workspace over that in the inner third; each with the
    p-value of as much by chance, from permutations of the samples. `inflation` is the variance of
    a slow mean over that of white noise, at least 1.
    """

    correlation: float
    correlation_p: float
    memory: float
    growth: float
    growth_p: float
    inflation: float = 1.0

    @property
    def correlated(self) -> bool:
        """Whether neighbours in time are similar, by enough to matter."""
        certain = self.correlation_p < SIGNIFICANCE_LEVEL
        return certain and self.inflation > MIN_INFLATION

    @property
    def grows_from_centre(self) -> bool:
        return self.growth_p < SIGNIFICANCE_LEVEL

    @property
    def remarks(self) -> list[str]:
        """Remarks about noise that is not white; empty if it is."""
        words = []
        if self.correlated:
            words.append(f"the noise is correlated over {self.memory:.2g} s")
        if self.grows_from_centre:
            words.append(f"the noise is {self.growth:.1f} times larger far from the centre")
        return words

    @classmethod
    def of(cls, scene: Scene, field: Field) -> NoiseShape:
        """Test what a model leaves of a session. Consecutive samples of a moving robot are similar
        anyway."""
        if scene.dataset.mode == "continuous":
            return cls(0.0, 1.0, 0.0, 1.0, 1.0)
        shape = noise_shape(field.noise_units, scene.dataset.time, scene.places)
        known = "time" in scene.dataset.conditions  # the order of samples is none
        return (
            shape
            if known
            else replace(shape, correlation=0.0, correlation_p=1.0, memory=0.0, inflation=1.0)
        )


def noise_shape(z: np.ndarray, time: np.ndarray, places: np.ndarray, seed: int = 0) -> NoiseShape:
    """The shape of residuals z (N, k) in noise units, taken at times (N,) s and places (N, 3), m or
    rad. Places that are all equally far from their centre show no growth."""
    z = z[:, np.any(z != 0, axis=0)]
    if len(z) < 9 or not z.any():
        return NoiseShape(0.0, 1.0, 0.0, 1.0, 1.0)
    rng = np.random.default_rng(seed)
    order = np.argsort(time, kind="stable")
    size = np.mean(z**2, axis=1)
    away = np.linalg.norm(places - places.mean(axis=0), axis=1)
    inner, outer = (
        np.argsort(away)[part] for part in (slice(len(z) // 3), slice(-len(z) // 3, None))
    )

    total, width = float(np.sum(z**2)), z.shape[1]

    def correlation(rows: np.ndarray) -> float:
        series = rows.ravel()  # a sample and the next lie one width apart
        return float(series[width:] @ series[:-width] / total)

    def growth(sizes: np.ndarray) -> float:
        ratio = (sizes[outer].sum() / len(outer)) / max(sizes[inner].sum() / len(inner), 1e-300)
        return float(ratio**0.5)

    seen = correlation(z[order]), growth(size)
    orders = (rng.permutation(len(z)) for _ in range(PERMUTATIONS))
    p = permutation_p_values(seen, ((correlation(z[k]), growth(size[k])) for k in orders))
    step = float(np.median(np.diff(time[order])))
    if np.ptp(away) <= EQUAL_DISTANCE * away.max():
        seen, p = (seen[0], 1.0), np.array([p[0], 1.0])
    memory = -step / np.log(np.clip(seen[0], 1e-3, 1 - 1e-3))
    # Variance of a slow mean over that of white noise: 1 + 2 sum (1 - l / L) rho_l over the lags
    # l < L (Newey and West 1987), at least that of the first lag alone.
    series = z[order]
    lags = np.arange(1, max(len(series) // 4, 2))
    squares = float(np.sum(series**2))
    rho = np.array([float(np.sum(series[lag:] * series[:-lag])) / squares for lag in lags])
    first = float(np.clip(rho[0], 0.0, 0.99))
    long_run = 1 + 2 * float(np.sum((1 - lags / (lags[-1] + 1)) * rho))
    inflation = max(1.0, (1 + first) / (1 - first), long_run)
    return NoiseShape(seen[0], float(p[0]), float(memory), seen[1], float(p[1]), inflation)
