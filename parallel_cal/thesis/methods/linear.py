"""Linear calibration: the closure linearised once, at the starting parameters (5.3.6)."""

from __future__ import annotations

import numpy as np

from parallel_cal.identification.descent import make_estimate_at, propagate_covariance
from parallel_cal.identification.estimate import (
    Estimate,
    EstimationProblem,
    NormalEquations,
    make_estimate,
)
from parallel_cal.identification.linearisation import Linearisation
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.prior import Knowledge, Prior
from parallel_cal.model.model import Model


def estimate(
    model: Model,
    observations: Observations,
    free: np.ndarray,
    prior: bool | Prior | None = False,
    weighted: bool = True,
) -> Estimate:
    """One Gauss-Newton step of implicit calibration: J dp = -f (eq. 5.29), by SVD.

    Weights: the noise that the closure inherits at the measured quantities;
    `weighted=False` is the equation of the thesis. chi2 is that of the closure at the estimated
    values, so it contains the error of the linearisation.
    """
    sought = EstimationProblem(model, free, prior, observations.noise_assumed)
    tolerance = sought.tolerance
    linearise = Linearisation(model, observations, free, weighted)
    system = linearise(np.array(model.values), linearise.start())
    known = (
        sought.make_knowledge(system)
        if weighted
        else Knowledge.of(prior or False, model.table, free)
    )
    step, _ = NormalEquations(system, model.values, tolerance, known).step(0.0)
    values = np.array(model.values)
    values[free] += step
    if weighted:
        end = linearise(values, system.adjusted(step))
        return make_estimate(sought, values, end, 1, sought.compute_spectrum(end))
    J = system.columns * tolerance
    influence = -np.linalg.pinv(J) * tolerance[:, None]
    covariance = propagate_covariance(influence, model, values, observations)
    return make_estimate_at(sought, values, observations, covariance, 1)
