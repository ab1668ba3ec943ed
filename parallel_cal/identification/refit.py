"""Partial re-calibration: a few parameters from a few poses, the others kept as they are.

After re-homing or warming up, most of a robot is what it was. Schmidt's consider parameters:
the others keep value and covariance, and their uncertainty becomes part of the result.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.identification.linearisation import Linearisation
from parallel_cal.identification.methods._estimate import Estimate
from parallel_cal.identification.methods._robust import reweight
from parallel_cal.identification.observations import Observations
from parallel_cal.model.model import Model


def add_consider_covariance(
    model: Model, observations: Observations, free: np.ndarray, found: Estimate
) -> Estimate:
    """The estimate with the model's own covariance of the parameters that were kept.

    dp = G do with G = -P_pp J_p^T J_o: an error do of the others moves the refitted ones, so
    their covariance is P_pp + G P_oo G^T, and G P_oo that between them. A full update would
    move the others, too, by next to nothing when the new poses are few, and would let them
    take a share of a change that is not theirs. FitError for a model without covariance.
    """
    if model.covariance is None:
        raise FitError(
            "a partial re-calibration keeps the other parameters with their covariance, but the "
            "model has none: identify all parameters first, or fix the others instead"
        )
    before = np.asarray(model.covariance)
    others = ~free & (np.diag(before) > 0)
    J = _jacobian(model, reweight(observations, found.weight), free | others, found.values)
    P_pp, P_oo = found.covariance[np.ix_(free, free)], before[np.ix_(others, others)]
    in_p = free[free | others]
    G = -found.spectrum.covariance @ J[:, in_p].T @ J[:, ~in_p]
    covariance = np.zeros_like(before)
    covariance[np.ix_(others, others)] = P_oo
    covariance[np.ix_(free, others)] = G @ P_oo
    covariance[np.ix_(others, free)] = (G @ P_oo).T
    covariance[np.ix_(free, free)] = P_pp + G @ P_oo @ G.T
    return replace(found, covariance=covariance)


def _jacobian(
    model: Model, observations: Observations, free: np.ndarray, values: np.ndarray
) -> np.ndarray:
    linearise = Linearisation(model, observations, free, weighted=True)
    system = linearise(values, linearise.start())
    return linearise(values, system.adjusted(np.zeros(int(free.sum())))).columns
