"""All loops together: one generalised least-squares problem in the Delta's parameters.

Near its estimate g0 a loop's chi2 is |r + A (g - g0)|^2 with A^T A the inverse of its covariance,
and its parameters g(p) are functions of model 54's parameters p.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.identification.fit import FitResult
from parallel_cal.identification.linearisation import Linearisation
from parallel_cal.model.model import Model
from parallel_cal.short_cut.loop import Loop, loop_numbers

Rows = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class CombinedFit:
    """Parameters (n,) of least chi2, whitened residuals (N,), and their Jacobian (N, n_free)."""

    values: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray


def fit_combined(
    robot: Model, loops: Sequence[tuple[Loop, FitResult]], relinearise: bool
) -> CombinedFit:
    """Fit the Delta's parameters to all loops, with its tolerances as priors.

    `relinearise` evaluates the loops' closures again in each step. Without it, only the loops'
    estimates and covariances are used.
    """
    rows = closures if relinearise else linearise_closures
    each = [(loop, found.model.value("L"), rows(found)) for loop, found in loops]

    def stacked(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        residuals, jacobians = [], []
        for loop, length, closure in each:
            g, G = loop_numbers(robot, loop, values, length)
            r, A = closure(g)
            residuals.append(r)
            jacobians.append(A @ G[:, ~robot.fixed])
        return np.concatenate(residuals), np.concatenate(jacobians)

    values = _least_squares(robot, stacked)
    return CombinedFit(values, *stacked(values))


def closures(result: FitResult) -> Rows:
    """Make the function g -> a loop's whitened closures (N,) and their Jacobian (N, 9)."""
    every = np.ones(len(result.model.values), dtype=bool)
    linearise = Linearisation(result.model, result.observations, every, weighted=True)

    def rows(g: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x = linearise.start()
        for _ in range(3):  # the readings converge quadratically to the loop
            system = linearise(g, x)
            x = system.adjusted(np.zeros(len(g)))
        return system.residual.ravel(), system.jacobian.reshape(-1, len(g))

    return rows


def linearise_closures(result: FitResult) -> Rows:
    """Make the same function to first order about the loop's estimate g0."""
    g0 = np.array(result.model.values)
    r, A = closures(result)(g0)
    return lambda g: (r + A @ (g - g0), A)


def _least_squares(robot: Model, stacked: Rows) -> np.ndarray:
    """Parameters of least chi2 with the tolerances as priors (Levenberg-Marquardt)."""
    from scipy.optimize import least_squares

    free, nominal, tolerance = ~robot.fixed, robot.table.nominal, robot.table.tolerance

    def values(u: np.ndarray) -> np.ndarray:
        changed = np.array(robot.values)
        changed[free] = nominal[free] + u * tolerance[free]
        return changed

    found = least_squares(
        lambda u: np.append(stacked(values(u))[0], u),
        ((robot.values - nominal) / tolerance)[free],
        lambda u: np.vstack([stacked(values(u))[1] * tolerance[free], np.eye(len(u))]),
        method="lm",
        xtol=1e-12,
    )
    if not found.success:
        raise FitError(f"the loops could not be combined: {found.message}")
    return values(found.x)
