"""Sensitivity-matrix calibration with base parameters (Savoure et al. 2006, eqs 17-26).

dX = S dk with S = J_X^-1 J_k from the closure at the nominal parameters. A QR decomposition removes
the columns of S that depend on earlier ones: the others are the base.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.identification.estimate import Estimate, EstimationProblem, make_estimate
from parallel_cal.identification.explicit import Prediction
from parallel_cal.identification.observability import find_independent_columns
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.prior import Prior
from parallel_cal.identification.thresholds import RELATIVE_RANK
from parallel_cal.model.model import Model


def find_base_parameters(columns: np.ndarray) -> np.ndarray:
    """Mask of the independent columns of S, in tolerances; earlier columns take precedence."""
    return find_independent_columns(columns, RELATIVE_RANK * np.linalg.norm(columns, axis=0).max())


def estimate(
    model: Model,
    observations: Observations,
    free: np.ndarray,
    prior: bool | Prior | None = False,
    iterations: int = 1,
) -> Estimate:
    """Estimate the base parameters by linear least squares (eq. 26); the others do not change.

    Weights: pose noise plus joint noise carried through the direct problem. The equation of the
    paper has no weights, because its metres and radians are of similar size. One iteration is the
    method of the paper, more are a forward calibration. sigma is infinite if only a combination is
    known. FitError with a prior.
    """
    if prior:
        raise FitError("sensitivity calibration takes no prior; use the implicit method")
    prediction = Prediction(model, observations, free, direct=True)
    values, where = np.array(model.values), np.flatnonzero(free)
    tolerance = model.table.tolerance[free]
    for _ in range(iterations):
        system = prediction(values)
        assert system is not None
        columns = system.columns * tolerance
        kept = find_base_parameters(columns)
        step = np.linalg.lstsq(columns[:, kept], -system.residual.ravel(), rcond=None)[0]
        values[where[kept]] += tolerance[kept] * step
    end = prediction(values)
    assert end is not None
    sought = EstimationProblem(model, free)
    found = make_estimate(sought, values, end, iterations, sought.compute_spectrum(end, held=False))
    covariance = np.zeros_like(found.covariance)
    inverse = np.linalg.pinv(columns[:, kept].T @ columns[:, kept])
    base = where[kept]
    covariance[np.ix_(base, base)] = inverse * np.outer(tolerance[kept], tolerance[kept])
    return replace(found, covariance=covariance)
