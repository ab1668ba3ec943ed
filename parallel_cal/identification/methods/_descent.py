"""Pieces that the methods share: damped descent on whitened residuals, and a common verdict."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.identification.linearisation import Linearisation, System
from parallel_cal.identification.methods._estimate import (
    GAIN,
    STEP,
    Estimate,
    NormalEquations,
    concluded,
)
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.prior import Knowledge, Prior
from parallel_cal.model.model import Model

Linearise = Callable[[np.ndarray], "Predicted | None"]


@dataclass
class Predicted(System):
    """Whitened residuals (N, m) and Jacobian (N, m, n_free) of a method without adjustment,
    with the raw residuals and the Cholesky factors that whiten them."""

    adjusted: Callable[[np.ndarray], np.ndarray] = field(init=False, repr=False)
    raw: np.ndarray = field(kw_only=True)
    whitener: np.ndarray = field(kw_only=True)

    def chi2_of(self, other: Predicted) -> float:
        """Another point's chi2 in this one's weights: what a step from here can lower."""
        return float(np.sum(np.linalg.solve(self.whitener, other.raw[:, :, None]) ** 2))


def minimise(
    model: Model,
    free: np.ndarray,
    prior: bool | Prior,
    linearise: Linearise,
    iterations: int = 50,
) -> Estimate:
    """Levenberg-Marquardt (C.4); `linearise` answers None where the model has no solution."""
    tolerance, known = model.table.tolerance[free], Knowledge(prior, model.table, free)
    values, damping = np.array(model.values), 1e-6
    system = linearise(values)
    if system is None:
        raise FitError("the starting model has no solution at some samples: start nearer")
    for k in range(iterations):
        step, promised = NormalEquations(system, values, tolerance, known).step(damping)
        trial = values.copy()
        trial[free] += step
        tried = linearise(trial)
        small = bool(np.max(np.abs(step / tolerance), initial=0.0) < STEP)
        if tried is not None and _better(known, trial, tried, values, system):
            small = small or promised < GAIN * tried.chi2
            values, system, damping = trial, tried, max(damping / 10, 1e-12)
        else:
            damping = max(damping * 10, 1e-6)
        if small:
            return concluded(model, values, system, free, prior, k + 1)
        if damping > 1e12:
            break
    raise FitError(
        f"identification did not converge in {iterations} iterations (chi2 {system.chi2:.3g}): "
        "leave out samples near singularities, or use the implicit method"
    )


def _better(
    known: Knowledge, trial: np.ndarray, tried: Predicted, values: np.ndarray, system: Predicted
) -> bool:
    new, old = system.chi2_of(tried) + known.cost(trial), system.chi2 + known.cost(values)
    return new <= old * (1 + 1e-9)


def concluded_at(
    model: Model,
    values: np.ndarray,
    observations: Observations,
    free: np.ndarray,
    iterations: int,
    covariance: np.ndarray | None = None,
) -> Estimate:
    """A verdict on values found by other means: chi2 of the closure in inherited noise.

    `covariance` (n_free, n_free), that of the method, replaces that of the weighted optimum.
    """
    linearise = Linearisation(model, observations, free, True)
    system = linearise(values, linearise.start())
    found = concluded(model, values, system, free, False, iterations)
    if covariance is None:
        return found
    whole = np.zeros_like(found.covariance)
    whole[np.ix_(free, free)] = covariance
    return replace(found, covariance=whole)


def spread(
    influence: np.ndarray, model: Model, values: np.ndarray, observations: Observations
) -> np.ndarray:
    """Covariance of estimates that the errors of a closure's rows move by influence
    (n_free, N * rows): influence W influence^T with W = C S C^T, the noise of these rows."""
    none = np.zeros(len(values), dtype=bool)
    _, C, _ = Linearisation(model, observations, none, True).blocks(values, observations.x)
    W = C @ observations.S @ C.transpose(0, 2, 1)
    parts = influence.reshape(len(influence), *W.shape[:2])
    return np.asarray(np.einsum("anr,nrs,bns->ab", parts, W, parts, optimize=True))


def need_measured(
    observations: Observations, columns: np.ndarray, names: list[str], method: str
) -> None:
    """FitError where a coordinate that the method starts from was not measured, or where more
    than poses was (channels of other sensors)."""
    if observations.reading.shape[1]:
        raise FitError(f"{method} calibration knows poses only; use the implicit method")
    missing = [
        n for n, c in zip(names, columns, strict=True) if not observations.measured[:, c].all()
    ]
    if missing:
        raise FitError(
            f"{method} calibration needs {', '.join(missing)} at every sample; where they were "
            "not measured, use the implicit method"
        )
