"""Damped descent on whitened residuals, and the estimate at its end, for several methods."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.identification.estimate import (
    Estimate,
    EstimationProblem,
    NormalEquations,
    NoSolutionError,
    make_estimate,
)
from parallel_cal.identification.linearisation import Linearisation, System
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.thresholds import (
    MAX_DIRECTION_CHOICES,
    MAX_REPETITIONS,
    UNSEEN_CHANGE,
)
from parallel_cal.model.model import Model

ITERATIONS = 600  # most fits need 10; a curved valley, hundreds

# Arguments: the parameters, the previous system (None at the start), and the step (n_free,) from
# the parameters of that system. Returns the system at the parameters; None without a solution.
Reach = Callable[[np.ndarray, System | None, np.ndarray], System | None]


@dataclass
class PredictedSystem(System):
    """Whitened residuals (N, m) and Jacobian (N, m, n_free) of a method without adjustment,
    with the raw residuals and the Cholesky factors that whiten them."""

    adjusted: Callable[[np.ndarray], np.ndarray] = field(init=False, repr=False)
    raw: np.ndarray = field(kw_only=True)
    whitener: np.ndarray = field(kw_only=True)

    def select(self, index: np.ndarray) -> None:
        return None  # its samples are those that could be solved

    def chi2_of(self, other: System) -> float:
        """Another point's chi2 in this one's weights: what a step from here can lower."""
        assert isinstance(other, PredictedSystem)
        return float(np.sum(np.linalg.solve(self.whitener, other.raw[:, :, None]) ** 2))


@dataclass(frozen=True)
class _Point:
    """Parameters, the residuals linearised there, and what a prior adds to chi2."""

    values: np.ndarray
    system: System
    normal: NormalEquations
    known: float

    def fall_to(self, other: _Point) -> float:
        """How much lower chi2 and prior are at another point."""
        return self.system.chi2 + self.known - self.system.chi2_of(other.system) - other.known


@dataclass(frozen=True)
class Damping:
    """The damping of a step, and how many steps in turn have failed: each raises it by more than
    the last one, so that few are tried where only a short step helps (H. B. Nielsen, Damping
    parameter in Marquardt's method, IMM-REP-1999-05, Technical University of Denmark)."""

    size: float = 1e-6
    failed: int = 0

    def after(self, fall: float, promised: float) -> Damping:
        """The damping of the next step, after one that fell by `fall` instead of `promised`."""
        failed = 0 if fall > 0 else self.failed + 1
        if fall > promised / 2:
            return Damping(max(self.size / 5, 1e-12))
        # A fall below half of the predicted one shows curvature: longer steps would oscillate.
        return Damping(min(max(self.size * 3.0 ** max(failed, 1), 1e-6), 1e12), failed)


def minimise(
    sought: EstimationProblem,
    reach: Reach,
    advice: str,
    near: bool = False,
    steps: int = ITERATIONS,
) -> Estimate:
    """Levenberg-Marquardt (C.4) on whitened residuals, for every iterative method.

    The tolerances are priors of the directions that the data determine weakly. These directions are
    chosen at the start, and again at every minimum until they stay the same. If `near` a solution,
    the last step is applied without an evaluation if it is predicted to converge. After so many
    `steps` it ends, converged or not. FitError with `advice` if it does not converge in ITERATIONS.
    """
    free, stay = sought.free, np.zeros(int(sought.free.sum()))

    def at(values: np.ndarray, before: System | None, step: np.ndarray) -> _Point | None:
        system = reach(values, before, step)
        return None if system is None else held(values, system)

    def held(values: np.ndarray, system: System) -> _Point:
        normal = NormalEquations(system, values, sought.tolerance, known)
        return _Point(values, system, normal, known.cost(values))

    def ahead(point: _Point, damping: float) -> tuple[_Point | None, float]:
        step, promised = point.normal.step(damping)
        values = point.values.copy()
        values[free] += step
        return at(values, point.system, step), promised

    first = reach(np.array(sought.model.values), None, stay)
    if first is None:
        raise FitError("the starting model has no solution at some samples: start nearer")
    known, choices = sought.make_knowledge(first), 1
    here, costs = held(np.array(sought.model.values), first), [np.inf]
    damping, promised, settled = Damping(), np.inf, False
    for k in range(ITERATIONS):
        ends = k == steps
        last = near and (ends or (k > 0 and here.normal.will_converge(promised)))
        if (k > 0 and here.normal.has_converged) or last or ends or _gain_nothing(costs):
            seen = sought.compute_spectrum(here.system)
            better = sought.make_knowledge(here.system, seen)
            if ends or choices >= MAX_DIRECTION_CHOICES or known.is_close_to(better):
                values = here.values.copy()
                values[free] += here.normal.step(0.0)[0] if last else 0.0
                found = make_estimate(sought, values, here.system, k, seen)
                return replace(found, system=here.system)
            known, choices, damping, costs = better, choices + 1, Damping(), [np.inf]
            here = held(here.values, here.system)
        tried, promised = ahead(here, damping.size)
        if tried is not None and here.fall_to(tried) < 0:
            # A step along a curved valley ends on its slope; a second one leads to its floor.
            tried, _ = ahead(tried, damping.size)
        fall = -np.inf if tried is None else here.fall_to(tried)
        damping = damping.after(fall, promised)
        nothing = 1e-9 * (here.system.chi2 + here.known)
        if tried is not None and fall >= -nothing:
            here, settled = tried, False
        elif not settled:
            # Linearise at adjusted quantities: only costs at such points can be compared.
            before, here = here, at(here.values, here.system, stay) or here
            settled = abs(before.system.chi2 - here.system.chi2) <= nothing
        costs.append(here.system.chi2 + here.known)
    raise NoSolutionError(
        f"identification did not converge in {ITERATIONS} iterations (chi2 "
        f"{here.system.chi2:.3g} of {len(here.system.residual)} samples): {advice}"
    )


def _gain_nothing(costs: list[float]) -> bool:
    """Whether the last steps gained almost nothing: the minimum is reached, even if it is flat."""
    if len(costs) <= MAX_REPETITIONS:
        return False
    return costs[-MAX_REPETITIONS - 1] - costs[-1] < UNSEEN_CHANGE * costs[-1]


def make_estimate_at(
    sought: EstimationProblem,
    values: np.ndarray,
    observations: Observations,
    covariance: np.ndarray,
    iterations: int,
) -> Estimate:
    """Make the estimate at values that a method found without weights: chi2 is that of the closure
    in units of inherited noise.

    The `covariance` (n_free, n_free) of the method replaces that of the weighted optimum.
    """
    linearise = Linearisation(sought.model, observations, sought.free, True)
    system = linearise(values, linearise.start())
    found = make_estimate(
        sought, values, system, iterations, sought.compute_spectrum(system, held=False)
    )
    whole = np.zeros_like(found.covariance)
    whole[np.ix_(sought.free, sought.free)] = covariance
    return replace(found, covariance=whole)


def propagate_covariance(
    influence: np.ndarray, model: Model, values: np.ndarray, observations: Observations
) -> np.ndarray:
    """Propagate the noise W = C S C^T of the closure's rows to the estimates: the covariance is
    influence W influence^T, with `influence` (n_free, N * rows) of the rows on the estimates."""
    none = np.zeros(len(values), dtype=bool)
    _, C, _ = Linearisation(model, observations, none, True).blocks(values, observations.x)
    W = C @ observations.S @ C.transpose(0, 2, 1)
    parts = influence.reshape(len(influence), *W.shape[:2])
    return np.asarray(np.einsum("anr,nrs,bns->ab", parts, W, parts, optimize=True))


def check_measured(
    observations: Observations, columns: np.ndarray, names: list[str], method: str
) -> None:
    """Raise FitError if a coordinate that the method needs was not measured, or if other sensors
    were read."""
    if observations.reading.shape[1]:
        raise FitError(f"{method} calibration knows poses only; use the implicit method")
    missing = [
        n for n, c in zip(names, columns, strict=True) if not observations.measured[:, c].all()
    ]
    if missing:
        raise FitError(
            f"{method} calibration needs {', '.join(missing)} at every sample; where they were "
            "not measured, use the implicit method"
        )
