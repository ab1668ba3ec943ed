"""Zeros of n quadrics X^T M_i X = 0 in projective n-space, tracked from system to system.

A path X(t) solves M(t) = (1 - t) gamma M_start + t M_target. Because the system is quadratic
in X and linear in t, the Taylor series of a path follows from a short recurrence with one
inverse Jacobian, and its coefficients limit the step. All paths advance together, each with its
own t. Rows of X are the paths, with |X| = 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

ORDER = 10  # order of the Taylor predictor; from 8 to 12 the time is the same
MIN_PATH_REMAINDER = 1e-12  # 1 - t at which a path ends; it cannot reach t = 1 at a multiple zero
# alpha below this proves a zero (Smale's alpha theorem)
MAX_CERTIFIED_ALPHA = (13 - 3 * np.sqrt(17)) / 4


@dataclass(frozen=True)
class Tracker:
    """Paths from the zeros of `start` to those of `target`, (n, n + 1, n + 1) symmetric each.

    `gamma` leads the paths around the finitely many systems with a multiple zero. `tolerance`
    bounds the predictor's error relative to |X| = 1: smaller means shorter, safer steps.
    """

    start: np.ndarray
    target: np.ndarray
    gamma: complex
    tolerance: float = 1e-5
    max_steps: int = 400

    def __call__(self, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Track the zeros X of `start` to zeros (k, n + 1) of `target`; also say which arrived.

        A path to a multiple zero arrives, too, but only near it.
        """
        X, t = normalise(X.astype(complex)), np.zeros(len(X))
        shrink = np.ones(len(X))
        for _ in range(self.max_steps):
            k = np.flatnonzero((t < 1 - MIN_PATH_REMAINDER) & (shrink > 1e-6))
            if len(k) == 0:
                break
            moved, after, good = self._advance(X[k], t[k], shrink[k])
            X[k[good]], t[k[good]] = moved[good], after[good]
            shrink[k] = np.where(good, 1.0, shrink[k] / 2)
        return X, t >= 1 - MIN_PATH_REMAINDER

    def _advance(
        self, X: np.ndarray, t: np.ndarray, shrink: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Advance every path by one step: new X, new t, and whether the step is accepted."""
        series = self._series(X, t)
        # Trust the series up to the step at which its last two terms reach the tolerance.
        last = np.linalg.norm(series[:, -2:], axis=2)
        orders = np.array([ORDER - 1, ORDER])
        trusted = ((self.tolerance / np.maximum(last, 1e-300)) ** (1 / orders)).min(axis=1)
        after = np.minimum(t + shrink * trusted, 1.0)
        powers = (after - t)[:, None] ** np.arange(ORDER + 1)
        X = normalise((powers[:, None, :] @ series)[:, 0])
        first = second = np.full(len(X), np.inf)
        for _ in range(2):
            change, _ = _newton_step(X, self._products(X, after)[0])
            X = normalise(X + change)
            first, second = second, np.linalg.norm(change, axis=1)
        good = (first < 10 * self.tolerance) & (second < 1e-3 * first + 1e-9)
        return X, after, good

    def _series(self, X: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Taylor coefficients x_0 .. x_K of each path at t, (k, K + 1, n + 1), in the chart
        conj(X) . x = 1: order k of x M x = 0 gives 2 x_0 M x_k from the lower ones."""
        n = X.shape[1] - 1
        x = np.zeros((len(X), ORDER + 1, n + 1), dtype=complex)
        W = np.zeros((len(X), n, ORDER + 1, n + 1), dtype=complex)  # M x_k + dM/dt x_(k-1)
        x[:, 0] = X
        Mx, slope = self._products(X, t)
        inverse = -_inverse(_jacobian(Mx, X))[:, :, :n]
        for k in range(1, ORDER + 1):
            order = slope @ X[:, :, None]
            if k > 1:
                lower = x[:, k - 1 : 0 : -1].reshape(len(X), -1, 1)
                order += W[:, :, 1:k].reshape(len(X), n, -1) @ lower
            x[:, k] = (inverse @ order)[:, :, 0]
            Mx, next_slope = self._products(x[:, k], t)
            W[:, :, k] = Mx + slope
            slope = next_slope
        return x

    def _products(self, x: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """M(t) x and dM/dt x, (k, n, n + 1) each."""
        n = len(self.start)
        both = (x @ self._stacked).reshape(len(x), 2, n, n + 1)
        at_start, at_target = both[:, 0], both[:, 1]
        t = t[:, None, None]
        return (1 - t) * at_start + t * at_target, at_target - at_start

    @cached_property
    def _stacked(self) -> np.ndarray:
        both = np.concatenate([self.gamma * self.start, self.target])
        return both.reshape(-1, both.shape[2]).T.copy()


def refine(X: np.ndarray, M: np.ndarray, steps: int = 3) -> np.ndarray:
    """Refine zeros by Newton steps, in the arithmetic (real or complex) of X and M."""
    for _ in range(steps):
        X = normalise(X + _newton_step(X, _multiply(X, M))[0])
    return X


def alpha(X: np.ndarray, M: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute alpha and beta of Smale's theorem for each row of X as a zero of the quadrics M.

    beta is the length of a Newton step. If alpha < MAX_CERTIFIED_ALPHA, the true zero lies within
    2 beta, and it is real if X and M are.
    """
    step, inverse = _newton_step(X, _multiply(X, M))
    beta = np.linalg.norm(step, axis=1)
    # gamma = |DF^-1 D^2F / 2|, bounded by the Frobenius norm of the tensor
    curvature = inverse @ M.reshape(len(M), -1)
    return beta * np.linalg.norm(curvature, axis=(1, 2)), beta


def find_distinct(X: np.ndarray, apart: float = 1e-8) -> np.ndarray:
    """Return the index of the first row of each group of equal points of projective space."""
    if len(X) == 0:
        return np.arange(0)
    overlap = X @ X.conj().T
    difference = X[:, None, :] - overlap[:, :, None] * X[None, :, :]
    same = np.linalg.norm(difference, axis=2) < apart
    return np.flatnonzero(np.argmax(same, axis=1) == np.arange(len(X)))


def normalise(X: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore"):  # a path that blew up becomes NaN
        return X / np.linalg.norm(X, axis=1, keepdims=True)


def _multiply(X: np.ndarray, M: np.ndarray) -> np.ndarray:
    """Products M_i x, (k, n, n + 1), of all points and quadrics."""
    return np.moveaxis(X @ M, 0, 1)


def _newton_step(X: np.ndarray, Mx: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Newton step (k, n + 1) and the part of the inverse Jacobian that belongs to M."""
    inverse = _inverse(_jacobian(Mx, X))[:, :, :-1]
    return -(inverse @ (Mx @ X[:, :, None]))[:, :, 0], inverse


def _jacobian(Mx: np.ndarray, X: np.ndarray) -> np.ndarray:
    """Derivatives of x M x and, in the last row, of the chart's condition conj(X) . x = 1."""
    return np.concatenate([2 * Mx, X.conj()[:, None, :]], axis=1)


def _inverse(A: np.ndarray) -> np.ndarray:
    """Inverses of a batch; a singular matrix gives NaN and does not stop the others."""
    try:
        return np.linalg.inv(A)
    except np.linalg.LinAlgError:
        out = np.full_like(A, np.nan)
        for k, member in enumerate(A):
            if np.linalg.cond(member) < 1 / np.finfo(float).eps:
                out[k] = np.linalg.inv(member)
        return out
