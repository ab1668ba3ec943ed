"""Partial re-calibration: identify a few parameters from a few poses and hold the others.

After re-homing or warming up, most of a robot is unchanged. The others are Schmidt's consider
parameters: they keep value and covariance, and their uncertainty enters the result.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.identification.estimate import Estimate
from parallel_cal.identification.linearisation import Linearisation
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.robust import reweight
from parallel_cal.model.model import Model


def add_consider_covariance(
    model: Model, observations: Observations, free: np.ndarray, found: Estimate
) -> Estimate:
    """Add the model's covariance of the held parameters to the estimate.

    An error do of the held parameters moves the refitted ones by dp = G do, G = -P_pp J_p^T J_o.
    The covariance of the refitted parameters is therefore P_pp + G P_oo G^T, and their covariance
    with the held ones is G P_oo. A full update would also move the held parameters, and would
    ascribe to them a part of a change that they did not cause. FitError for a model without
    covariance.
    """
    if model.covariance is None:
        raise FitError(
            "a partial re-calibration keeps the other parameters with their covariance, but the "
            "model has none: identify all parameters first, or fix the others instead"
        )
    before = np.asarray(model.covariance)
    others = ~free & (np.diag(before) > 0)
    used = free | others
    linearise = Linearisation(model, reweight(observations, found.weight), used, weighted=True)
    system = linearise(found.values, linearise.start())
    # Linearise again at the adjusted coordinates.
    J = linearise(found.values, system.adjusted(np.zeros(int(used.sum())))).columns
    P_pp, P_oo = found.covariance[np.ix_(free, free)], before[np.ix_(others, others)]
    in_p = free[used]
    G = -found.spectrum.covariance @ J[:, in_p].T @ J[:, ~in_p]
    covariance = np.zeros_like(before)
    covariance[np.ix_(others, others)] = P_oo
    covariance[np.ix_(free, others)] = G @ P_oo
    covariance[np.ix_(others, free)] = (G @ P_oo).T
    covariance[np.ix_(free, free)] = P_pp + G @ P_oo @ G.T
    return replace(found, covariance=covariance)
