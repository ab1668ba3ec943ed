"""The evidence of a set of causes, in closed form.

    r = A t + sum_k s_k B_k u_k + e,    u_k ~ N(0, 1),    e ~ N(0, sigma^2)

The geometry t is taken out by projection. With a scaled inverse chi-square prior of sigma^2 with nu
degrees of freedom about the noise that was used, the residual has a multivariate t distribution:

    log p(r) = log Gamma((nu + d)/2) - log Gamma(nu/2) - d/2 log(nu pi) - log|S|/2
               - (nu + d)/2 log(1 + r' S^-1 r / nu),     S = 1 + sum_k s_k^2 B_k B_k'

with d degrees of freedom (Gelman et al., Bayesian Data Analysis, 3rd ed., section 14.2).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np

from parallel_cal.posterior.blocks import Block, Stack

# How large a cause is, in usual sizes, and how probable that is: a prior with a heavy tail.
SIZES = np.array([0.3, 1.0, 3.0, 10.0, 30.0])
LOG_WEIGHTS = np.log([0.25, 0.4, 0.22, 0.1, 0.03])
# Degrees of freedom of what is known of the noise: stated, or hardly believed.
STATED, UNKNOWN = 200.0, 2.0


@dataclass(frozen=True)
class Choice:
    """One cause with one of its settings and sizes."""

    block: Block
    setting: int
    size: int

    @property
    def log_prior(self) -> float:
        """Of this cause, this setting and this size."""
        return float(self.block.log_prior + LOG_WEIGHTS[self.size] - np.log(self.block.tried))

    @property
    def usual(self) -> np.ndarray | float:
        """Standard deviations of the parameters of an effect, in tolerances."""
        own = self.block.usual
        return float(SIZES[self.size]) * (own[self.setting] if own else 1.0)


@dataclass(frozen=True)
class Ranked:
    """A cause beside others: log posterior over all settings and sizes, its best choice, and the
    log posterior at this one."""

    log_p: float
    best: Choice
    highest: float


@dataclass(frozen=True)
class Evidence:
    """The evidence of chosen causes about a residual, and that of one more beside them.

    `squares` is the sum of squares of the residual, `nu` the degrees of freedom of its noise. All
    follows from products with L^-1 C', of the chosen columns C and L L' = 1 + C'C. Without a cause
    of a `whole` set, it follows from those of this set: the columns Q of L^-1 that belong to the
    cause, made orthonormal, are the directions in which it explains what the others do not.
    """

    squares: float
    dof: int
    nu: float
    chosen: tuple[Choice, ...] = ()
    whole: Evidence | None = field(default=None, repr=False, compare=False)
    gone: int = 0

    def without(self, k: int) -> Evidence:
        """The evidence of one cause less."""
        whole = self if self.whole is None else replace(self, whole=None)
        rest = self.chosen[:k] + self.chosen[k + 1 :]
        return replace(whole, chosen=rest, whole=whole, gone=k)

    @cached_property
    def _turn(self) -> np.ndarray:
        """L^-1: its use for many causes is faster than solutions."""
        from scipy.linalg import solve_triangular

        if not self.chosen:
            return np.zeros((0, 0))
        gram = np.hstack(
            [
                SIZES[a.size] * self._times(a.block.alone)[:, a.setting, a.block.own(a.setting)]
                for a in self.chosen
            ]
        )
        factor = np.linalg.cholesky(np.eye(len(gram)) + gram)
        return np.asarray(solve_triangular(factor, np.eye(len(gram)), lower=True))

    def _times(self, stack: Stack) -> np.ndarray:
        """Products (c, m, k) of all chosen columns with those of other blocks."""
        parts = [SIZES[one.size] * stack.times(one.block, one.setting) for one in self.chosen]
        return np.concatenate([np.zeros((0, *stack.onto.shape)), *parts])

    @cached_property
    def _gone(self) -> tuple[np.ndarray, float]:
        """The directions Q (c, k) of the cause that is gone, and the logarithm of the determinant
        without it less that with it."""
        assert self.whole is not None
        sizes = [np.count_nonzero(a.block.own(a.setting)) for a in self.whole.chosen]
        end = int(np.sum(sizes[: self.gone + 1]))
        Q, R = np.linalg.qr(self.whole._turn[:, end - sizes[self.gone] : end])
        return Q, float(2 * np.log(np.abs(np.diag(R))).sum())

    @cached_property
    def _alone(self) -> Evidence:
        """The same, but from its own columns."""
        return replace(self, whole=None)

    @cached_property
    def _onto(self) -> np.ndarray:
        """L^-1 C' r, of the whole set."""
        if self.whole is not None:
            return self.whole._onto
        parts = [
            SIZES[a.size] * a.block.onto[a.setting, a.block.own(a.setting)] for a in self.chosen
        ]
        return np.asarray(self._turn @ np.concatenate([[], *parts]))

    @cached_property
    def _squares(self) -> float:
        """r' S^-1 r."""
        if self.whole is not None:
            return self.whole._squares + float(np.sum((self._gone[0].T @ self._onto) ** 2))
        return self.squares - float(self._onto @ self._onto)

    @property
    def noise_variance(self) -> float:
        """The scale of the posterior of sigma^2, a scaled inverse chi-square with nu + d degrees of
        freedom (Gelman et al., section 3.2)."""
        return (self.nu + self._squares) / (self.nu + self.dof)

    @cached_property
    def _log_det(self) -> float:
        if self.whole is not None:
            return self.whole._log_det + self._gone[1]
        return float(-2 * np.log(np.diag(self._turn)).sum())

    @cached_property
    def log_prior(self) -> float:
        return sum(one.log_prior for one in self.chosen)

    @cached_property
    def log_p(self) -> float:
        """Logarithm of the evidence and the prior of the chosen causes, at their sizes."""
        return float(self._log_t(self._squares, self._log_det)) + self.log_prior

    @cached_property
    def _known(self) -> WeakKeyDictionary[Stack, tuple[np.ndarray, np.ndarray, np.ndarray]]:
        return WeakKeyDictionary()

    def _project(self, stack: Stack) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What the chosen causes leave of each setting, with its columns B: B' S^-1 r (m, k), the
        part Z (c, m, k) of them in the directions of B, and B' S^-1 B = B'B - Z'Z (m, k, k), which
        is made if there are more directions than columns."""
        if self.whole is not None:
            if len(self.whole._turn) < stack.onto.shape[1]:  # few directions: not worth it
                return self._alone._project(stack)
            b, Z, S = self.whole._project(stack)
            Q, _ = self._gone
            c, m, k = Z.shape
            back = Q.T @ Z.reshape(c, m * k)
            b = b + ((Q.T @ self._onto) @ back).reshape(m, k)
            back = back.reshape(-1, m, k).transpose(1, 0, 2)
            return b, Z, S + back.transpose(0, 2, 1) @ back
        if stack not in self._known:
            m, k = stack.onto.shape
            c, S = len(self._turn), np.zeros((0, k, k))
            turned = self._turn @ self._times(stack).reshape(c, m * k)
            b, Z = stack.onto - (self._onto @ turned).reshape(m, k), turned.reshape(c, m, k)
            if c >= k:
                each = Z.transpose(1, 0, 2)
                S = stack.squares[:, :, None] * np.eye(k) - each.transpose(0, 2, 1) @ each
            self._known[stack] = b, Z, S
        return self._known[stack]

    def weigh(self, stack: Stack) -> np.ndarray:
        """The log posterior (m, sizes) with one more cause, for each of its settings and sizes.

        The matrix of a cause with the columns B beside the chosen ones is 1 + s^2 (B'B - Z'Z). The
        smaller one of this and of 1 - s^2 Z (1 + s^2 B'B)^-1 Z' is factorised (Woodbury).
        """
        b, Z, S = self._project(stack)
        (c, m, k), s = Z.shape, SIZES[:, None]
        if len(S):
            explained, log_det = _factorise(
                np.eye(k) + s[:, None] ** 2 * S[:, None], s * b[:, None], self._squares
            )
        else:
            D = 1 + s**2 * stack.squares[:, None]  # (m, sizes, k)
            Zb = np.concatenate([Z.transpose(1, 0, 2), b[:, None]], axis=1)
            scaled = ((s**2 / D)[:, :, None] * Zb[:, None]).reshape(m, -1, k)
            M = (scaled @ Zb.transpose(0, 2, 1)).reshape(m, len(SIZES), c + 1, c + 1)
            explained, log_det = _factorise(
                np.eye(c) - M[..., :c, :c], M[..., c, :c], self._squares
            )
            explained += M[..., c, c]
            log_det += np.sum(np.log(D), axis=2)
        log_p = self._log_t(self._squares - explained, self._log_det + log_det)
        return np.asarray(log_p + self.log_prior + stack.log_prior[:, None] + LOG_WEIGHTS)

    def rank(self, stack: Stack) -> list[Ranked]:
        """One more cause beside the chosen ones, for each block of a stack, computed once."""
        key = frozenset(self.chosen), self.nu
        if key not in stack.known:
            stack.known[key] = self._rank(stack)
        known: list[Ranked] = stack.known[key]
        return known

    def _rank(self, stack: Stack) -> list[Ranked]:
        log_p = self.weigh(stack)
        found = []
        for block, own in zip(stack.blocks, np.split(log_p, stack.first[1:]), strict=True):
            setting, size = np.unravel_index(int(np.argmax(own)), own.shape)
            total = float(np.logaddexp.reduce(own, axis=None))
            best = Choice(block, int(setting), int(size))
            found.append(Ranked(total, best, float(own[setting, size])))
        return found

    def _log_t(self, squares: float | np.ndarray, log_det: float | np.ndarray) -> np.ndarray:
        from scipy.special import gammaln

        nu, d = self.nu, self.dof
        known = gammaln((nu + d) / 2) - gammaln(nu / 2) - d / 2 * np.log(nu * np.pi)
        rest = np.log1p(np.maximum(squares, 1e-300) / nu)
        return np.asarray(known - log_det / 2 - (nu + d) / 2 * rest)


def _factorise(K: np.ndarray, w: np.ndarray, most: float) -> tuple[np.ndarray, np.ndarray]:
    """w' K^-1 w, which is at most `most`, and log|K| of matrices (..., k, k) and vectors (..., k).

    The last row of the Cholesky factor of [[K, w], [w', .]] is the solution of the factor of K.
    """
    k = w.shape[-1]
    both = np.empty((*w.shape[:-1], k + 1, k + 1))
    both[..., :k, :k], both[..., k, :k], both[..., :k, k] = K, w, w
    both[..., k, k] = 1 + 2 * most
    L = np.linalg.cholesky(both)
    diagonal = np.diagonal(L, axis1=-2, axis2=-1)[..., :k]
    return np.sum(L[..., k, :k] ** 2, axis=-1), 2 * np.log(diagonal).sum(axis=-1)
