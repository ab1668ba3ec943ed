"""Priors: knowledge about parameters besides the data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.identification.thresholds import MAX_DIRECTION_CHANGE, RELATIVE_RANK
from parallel_cal.model.model import Model
from parallel_cal.model.parameters import ParameterTable


@dataclass(frozen=True)
class Prior:
    """Parameters known before the fit: their names (n), mean (n,) and covariance (n, n), in SI
    units. A model may have more parameters, such as those of an effect that is tried, or fewer."""

    names: tuple[str, ...]
    mean: np.ndarray
    covariance: np.ndarray

    def document(self) -> str:
        """What a list of options says of it."""
        return f"mean and covariance of {len(self.names)} parameters"

    @staticmethod
    def from_tolerances(table: ParameterTable) -> Prior:
        """Every parameter at its nominal value, to within its tolerance."""
        return Prior(table.names, table.nominal, np.diag(table.tolerance**2))

    @staticmethod
    def of_drawing(table: ParameterTable) -> Prior:
        """The geometry at its nominal values, to within its tolerances; nothing else is known."""
        own = [i for i, p in enumerate(table) if p.group not in ("effect", "sensor")]
        names = tuple(table.names[i] for i in own)
        return Prior(names, table.nominal[own], np.diag(table.tolerance[own] ** 2))

    @staticmethod
    def from_model(model: Model) -> Prior:
        """The values and covariance of an earlier identification.

        Parameters and combinations that it did not identify have their tolerance as prior. FitError
        for a model without covariance.
        """
        if model.covariance is None:
            raise FitError(
                "the model has no covariance to use as a prior: identify the model first"
            )
        scale = np.outer(model.table.tolerance, model.table.tolerance)
        size, directions = np.linalg.eigh(model.covariance / scale)
        unseen = directions[:, size < RELATIVE_RANK**2 * size[-1]]
        covariance = model.covariance + (unseen @ unseen.T) * scale
        return Prior(model.table.names, model.values, covariance)

    def of_table(self, table: ParameterTable) -> Prior:
        """The prior of the parameters of a table. Those that this prior does not name are known as
        before any data."""
        if self.names == table.names:
            return self
        at = {name: i for i, name in enumerate(self.names)}
        here = np.array([name in at for name in table.names], dtype=bool)
        there = [at[name] for name in table.names if name in at]
        mean, covariance = table.nominal.copy(), np.diag(table.prior_sigma**2)
        mean[here] = self.mean[there]
        covariance[np.ix_(here, here)] = self.covariance[np.ix_(there, there)]
        return Prior(table.names, mean, covariance)

    def factor(self, table: ParameterTable, free: np.ndarray) -> np.ndarray:
        """The Cholesky factor L (n_free, n_free) of the covariance L L^T of the free parameters, in
        tolerances. FitError if it is singular."""
        tolerance = table.tolerance[free]
        covariance = self.of_table(table).covariance[np.ix_(free, free)]
        scaled = covariance / np.outer(tolerance, tolerance)
        try:
            return np.asarray(np.linalg.cholesky(scaled))
        except np.linalg.LinAlgError:
            raise FitError(
                "the covariance of the prior is singular: fix the parameters that it knows exactly"
            ) from None


def count_determined(squares: np.ndarray, weight: np.ndarray | float) -> float:
    """Count the parameters that the data determine, not their prior: the trace of the hat matrix.

    A direction whose change by one standard deviation of its prior moves the residuals by s sigmas
    counts as s^2 / (s^2 + w), with the variance w of the residuals; without a prior, w = 0, as one.
    With a true prior, the mean of chi2 is w times the number of residuals less this count (T.
    Hastie, R. Tibshirani, Generalized Additive Models, 1990, section 3.5).

    Parameters
    ----------
    squares : array (n,)
        s^2.
    weight : float or array (n,)
        w.

    Examples
    --------
    >>> count_determined(np.array([1e6, 1.0]), 1.0)
    1.499999000001
    """
    return float(np.sum(squares / np.maximum(squares + weight, 1e-300)))


@dataclass(frozen=True)
class Knowledge:
    """A prior of the free parameters, in tolerances: d^T information d with d the distance from
    `mean` (n_free,), all divided by `tolerance` (n_free,); `free` is the mask."""

    tolerance: np.ndarray
    free: np.ndarray
    mean: np.ndarray
    information: np.ndarray

    @classmethod
    def of(
        cls, prior: bool | Prior, table: ParameterTable, free: np.ndarray, weight: float = 1.0
    ) -> Knowledge:
        """The knowledge of a prior, zero without a prior. `weight` is the variance of the residuals
        in noise units."""
        known = Prior.from_tolerances(table) if isinstance(prior, bool) else prior
        tolerance = table.tolerance[free]
        information = np.zeros((len(tolerance), len(tolerance)))
        if prior:
            inverse = np.linalg.inv(known.factor(table, free))
            information = np.asarray(inverse.T @ inverse)
        mean = np.asarray(known.of_table(table).mean)[free]
        return cls(tolerance, free, mean, weight * information)

    @classmethod
    def from_directions(
        cls,
        weak: np.ndarray,
        unseen: np.ndarray,
        start: np.ndarray,
        model: Model,
        free: np.ndarray,
        weight: float = 1.0,
    ) -> Knowledge:
        """The tolerances along some directions (k, n_free) only: along `weak` ones around the
        nominal values, along `unseen` ones around `start` (n,), because no data moved them."""
        tolerance, nominal = model.table.tolerance[free], model.table.nominal[free]
        likely = model.table.prior_sigma[free]
        away = (start[free] - nominal) / likely
        mean = nominal + likely * (unseen.T @ (unseen @ away))
        held = np.concatenate([weak, unseen]) * (tolerance / likely)
        return cls(tolerance, free, mean, weight * held.T @ held)

    def is_close_to(self, other: Knowledge) -> bool:
        """Whether another knowledge is as strong along nearly the same directions."""
        size = max(float(np.abs(self.information).max(initial=0.0)), 1e-300)
        change = float(np.abs(other.information - self.information).max(initial=0.0))
        return change < MAX_DIRECTION_CHANGE * size

    def gradient(self, values: np.ndarray) -> np.ndarray:
        """Half the derivative of `cost` by the free parameters, in tolerances."""
        return np.asarray(self.information @ self._distance(values))

    def cost(self, values: np.ndarray) -> float:
        """The contribution of the parameters (n,) to chi2."""
        return float(self._distance(values) @ self.gradient(values))

    def _distance(self, values: np.ndarray) -> np.ndarray:
        return np.asarray((values[self.free] - self.mean) / self.tolerance)
