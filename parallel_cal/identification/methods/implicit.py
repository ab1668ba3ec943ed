"""Weighted implicit calibration: least squares on the closure (5.3.3), in noise units.

Minimising phi^T W^-1 phi, with W the noise that the closure inherits at the adjusted (not the
measured) quantities, is the Gauss-Helmert model: orthogonal distance regression.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.identification.linearisation import Linearisation, System
from parallel_cal.identification.methods._estimate import Estimate, NormalEquations, concluded
from parallel_cal.identification.observability import Spectrum, spectrum
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.prior import Knowledge, Prior
from parallel_cal.model.model import Model
from parallel_cal.model.words import direction_in_words

__all__ = ["Estimate", "Linearisation", "estimate"]

HARDLY = 0.1  # sigmas that a tolerance moves the residuals by: ten tolerances fit as well


@dataclass(frozen=True)
class _Point:
    """Parameters, the closure linearised there, the way on, and chi2 with what a prior adds."""

    values: np.ndarray
    system: System
    normal: NormalEquations
    cost: float


def estimate(
    model: Model,
    observations: Observations,
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
    linearise = Linearisation(model, observations, free, weighted)

    def at(values: np.ndarray, x: np.ndarray) -> _Point:
        system = linearise(values, x)
        normal = NormalEquations(system, values, tolerance, known)
        return _Point(values, system, normal, system.chi2 + known.cost(values))

    def ahead(point: _Point, damping: float) -> tuple[_Point, float]:
        step, promised = point.normal.step(damping)
        values = point.values.copy()
        values[free] += step
        # The adjusted quantities follow from the step by the linearised closure.
        return at(values, point.system.adjusted(step)), promised

    here, damping = at(np.array(model.values), linearise.start()), 1e-6
    for k in range(iterations):
        if k > 0 and here.normal.arrived:
            return concluded(model, here.values, here.system, free, prior, k)
        tried, promised = ahead(here, damping)
        if tried.cost > here.cost:
            # A step along a curved valley ends on its slope; a second one leads to its floor.
            tried, _ = ahead(tried, damping)
        fall = here.cost - tried.cost
        # Short of half the promise, curvature counts: longer steps would only swing.
        damping = max(damping / 5, 1e-12) if fall > promised / 2 else max(damping * 3, 1e-6)
        # Costs compare only between adjusted quantities, which those measured are not yet.
        stay = np.zeros(len(tolerance))
        closer = fall >= -1e-9 * here.cost
        here = tried if closer else at(here.values, here.system.adjusted(stay))
        if damping > 1e12:
            break
    raise FitError(
        f"identification did not converge in {iterations} iterations "
        f"(chi2 {here.system.chi2:.3g} of {len(observations)} samples): "
        f"{_why(model, spectrum(here.system.columns, model.table, free, prior), prior)}"
    )


def _why(model: Model, seen: Spectrum, prior: bool | Prior) -> str:
    """What keeps a method walking: what the data hardly see, else a start far off."""
    weakest = (*seen.weak, *seen.unidentifiable)[-1:]
    if prior or not weakest or seen.singular_values[-1] > HARDLY:
        return "is the starting model of the right robot, are units right?"
    return (
        f"the data hardly tell {direction_in_words(weakest[0], model.mechanism)}; use priors, "
        "fix some of these, or measure more different poses"
    )
