"""The evidence of a set of causes, in closed form.

    r = A t + sum_k s_k B_k u_k + e,    u_k ~ N(0, 1),    e ~ N(0, sigma^2)

The geometry t is taken out by projection. With a scaled inverse chi-square prior of sigma^2 with nu
degrees of freedom about the noise that was used, the residual has a multivariate t distribution:

    log p(r) = log Gamma((nu + d)/2) - log Gamma(nu/2) - d/2 log(nu pi) - log|S|/2
               - (nu + d)/2 log(1 + r' S^-1 r / nu),     S = 1 + sum_k s_k^2 B_k B_k'

with d degrees of freedom (Gelman et al., Bayesian Data Analysis, 3rd ed., section 14.2).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from parallel_cal.posterior.blocks import Block

# How large a cause is, in usual sizes, and how probable that is: a prior with a heavy tail.
SIZES = np.array([0.3, 1.0, 3.0, 10.0, 30.0])
LOG_WEIGHTS = np.log([0.25, 0.4, 0.22, 0.1, 0.03])
# Degrees of freedom of what is known of the noise: stated, or hardly believed.
STATED, UNKNOWN = 200.0, 2.0
MAX_SOLVED_AT_ONCE = 48  # columns: for more, an LU decomposition costs more than a loop


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


@dataclass(frozen=True)
class Ranked:
    """A cause beside others: log posterior over all settings and sizes, and its best choice."""

    log_p: float
    best: Choice


@dataclass(frozen=True)
class Evidence:
    """The evidence of chosen causes about a residual, and that of one more beside them.

    `squares` is the sum of squares of the residual, `nu` the degrees of freedom of its noise.
    """

    squares: float
    dof: int
    nu: float
    chosen: tuple[Choice, ...] = ()

    def _times(self, block: Block, at: slice) -> np.ndarray:
        """Products (m, c, k) of all chosen columns with those of a block."""
        k = block.columns.shape[2]
        parts = [
            SIZES[one.size] * one.block.times(one.setting, block)[at] for one in self.chosen
        ] or [np.zeros((len(block.columns[at]), 0, k))]
        return np.concatenate(parts, axis=1)

    @cached_property
    def _factor(self) -> np.ndarray:
        """Cholesky factor of 1 + C'C, of the chosen columns C."""
        parts = [
            SIZES[one.size] * self._times(one.block, slice(one.setting, one.setting + 1))[0]
            for one in self.chosen
        ] or [np.zeros((0, 0))]
        gram = np.hstack(parts)
        return np.linalg.cholesky(np.eye(len(gram)) + gram)

    @cached_property
    def _onto(self) -> np.ndarray:
        parts = [SIZES[one.size] * one.block.onto[one.setting] for one in self.chosen]
        return _solve(self._factor, np.concatenate([[], *parts])[None, :, None])[0, :, 0]

    @cached_property
    def _squares(self) -> float:
        """r' S^-1 r."""
        return self.squares - float(self._onto @ self._onto)

    @cached_property
    def _log_det(self) -> float:
        return float(2 * np.log(np.diag(self._factor)).sum())

    @cached_property
    def log_prior(self) -> float:
        return sum(one.log_prior for one in self.chosen)

    @cached_property
    def log_p(self) -> float:
        """Logarithm of the evidence and the prior of the chosen causes, at their sizes."""
        return float(self._log_t(self._squares, self._log_det)) + self.log_prior

    def beside(self, block: Block) -> np.ndarray:
        """The same (m, sizes) with one more cause, for each of its settings and sizes."""
        Z = _solve(self._factor, self._times(block, slice(None)))
        S = block.gram - Z.transpose(0, 2, 1) @ Z
        b = block.onto - Z.transpose(0, 2, 1) @ self._onto
        explained, log_det = np.empty((2, len(S), len(SIZES)))
        for k, size in enumerate(SIZES):
            L = np.linalg.cholesky(np.eye(S.shape[1]) + size**2 * S)
            log_det[:, k] = 2 * np.log(np.diagonal(L, axis1=1, axis2=2)).sum(axis=1)
            along = _solve_each(L, b)
            explained[:, k] = size**2 * np.sum(along**2, axis=1)
        log_p = self._log_t(self._squares - explained, self._log_det + log_det)
        prior = self.log_prior + block.log_prior - np.log(block.tried) + LOG_WEIGHTS
        return np.asarray(log_p + prior)

    def rank(self, block: Block) -> Ranked:
        """One more cause beside the chosen ones."""
        log_p = self.beside(block)
        setting, size = np.unravel_index(int(np.argmax(log_p)), log_p.shape)
        total = float(np.logaddexp.reduce(log_p, axis=None))
        return Ranked(total, Choice(block, int(setting), int(size)))

    def _log_t(self, squares: float | np.ndarray, log_det: float | np.ndarray) -> np.ndarray:
        from scipy.special import gammaln

        nu, d = self.nu, self.dof
        known = gammaln((nu + d) / 2) - gammaln(nu / 2) - d / 2 * np.log(nu * np.pi)
        rest = np.log1p(np.maximum(squares, 1e-300) / nu)
        return np.asarray(known - log_det / 2 - (nu + d) / 2 * rest)


def _solve(L: np.ndarray, right: np.ndarray) -> np.ndarray:
    """L^-1 B (m, c, k) of a lower triangular L (c, c) and each B of (m, c, k)."""
    from scipy.linalg import solve_triangular

    m, c, k = right.shape
    flat = right.transpose(1, 0, 2).reshape(c, m * k)
    solved = solve_triangular(L, flat, lower=True, check_finite=False) if c else flat
    return np.asarray(solved.reshape(c, m, k).transpose(1, 0, 2))


def _solve_each(L: np.ndarray, b: np.ndarray) -> np.ndarray:
    """L_i^-1 b_i (m, k): small ones at once, large ones one by one, which saves most work."""
    if L.shape[1] <= MAX_SOLVED_AT_ONCE:
        return np.asarray(np.linalg.solve(L, b[:, :, None])[:, :, 0])
    rows = zip(L, b, strict=True)
    return np.array([_solve(own, one[None, :, None])[0, :, 0] for own, one in rows])
