"""What every method answers, and the step that the iterated ones share."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from parallel_cal.identification.linearisation import System
from parallel_cal.identification.observability import Spectrum, spectrum
from parallel_cal.identification.prior import Knowledge, Prior
from parallel_cal.identification.thresholds import (
    CONVERGED_GAIN,
    CONVERGED_STEP,
    UNSEEN_GAIN,
    VARIANCE_STEPS,
)
from parallel_cal.model.model import Model


@dataclass(frozen=True)
class Estimate:
    """What a method found: values and covariance (all parameters, fixed ones at zero),
    chi2 and its degrees of freedom, what the data can see, whitened residuals a sample with
    the number (N,) of independent ones, and the samples' weights (N,) under a robust loss;
    `system` of the point it settled at, where the method can begin there without some samples."""

    values: np.ndarray
    covariance: np.ndarray
    lost: np.ndarray
    chi2: float
    dof: int
    spectrum: Spectrum
    residuals: np.ndarray
    informative: np.ndarray
    iterations: int
    weight: np.ndarray | None = None
    system: System | None = None

    def __repr__(self) -> str:
        return (
            f"Estimate({len(self.values)} parameters, rank {self.spectrum.rank}, "
            f"chi2 {self.chi2:.4g}, {self.dof} degrees of freedom)"
        )

    @property
    def chi2_per_dof(self) -> float:
        return self.chi2 / self.dof if self.dof > 0 else float("nan")

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviation of every parameter; infinite where the data cannot see it."""
        return np.where(self.lost, np.inf, np.sqrt(np.diag(self.covariance)))


@dataclass(frozen=True)
class EstimationProblem:
    """The parameters of a model that are identified, `free` (n_parameters,) a mask, from the
    model's own values on, with what is known of them before."""

    model: Model
    free: np.ndarray
    prior: bool | Prior | None = False
    assumed: bool = False  # whether nobody measured the noise: chi2 alone says how large it is

    @cached_property
    def tolerance(self) -> np.ndarray:
        return np.asarray(self.model.table.tolerance[self.free])

    def compute_spectrum(self, system: System, held: bool = True) -> Spectrum:
        """What the data see at a point; without a prior of all (None) the tolerances are known
        where the data tell less, if that was made use of (`held`)."""
        variance = self._variance(system)
        weight = variance if held and self.prior is None else 0.0
        return spectrum(system.triangle, self.model.table, self.free, self.prior, weight, variance)

    def make_knowledge(self, system: System, seen: Spectrum | None = None) -> Knowledge:
        """The prior; None is the tolerances along directions that the data at a point, where this
        is `seen`, tell less of."""
        table, free = self.model.table, self.free
        if self.prior is not None:
            return Knowledge.of(self.prior, table, free, self._variance(system))
        variance = self._variance(system)
        found = seen or self.compute_spectrum(system)
        weak = found.directions[found.rank - len(found.weak) : found.rank]
        unseen, start = found.directions[found.rank :], self.model.values
        return Knowledge.from_directions(weak, unseen, start, self.model, free, variance)

    def _variance(self, system: System) -> float:
        """Of the residuals in noise units, where only the noise's proportions are known.

        Directions that tolerances hold take few degrees of freedom, and which these are depends on
        the variance itself. Where fewer than one is left, the figures are taken as they are.
        """
        if not self.assumed:
            return 1.0
        scale = self.model.table.prior_sigma[self.free]
        size = np.linalg.eigvalsh(system.normal * np.outer(scale, scale)).clip(0)
        rows, chi2, variance = float(system.informative.sum()), max(system.chi2, 1e-300), 0.0
        for _ in range(VARIANCE_STEPS):
            taken = np.sum(size / np.maximum(size + variance, 1e-300))
            if rows - taken < 1 and variance > 0:
                return 1.0
            variance = float(chi2 / max(rows - taken, 1.0))
        return variance


class NormalEquations:
    """The normal equations at a point, scaled by tolerances, along their own directions."""

    def __init__(self, system: System, values: np.ndarray, tolerance: np.ndarray, known: Knowledge):
        normal = system.normal * np.outer(tolerance, tolerance) + known.information
        gradient = tolerance * system.gradient + known.gradient(values)
        self._size, directions = np.linalg.eigh(normal)
        self._tolerance, self._directions = tolerance, directions
        self._along, self._chi2 = directions.T @ gradient, system.chi2

    def step(self, damping: float) -> tuple[np.ndarray, float]:
        """A damped Gauss-Newton step (n_free,), and the fall of chi2 that it promises."""
        size = self._size
        floor = max(1e-13 * size[-1], 1e-300)
        # Directions the data cannot see keep their values: no walk along them.
        damped = size + damping * np.maximum(size, 1e-6 * size[-1])  # weak directions wait
        inverse = np.where(size > floor, 1 / np.maximum(damped, floor), 0.0)
        step = -self._tolerance * (self._directions @ (inverse * self._along))
        return step, float(np.sum(inverse * self._along**2))

    def will_converge(self, promised: float) -> bool:
        """Whether the next step leaves nothing to gain, where that is as large a share as the last
        one, which promised so much, left."""
        return self.step(0.0)[1] ** 2 < UNSEEN_GAIN * promised * self._chi2

    @property
    def has_converged(self) -> bool:
        """Whether there is nothing left to gain; a damped step may be short far from there."""
        step, left = self.step(0.0)
        short = np.max(np.abs(step / self._tolerance), initial=0.0) < CONVERGED_STEP
        return bool(short or left < CONVERGED_GAIN * self._chi2)


def make_estimate(
    sought: EstimationProblem, values: np.ndarray, system: System, iterations: int, seen: Spectrum
) -> Estimate:
    """The estimate at parameters where a method has settled."""
    free = sought.free
    covariance = np.zeros((len(values), len(values)))
    covariance[np.ix_(free, free)] = seen.covariance
    lost = np.zeros(len(values), dtype=bool)
    lost[free] = seen.lost
    dof = round(float(system.informative.sum()) - seen.taken)
    return Estimate(
        values,
        covariance,
        lost,
        system.chi2,
        dof,
        seen,
        system.residual,
        system.informative,
        iterations,
    )
