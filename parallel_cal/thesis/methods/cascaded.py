"""Cascaded calibration: sub-models that are linear in their unknowns, one after another (5.3.7).

`_factors` finds the linear factors of the closure. Differences of samples do not contain the
constant factors, which contain squares of parameters. They determine the other factors (eq. 5.33;
the printed equation neglects that cos q_N and cos q_j differ). These determine the constant factors
(eq. 5.34), and all factors determine the parameters.
"""

from __future__ import annotations

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.identification.estimate import Estimate, EstimationProblem
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.prior import Prior
from parallel_cal.model.model import Model
from parallel_cal.thesis.methods.semiparametric import (
    FactorMechanism,
    closure_rows,
    extract_parameters,
    make_factor_model,
)


def estimate(
    model: Model, observations: Observations, free: np.ndarray, prior: bool | Prior | None = False
) -> Estimate:
    """Estimate the parameters by two linear steps and eq. 5.35, without weights, as in the thesis.

    Every sample is subtracted from the last one, whose noise therefore enters every row; the sigma
    of this method contains it. FitError if the closure has no constant factor, and with a prior.
    """
    if prior:
        raise FitError("cascaded calibration takes no prior; use the implicit method")
    factors = make_factor_model(model)
    _, M = closure_rows(factors, observations)
    mechanism = factors.mechanism
    assert isinstance(mechanism, FactorMechanism)
    if any(row.constant < 0 for row in mechanism.rows):
        raise FitError(f"{mechanism.origin.mechanism.name}: no constant factor to eliminate")
    constant = np.array([j == row.constant for row in mechanism.rows for j in range(len(row))])
    # `inverse` (n_factors, N * rows) maps closure errors to minus the changes of the factors.
    inverse = np.zeros((M.shape[1], len(M)))
    D = _differences(M[:, ~constant], len(observations))
    size = np.linalg.norm(D, axis=0)
    scale = np.where(size > 0, size, 1.0)  # 0: the poses do not determine this factor
    from_differences = np.linalg.pinv(D / scale, rcond=1e-12) / scale[:, None]
    inverse[~constant] = from_differences @ _differences(np.eye(len(M)), len(observations))
    left = np.eye(len(M)) - M[:, ~constant] @ inverse[~constant]
    inverse[constant] = np.linalg.pinv(M[:, constant]) @ left
    # The information of both steps: the differences, then the mean of each row, which contains the
    # constant factors.
    first = np.linalg.qr(_differences(M, len(observations)), mode="r")
    mean = M[:, constant] / np.linalg.norm(M[:, constant], axis=0)
    weight = np.vstack([first, mean.T @ M])
    return extract_parameters(EstimationProblem(model, free), observations, inverse, weight)


def _differences(A: np.ndarray, n: int) -> np.ndarray:
    """Rows of the last sample minus those of every other one."""
    samples = A.reshape(n, -1, A.shape[1])
    return (samples[-1:] - samples[:-1]).reshape(-1, A.shape[1])
