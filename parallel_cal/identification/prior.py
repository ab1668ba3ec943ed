"""What is known of the parameters before the data speak."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.identification.thresholds import UNSEEN
from parallel_cal.model.model import Model
from parallel_cal.model.parameters import ParameterTable


@dataclass(frozen=True)
class Prior:
    """Parameters known as mean (n,) with covariance (n, n), in SI units, before the fit."""

    mean: np.ndarray
    covariance: np.ndarray

    @staticmethod
    def tolerances(table: ParameterTable) -> Prior:
        """Every parameter at its nominal value, to within its tolerance."""
        return Prior(table.nominal, np.diag(table.tolerance**2))

    @staticmethod
    def result_of(model: Model) -> Prior:
        """What an earlier identification left in the model: its values and covariance.

        What that one did not identify, parameters and combinations alike, is known to within
        tolerance. FitError for a model without covariance.
        """
        if model.covariance is None:
            raise FitError("the model has no covariance to start from: identify it first")
        scale = np.outer(model.table.tolerance, model.table.tolerance)
        size, directions = np.linalg.eigh(model.covariance / scale)
        unseen = directions[:, size < UNSEEN * size[-1]]
        return Prior(model.values, model.covariance + (unseen @ unseen.T) * scale)


class Knowledge:
    """A prior as the free parameters feel it, in tolerances: d^T information d with d the
    distance from `mean`; no information at all without a prior."""

    def __init__(self, prior: bool | Prior, table: ParameterTable, free: np.ndarray):
        known = Prior.tolerances(table) if isinstance(prior, bool) else prior
        self._tolerance, self._free = table.tolerance[free], free
        self._mean = np.asarray(known.mean)[free]
        covariance = known.covariance[np.ix_(free, free)]
        scaled = covariance / np.outer(self._tolerance, self._tolerance)
        self.information = _inverse(scaled) if prior else np.zeros_like(scaled)

    def gradient(self, values: np.ndarray) -> np.ndarray:
        """Half the derivative of `cost` by the free parameters, in tolerances."""
        return np.asarray(self.information @ self._distance(values))

    def cost(self, values: np.ndarray) -> float:
        """What the parameters (n,) add to chi2."""
        return float(self._distance(values) @ self.gradient(values))

    def _distance(self, values: np.ndarray) -> np.ndarray:
        return np.asarray((values[self._free] - self._mean) / self._tolerance)


def _inverse(covariance: np.ndarray) -> np.ndarray:
    try:
        factor = np.linalg.inv(np.linalg.cholesky(covariance))
    except np.linalg.LinAlgError:
        raise FitError(
            "the prior's covariance is singular: fix the parameters that it knows exactly"
        ) from None
    return np.asarray(factor.T @ factor)
