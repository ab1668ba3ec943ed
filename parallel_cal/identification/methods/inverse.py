"""Inverse calibration: measured joints minus solutions of the inverse problem (5.3.5)."""

from __future__ import annotations

import numpy as np

from parallel_cal.identification.estimate import Estimate
from parallel_cal.identification.explicit import Prediction
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.prior import Prior
from parallel_cal.model.model import Model


def estimate(
    model: Model, observations: Observations, free: np.ndarray, prior: bool | Prior | None = False
) -> Estimate:
    """Parameters that minimise the joint errors of eq. 5.25, in units of their noise.

    Weights: covariance of the joint readings plus that of the controlled coordinates carried
    through the inverse problem. Passive coordinates (a Delta's orientation) follow from the
    same problem; if they were measured, their errors count too. FitError if a controlled
    coordinate was not measured, or without convergence.
    """
    return Prediction(model, observations, free, direct=False).minimise_residuals(prior)
