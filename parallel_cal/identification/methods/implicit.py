"""Weighted implicit calibration: least squares on the closure (5.3.3), in noise units.

Minimising phi^T W^-1 phi, with W the noise that the closure inherits at the adjusted (not the
measured) quantities, is the Gauss-Helmert model: orthogonal distance regression.
"""

from __future__ import annotations

import numpy as np

from parallel_cal.identification.linearisation import Linearisation, System
from parallel_cal.identification.methods._descent import minimise
from parallel_cal.identification.methods._estimate import Estimate, Sought
from parallel_cal.identification.observability import spectrum
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.prior import Prior
from parallel_cal.identification.thresholds import HARDLY
from parallel_cal.model.model import Model
from parallel_cal.model.words import direction_in_words

__all__ = ["Estimate", "estimate"]

ITERATIONS = 200


def estimate(
    model: Model,
    observations: Observations,
    free: np.ndarray,
    prior: bool | Prior = False,
    weighted: bool = True,
) -> Estimate:
    """Parameters by Levenberg-Marquardt (C.4) on whitened closure residuals.

    `free` (n_parameters,) mask; `prior=True` adds every tolerance as a measurement of the
    nominal value, a Prior its mean and covariance; `weighted=False` is the thesis' merit
    function (eq. 5.6): chains decouple, but sigma and chi2 lose their meaning. FitError when
    it does not converge.
    """
    linearise = Linearisation(model, observations, free, weighted)

    def reach(values: np.ndarray, before: System | None, step: np.ndarray) -> System:
        # The adjusted quantities follow from the step by the linearised closure.
        return linearise(values, before.adjusted(step) if before else linearise.start())

    def advice(system: System) -> str:
        # What keeps it walking: what the data hardly see, else a start far off.
        seen = spectrum(system.columns, model.table, free, prior)
        weakest = (*seen.weak, *seen.unidentifiable)[-1:]
        if prior or not weakest or seen.singular_values[-1] > HARDLY:
            return "is the starting model of the right robot, are units right?"
        return (
            f"the data hardly tell {direction_in_words(weakest[0], model.table)}; use priors, "
            "fix some of these, or measure more different poses"
        )

    return minimise(Sought(model, free, prior), reach, advice, ITERATIONS)
