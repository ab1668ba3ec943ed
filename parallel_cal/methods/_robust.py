"""Robust losses for any weighted method: iterative reweighting of whole samples."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from parallel_cal.errors import FitError
from parallel_cal.evidence import Evidence
from parallel_cal.methods.implicit import Estimate
from parallel_cal.model import Model

# The usual constants of scalar residuals; t is a sample's rms residual in noise units.
LOSSES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "huber": lambda t: np.minimum(1.0, 1.345 / np.maximum(t, 1e-12)),
    "cauchy": lambda t: 1 / (1 + (t / 2.385) ** 2),
}


def robust(
    estimator: Callable[..., Estimate],
    model: Model,
    evidence: Evidence,
    free: np.ndarray,
    loss: str = "huber",
    prior: bool = False,
    iterations: int = 30,
) -> Estimate:
    """An estimate that few bad samples cannot pull: noise S / w where a sample's weight is w.

    Dividing a sample's covariance by its weight multiplies its whitened residual by sqrt(w), so
    the method itself is untouched. chi2 is of the weighted residuals, sigma that of the last
    weights, without a correction for the loss. FitError for an unknown loss.
    """
    if loss not in LOSSES:
        raise FitError(f"no loss '{loss}'; there are {', '.join(LOSSES)}")
    weight = np.ones(len(evidence))
    for _ in range(iterations):
        found = estimator(
            model, replace(evidence, S=evidence.S / weight[:, None, None]), free, prior=prior
        )
        if len(found.residuals) != len(weight):
            raise FitError("robust losses need a method that keeps every sample: implicit")
        size = np.sqrt(np.mean(found.residuals**2, axis=1) / weight)
        before, weight = weight, LOSSES[loss](size)
        model = model.with_values(found.values) if not prior else model
        if np.abs(weight - before).max() < 1e-6:
            break
    return found
