"""The optimisers of annex C on one interface, to be compared (table 5.7).

Parameters are scaled by the caller; each optimiser stops when the merit Q = r^T r (C.2) no longer
changes, and reports how often it evaluated a step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np

from parallel_cal.base.compiled import Batch, dense
from parallel_cal.base.errors import FitError
from parallel_cal.identification.observations import Observations
from parallel_cal.model.model import Model


@dataclass(frozen=True)
class LeastSquares:
    """Residuals r(p) (N,), Jacobian J(p) (N, n) and the Hessian of r^T r / 2 (n, n)."""

    residual: Callable[[np.ndarray], np.ndarray]
    jacobian: Callable[[np.ndarray], np.ndarray]
    hessian: Callable[[np.ndarray], np.ndarray]

    def merit(self, p: np.ndarray) -> float:
        return float(np.sum(self.residual(p) ** 2))

    def gradient(self, p: np.ndarray) -> np.ndarray:
        """J^T r: half the gradient of Q (C.3)."""
        return np.asarray(self.jacobian(p).T @ self.residual(p))


@dataclass(frozen=True)
class Descent:
    """Where an optimiser ended, its merit Q, and the steps it took."""

    p: np.ndarray
    merit: float
    iterations: int


Step = Callable[[LeastSquares, np.ndarray], np.ndarray]


def gauss_newton_normal(problem: LeastSquares, p: np.ndarray, epsilon: float = 1e-9) -> Descent:
    """Normal equations (C.17)."""

    def step(s: LeastSquares, p: np.ndarray) -> np.ndarray:
        J = s.jacobian(p)
        return np.asarray(-np.linalg.solve(J.T @ J, J.T @ s.residual(p)))

    return _repeat(problem, p, step, epsilon)


def gauss_newton_svd(problem: LeastSquares, p: np.ndarray, epsilon: float = 1e-9) -> Descent:
    """Singular values below 1e-12 of the largest are taken for zero (C.22)."""

    def step(s: LeastSquares, p: np.ndarray) -> np.ndarray:
        U, w, Vt = np.linalg.svd(s.jacobian(p), full_matrices=False)
        inverse = np.where(w > 1e-12 * w[0], 1 / np.maximum(w, 1e-300), 0.0)
        return np.asarray(-Vt.T @ (inverse * (U.T @ s.residual(p))))

    return _repeat(problem, p, step, epsilon)


def newton(problem: LeastSquares, p: np.ndarray, epsilon: float = 1e-9) -> Descent:
    """With the identification Hessian (C.11)."""
    return _repeat(problem, p, lambda s, p: -np.linalg.solve(s.hessian(p), s.gradient(p)), epsilon)


def levenberg_marquardt(problem: LeastSquares, p: np.ndarray, epsilon: float = 1e-9) -> Descent:
    """Marquardt's rule: lambda falls tenfold after a good step and grows after a bad one (C.23)."""
    damping, merit = 1e-3, problem.merit(p)
    for k in range(1, 1000):
        J = problem.jacobian(p)
        normal = J.T @ J + damping * np.trace(J.T @ J) / len(p) * np.eye(len(p))
        trial = p - np.linalg.solve(normal, J.T @ problem.residual(p))
        new = problem.merit(trial)
        if abs(merit - new) <= epsilon * merit:
            return Descent(trial if new < merit else p, min(new, merit), k)
        better = new < merit
        damping = damping / 10 if better else damping * 10
        p, merit = (trial, new) if better else (p, merit)
    raise FitError(f"Levenberg-Marquardt did not converge (merit {merit:.3g})")


def steepest_descent(
    problem: LeastSquares, p: np.ndarray, epsilon: float = 1e-9, most: int = 100_000
) -> Descent:
    """Against the gradient, as far as the quadratic model falls, halved while Q does not (C.24)."""
    merit = problem.merit(p)
    for k in range(1, most):
        g = problem.gradient(p)
        length = float(g @ g) / max(float(np.sum((problem.jacobian(p) @ g) ** 2)), 1e-300)
        while problem.merit(p - length * g) > merit:
            length /= 2
        p = p - length * g
        before, merit = merit, problem.merit(p)
        if before - merit <= epsilon * merit:
            return Descent(p, merit, k)
    raise FitError(f"steepest descent did not converge in {most} steps (merit {merit:.3g})")


def _repeat(problem: LeastSquares, p: np.ndarray, step: Step, epsilon: float) -> Descent:
    merit = problem.merit(p)
    for k in range(1, 100):
        p = p + step(problem, p)
        before, merit = merit, problem.merit(p)
        if abs(before - merit) <= epsilon * merit:
            return Descent(p, merit, k)
    raise FitError(f"no convergence in 100 steps (merit {merit:.3g})")


def closure_problem(
    model: Model, observations: Observations, unit: np.ndarray, factor: float = 1.0
) -> LeastSquares:
    """The closure's merit (eq. 5.6) in parameters p * unit; derivatives by CasADi.

    `factor` multiplies the closure (2 b for the thesis' residuals in m^2, eq. 5.16); it may
    be an expression of the model's symbols.
    """
    s = model.structure
    phi = factor * s.phi
    J = ca.jacobian(phi, s.v)
    H = ca.hessian(ca.sumsqr(phi) / 2, s.v)[0]
    inputs = (s.configuration, s.a, s.v)
    f, j, h = (Batch(dense(n, inputs, [e])) for n, e in (("r", phi), ("J", J), ("H", H)))
    rows, n = phi.numel(), len(unit)

    def evaluate(batch: Batch, p: np.ndarray) -> np.ndarray:
        return batch(observations.x, observations.a, p * unit)[0]

    def jacobian(p: np.ndarray) -> np.ndarray:
        flat = evaluate(j, p).reshape(-1, n, rows).transpose(0, 2, 1)
        return np.asarray(flat.reshape(-1, n) * unit)

    return LeastSquares(
        lambda p: evaluate(f, p).ravel(),
        jacobian,
        lambda p: evaluate(h, p).sum(axis=0).reshape(n, n) * np.outer(unit, unit),
    )
