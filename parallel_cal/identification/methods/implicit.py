"""Weighted implicit calibration: least squares on the closure (5.3.3), in noise units.

Minimising phi^T W^-1 phi, with W the noise that the closure inherits at the adjusted (not the
measured) quantities, is the Gauss-Helmert model: orthogonal distance regression.
"""

from __future__ import annotations

import numpy as np

from parallel_cal.identification.descent import ITERATIONS, minimise
from parallel_cal.identification.estimate import Estimate, EstimationProblem
from parallel_cal.identification.linearisation import Linearisation, System
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.prior import Prior
from parallel_cal.model.model import Model

__all__ = ["Estimate", "estimate"]


def estimate(
    model: Model,
    observations: Observations,
    free: np.ndarray,
    prior: bool | Prior | None = False,
    weighted: bool = True,
    begin: System | None = None,
    once: bool = False,
) -> Estimate:
    """Estimate the parameters by Levenberg-Marquardt (C.4) on whitened closure residuals.

    `free` (n_parameters,) is a mask. `prior=True` adds every tolerance as a measurement of the
    nominal value, a Prior adds its mean and covariance, and None adds the tolerances only along
    directions that the data determine weakly. `weighted=False` is the merit function of the thesis
    (eq. 5.6): chains decouple, but sigma and chi2 lose their meaning. `begin` is the closure
    linearised at the model's parameters, if it is known. With `once`, a single step is made: near
    the solution, it is as good. FitError without convergence.
    """
    linearise = Linearisation(model, observations, free, weighted)

    def reach(values: np.ndarray, before: System | None, step: np.ndarray) -> System:
        if before is None:
            return begin or linearise(values, linearise.start())
        # The adjusted quantities follow from the step by the linearised closure.
        return linearise(values, before.adjusted(step))

    sought = EstimationProblem(model, free, prior, observations.noise_assumed)
    advice = "is the starting model of the right robot?"
    near = begin is not None
    steps = 0 if near else 1
    return minimise(sought, reach, advice, near, steps if once else ITERATIONS)
