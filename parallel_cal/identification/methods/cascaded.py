"""Cascaded calibration: sub-models that are linear in their unknowns, one after another (5.3.7).

The closure's linear factors come by program (`_factors`). Differences of samples hold no
constant factor, where squares of parameters observe: they give the other factors (eq. 5.33; the
print forgets that cos q_N and cos q_j differ), these the constant (eq. 5.34), all the parameters.
"""

from __future__ import annotations

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.identification.estimate import Estimate, EstimationProblem
from parallel_cal.identification.methods.semiparametric import (
    FactorMechanism,
    closure_rows,
    extract_parameters,
    make_factor_model,
)
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.prior import Prior
from parallel_cal.model.model import Model


def estimate(
    model: Model, observations: Observations, free: np.ndarray, prior: bool | Prior | None = False
) -> Estimate:
    """Parameters by two linear steps and eq. 5.35, without weights, as in the thesis.

    Every sample is subtracted from the last, whose noise therefore enters everywhere: sigma,
    which is that of this method, shows the price. FitError where the closure has no constant
    factor, and with a prior.
    """
    if prior:
        raise FitError("cascaded calibration takes no prior; use the implicit method")
    factors = make_factor_model(model)
    _, M = closure_rows(factors, observations)
    constant = _constants(factors)
    inverse = _two_steps(M, constant, len(observations))
    # What both steps saw: differences, then each row's mean, in which the constants stand.
    first = np.linalg.qr(_differences(M, len(observations)), mode="r")
    mean = M[:, constant] / np.linalg.norm(M[:, constant], axis=0)
    weight = np.vstack([first, mean.T @ M])
    return extract_parameters(EstimationProblem(model, free), observations, inverse, weight)


def _constants(factors: Model) -> np.ndarray:
    """Mask of the factors that stand alone in their row."""
    mechanism = factors.mechanism
    assert isinstance(mechanism, FactorMechanism)
    mask = []
    for row in mechanism.rows:
        if row.constant < 0:
            raise FitError(f"{mechanism.origin.mechanism.name}: no constant factor to eliminate")
        mask += [j == row.constant for j in range(len(row))]
    return np.array(mask)


def _differences(A: np.ndarray, n: int) -> np.ndarray:
    """Rows of the last sample minus those of every other one."""
    samples = A.reshape(n, -1, A.shape[1])
    return (samples[-1:] - samples[:-1]).reshape(-1, A.shape[1])


def _two_steps(M: np.ndarray, constant: np.ndarray, n: int) -> np.ndarray:
    """The linear map (n_factors, N * rows) from closure errors to changes of factors, minus."""
    inverse = np.zeros((M.shape[1], len(M)))
    D = _differences(M[:, ~constant], n)
    size = np.linalg.norm(D, axis=0)
    scale = np.where(size > 0, size, 1.0)  # (a factor that the poses do not show)
    first = np.linalg.pinv(D / scale, rcond=1e-12) / scale[:, None]
    inverse[~constant] = first @ _differences(np.eye(len(M)), n)
    left = np.eye(len(M)) - M[:, ~constant] @ inverse[~constant]
    inverse[constant] = np.linalg.pinv(M[:, constant]) @ left
    return inverse
