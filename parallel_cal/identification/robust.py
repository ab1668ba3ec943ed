"""Robust losses for methods in noise units: iterative reweighting of whole samples."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.identification.estimate import Estimate
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.thresholds import UNSEEN_CHANGE
from parallel_cal.model.model import Model

# Weights of scipy's losses for a sample whose rms residual is t sigmas; the constants keep 95 %
# of the efficiency where the noise is normal.
LOSSES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "huber": lambda t: np.minimum(1.0, 1.345 / np.maximum(t, 1e-12)),
    "soft_l1": lambda t: 1 / np.sqrt(1 + (t / 1.287) ** 2),
    "cauchy": lambda t: 1 / (1 + (t / 2.385) ** 2),
    "arctan": lambda t: 1 / (1 + (t / 2.571) ** 4),
}

ITERATIONS = 30


def estimate_robustly(
    estimator: Callable[..., Estimate],
    model: Model,
    observations: Observations,
    free: np.ndarray,
    loss: str,
) -> Estimate:
    """Estimate with a loss that is robust to outliers: a sample of weight w has the noise S / w.

    Dividing a sample's covariance by its weight multiplies its whitened residual by sqrt(w), so
    the method itself does not change. chi2 is that of the weighted residuals. sigma is that of the
    last weights, without a correction for the loss. If the noise is only assumed, the residuals
    themselves determine which of them are large. FitError for an unknown loss.
    """
    if loss not in LOSSES:
        raise FitError(f"no loss '{loss}'; there are linear, {', '.join(LOSSES)}")
    weight = np.ones(len(observations))
    for _ in range(ITERATIONS):
        found = estimator(model, reweight(observations, weight), free)
        if len(found.residuals) != len(weight):
            raise FitError(
                f"loss '{loss}' needs every sample, but this method leaves out those near "
                "singularities; use the implicit method"
            )
        squares = np.sum(found.residuals**2, axis=1) / weight
        # rms over the rows that do not depend on unmeasured coordinates
        sizes = np.sqrt(squares / np.maximum(found.informative, 1))
        unit = 1.0
        if observations.noise_assumed:
            # Estimate sigma from the median: with k rows, the median of chi2 / k is about
            # (1 - 2 / 9k)^3 (Wilson-Hilferty).
            k = found.informative[found.informative > 0]
            usual = sizes[found.informative > 0] / (1 - 2 / (9 * k)) ** 1.5
            unit = max(float(np.median(usual)), 1e-300)
        before, weight = weight, LOSSES[loss](sizes / unit)
        model = model.with_values(found.values)
        if np.abs(weight - before).max() < UNSEEN_CHANGE:
            break
    return replace(found, weight=before, system=None)


def reweight(observations: Observations, weight: np.ndarray | None) -> Observations:
    """Divide the covariance of each sample, with that of its readings, by its weight (N,)."""
    if weight is None:
        return observations
    sigma = observations.reading_sigma
    return replace(
        observations,
        S=observations.S / weight[:, None, None],
        reading_sigma=None if sigma is None else sigma / np.sqrt(weight)[:, None],
    )
