"""The result of every identification method, and the step of the iterative ones."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.identification.linearisation import System
from parallel_cal.identification.observability import Spectrum, spectrum
from parallel_cal.identification.prior import Knowledge, Prior, count_determined
from parallel_cal.identification.thresholds import (
    CONVERGED_STEP,
    REWEIGHTINGS,
    ROUNDING,
    UNSEEN_CHANGE,
)
from parallel_cal.model.model import Model


class NoSolutionError(FitError):
    """An identification found no parameters that describe the samples."""


@dataclass(frozen=True)
class Estimate:
    """Result of a method.

    `values` and `covariance` are those of all parameters; the covariance of fixed ones is zero.
    `lost` marks the parameters that the data do not determine. `residuals` are whitened, with
    the number `informative` (N,) of independent ones for each sample. `weight` (N,) is that of the
    samples under a robust loss. `system` is the linearised closure at `values`, if the method can
    start from it with some of the samples.
    """

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
        """Standard deviation of every parameter; infinite if the data do not determine it."""
        return np.where(self.lost, np.inf, np.sqrt(np.diag(self.covariance)))


@dataclass(frozen=True)
class EstimationProblem:
    """The parameters to identify (mask `free`, n_parameters), their start (the model's values), and
    their prior."""

    model: Model
    free: np.ndarray
    prior: bool | Prior | None = False
    assumed: bool = False  # whether the noise is only assumed: its size then follows from chi2

    @cached_property
    def tolerance(self) -> np.ndarray:
        return np.asarray(self.model.table.tolerance[self.free])

    def compute_spectrum(self, system: System, held: bool = True) -> Spectrum:
        """The spectrum at a point. With the prior None and `held`, the tolerances are priors of the
        weak directions."""
        variance = self._variance(system)
        weight = variance if held and self.prior is None else 0.0
        return spectrum(system.triangle, self.model.table, self.free, self.prior, weight, variance)

    def make_knowledge(self, system: System, seen: Spectrum | None = None) -> Knowledge:
        """The prior as knowledge; for the prior None, the tolerances along the directions that the
        data determine weakly at a point. `seen` is the spectrum there, if it is known."""
        table, free = self.model.table, self.free
        if self.prior is not None:
            return Knowledge.of(self.prior, table, free, self._variance(system))
        variance = self._variance(system)
        found = seen or self.compute_spectrum(system)
        weak = found.directions[found.rank - len(found.weak) : found.rank]
        unseen, start = found.directions[found.rank :], self.model.values
        return Knowledge.from_directions(weak, unseen, start, self.model, free, variance)

    def _variance(self, system: System) -> float:
        """Variance of the residuals in noise units; 1 unless the noise is only assumed.

        Directions that a prior holds take few degrees of freedom. Which directions these are
        depends on the variance itself, so it is iterated. If less than one degree of freedom
        remains, the variance is 1.
        """
        if not self.assumed:
            return 1.0
        table, free = self.model.table, self.free
        factor = np.diag(table.prior_sigma[free])
        if isinstance(self.prior, Prior):
            factor = table.tolerance[free][:, None] * self.prior.factor(table, free)
        size = np.linalg.eigvalsh(factor.T @ system.normal @ factor).clip(0)
        rows, chi2, variance = float(system.informative.sum()), max(system.chi2, 1e-300), 0.0
        for _ in range(REWEIGHTINGS):
            taken = count_determined(size, variance)
            if rows - taken < 1 and variance > 0:
                return 1.0
            variance = float(chi2 / max(rows - taken, 1.0))
        return variance


class NormalEquations:
    """The normal equations at a point, scaled by tolerances, in their eigenvectors."""

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
        # No step along directions that the data do not determine.
        damped = size + damping * np.maximum(size, 1e-6 * size[-1])  # weak directions wait
        inverse = np.where(size > floor, 1 / np.maximum(damped, floor), 0.0)
        step = -self._tolerance * (self._directions @ (inverse * self._along))
        return step, float(np.sum(inverse * self._along**2))

    def will_converge(self, promised: float) -> bool:
        """Whether nothing is left to gain after the next step, if it leaves the same share of the
        gain as the last step did, which promised the gain `promised`."""
        return self.step(0.0)[1] ** 2 < UNSEEN_CHANGE * promised * self._chi2

    @property
    def has_converged(self) -> bool:
        """Whether nothing is left to gain, by the undamped step: a damped one may be short far from
        the minimum."""
        step, left = self.step(0.0)
        short = np.max(np.abs(step / self._tolerance), initial=0.0) < CONVERGED_STEP
        return bool(short or left < ROUNDING * self._chi2)


def make_estimate(
    sought: EstimationProblem, values: np.ndarray, system: System, iterations: int, seen: Spectrum
) -> Estimate:
    """Make the estimate at the parameters to which a method converged."""
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
