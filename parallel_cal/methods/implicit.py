"""Weighted implicit calibration: least squares on the closure (5.3.3), in noise units.

Minimising phi^T W^-1 phi, with W the noise that the closure inherits at the adjusted (not the
measured) quantities, is the Gauss-Helmert model: orthogonal distance regression.
"""

from __future__ import annotations

import numpy as np

from parallel_cal.errors import FitError
from parallel_cal.evidence import Evidence
from parallel_cal.linearisation import Linearisation
from parallel_cal.methods._estimate import GAIN, STEP, Estimate, concluded, damped_step
from parallel_cal.model import Model
from parallel_cal.prior import Knowledge, Prior

__all__ = ["Estimate", "Linearisation", "estimate"]


def estimate(
    model: Model,
    evidence: Evidence,
    free: np.ndarray,
    prior: bool | Prior = False,
    weighted: bool = True,
    iterations: int = 200,
) -> Estimate:
    """Parameters by Levenberg-Marquardt (C.4) on whitened closure residuals.

    `free` (n_parameters,) mask; `prior=True` adds every tolerance as a measurement of the
    nominal value, a Prior its mean and covariance; `weighted=False` is the thesis' merit
    function (eq. 5.6): chains decouple, but sigma and chi2 lose their meaning. FitError when
    it does not converge.
    """
    tolerance, known = model.table.tolerance[free], Knowledge(prior, model.table, free)
    linearise = Linearisation(model, evidence, free, weighted)
    values, x = np.array(model.values), linearise.start()
    system = linearise(values, x)
    damping = 1e-6
    for k in range(iterations):
        step, promised = damped_step(system, values, tolerance, known, damping)
        trial = values.copy()
        trial[free] += step
        if k > 0 and promised < GAIN * system.chi2:  # nothing left to gain by another look
            return concluded(model, trial, system, free, prior, k)
        # The adjusted quantities follow from the step by the linearised closure.
        x_trial = system.adjusted(step)
        tried = linearise(trial, x_trial)
        before, after = system.chi2 + known.cost(values), tried.chi2 + known.cost(trial)
        small = np.max(np.abs(step / tolerance), initial=0.0) < STEP
        if small or after <= before * (1 + 1e-9):
            values, x, system, damping = trial, x_trial, tried, max(damping / 5, 1e-12)
        else:
            damping = max(damping * 3, 1e-6)
        if small:
            return concluded(model, values, system, free, prior, k + 1)
        if damping > 1e12:
            break
    raise FitError(
        f"identification did not converge in {iterations} iterations (chi2 {system.chi2:.3g} of "
        f"{len(evidence)} samples); is the starting model of the right robot, are units right?"
    )
