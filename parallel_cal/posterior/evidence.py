"""The evidence of a set of causes, in closed form.

    r = A t + sum_k s_k B_k u_k + e,    u_k ~ N(0, 1),    e ~ N(0, sigma^2)

The geometry t is taken out by projection. With a scaled inverse chi-square prior of sigma^2 with nu
degrees of freedom about the noise that was used, the residual has a multivariate t distribution:

    log p(r) = log Gamma((nu + d)/2) - log Gamma(nu/2) - d/2 log(nu pi) - log|S|/2
               - (nu + d)/2 log(1 + r' S^-1 r / nu),     S = 1 + sum_k s_k^2 B_k B_k'

with d degrees of freedom (Gelman et al., Bayesian Data Analysis, 3rd ed., section 14.2).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from parallel_cal.posterior.blocks import NEGLIGIBLE, Block, Stack

# How large a cause is, in usual sizes, and how probable that is: a prior with a heavy tail.
SIZES = np.array([0.3, 1.0, 3.0, 10.0, 30.0])
LOG_WEIGHTS = np.log([0.25, 0.4, 0.22, 0.1, 0.03])
# Degrees of freedom of what is known of the noise: stated, or hardly believed.
STATED, UNKNOWN = 200.0, 2.0
# Of the evidence for a wave, at most this share is lost between two numbers that are scanned: they
# are half a peak's width apart, and sinc(1/4)^2 = 0.81.
SCAN_LOSS = 0.25


@dataclass(frozen=True)
class Choice:
    """One cause with one of its settings and sizes."""

    block: Block
    setting: int
    size: int

    @property
    def log_prior(self) -> float:
        """Of this cause, this setting and this size."""
        return float(self.block.log_priors[self.setting] + LOG_WEIGHTS[self.size])

    @property
    def is_scanned(self) -> bool:
        """Whether numbers of its setting were chosen among others, by the data."""
        return self.block.tried > 1 and bool(self.block.settings[self.setting])

    @property
    def usual(self) -> np.ndarray:
        """A root (k, m) of the covariance of the parameters of an effect, in tolerances."""
        return float(SIZES[self.size]) * self.block.usual[self.setting]


@dataclass(frozen=True)
class Ranked:
    """A cause beside others: log posterior over all settings and sizes, and its best choice; the
    `rivals` are choices that may be better between the numbers that were scanned."""

    log_p: float
    best: Choice
    rivals: tuple[Choice, ...] = ()


@dataclass(frozen=True)
class Evidence:
    """The evidence of chosen causes about a residual, and that of one more beside them.

    `squares` is the sum of squares of the residual, `nu` the degrees of freedom of its noise.
    """

    squares: float
    dof: int
    nu: float
    chosen: tuple[Choice, ...] = ()

    def _times(self, stack: Stack) -> np.ndarray:
        """Products (c, m, k) of all chosen columns with those of other blocks."""
        parts = [SIZES[one.size] * stack.times(one.block, one.setting) for one in self.chosen]
        return np.concatenate([np.zeros((0, *stack.onto.shape)), *parts])

    @cached_property
    def _factor(self) -> np.ndarray:
        """Cholesky factor of 1 + C'C, of the chosen columns C."""
        parts = [
            SIZES[one.size] * self._times(one.block.alone)[:, one.setting] for one in self.chosen
        ] or [np.zeros((0, 0))]
        gram = np.hstack(parts)
        return np.linalg.cholesky(np.eye(len(gram)) + gram)

    @cached_property
    def _turn(self) -> np.ndarray:
        """Inverse of the factor: its use for many causes is faster than solutions."""
        from scipy.linalg import solve_triangular

        c = len(self._factor)
        if not c:
            return np.zeros((0, 0))
        return np.asarray(solve_triangular(self._factor, np.eye(c), lower=True))

    @cached_property
    def _onto(self) -> np.ndarray:
        parts = [SIZES[one.size] * one.block.onto[one.setting] for one in self.chosen]
        return np.asarray(self._turn @ np.concatenate([[], *parts]))

    @cached_property
    def _squares(self) -> float:
        """r' S^-1 r."""
        return self.squares - float(self._onto @ self._onto)

    @cached_property
    def _inverse_root(self) -> tuple[np.ndarray, np.ndarray]:
        """U and U diag(w), both (n, k), of S^-1/2 = 1 - U diag(w) U'."""
        C = np.hstack([SIZES[one.size] * one.block.at(one.setting) for one in self.chosen])
        squares, V = np.linalg.eigh(C.T @ C)
        counts = squares > NEGLIGIBLE
        U = C @ (V[:, counts] / np.sqrt(squares[counts]))
        return U, U * (1 - 1 / np.sqrt(1 + squares[counts]))

    def take_out(self, columns: np.ndarray) -> np.ndarray:
        """Columns (n, k) or (n,) times S^-1/2: without what the chosen causes explain."""
        if not self.chosen:
            return columns
        U, Uw = self._inverse_root
        return np.asarray(columns - Uw @ (U.T @ columns))

    @property
    def outside(self) -> Evidence:
        """The evidence of one more cause beside the chosen ones, less that of these, if they were
        taken out of its columns and of the residual."""
        return Evidence(self._squares, self.dof, self.nu)

    @property
    def noise_variance(self) -> float:
        """The scale of the posterior of sigma^2, a scaled inverse chi-square with nu + d degrees of
        freedom (Gelman et al., section 3.2)."""
        return (self.nu + self._squares) / (self.nu + self.dof)

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

    def weigh(self, stack: Stack) -> np.ndarray:
        """The log posterior (m, sizes) with one more cause, for each of its settings and sizes.

        With orthogonal columns B of the cause, and Z the part of the chosen ones in their
        directions, its matrix is 1 + s^2 (B'B - Z'Z). The smaller one of this and of 1 - s^2 Z
        (1 + s^2 B'B)^-1 Z' is factorised (Woodbury).
        """
        (m, k), c = stack.onto.shape, len(self._turn)
        turned = self._turn @ self._times(stack).reshape(c, m * k)
        b = stack.onto - (self._onto @ turned).reshape(m, k)
        Z = turned.reshape(c, m, k).transpose(1, 0, 2)
        s = SIZES[:, None]
        if c < k:
            D = 1 + s**2 * stack.squares[:, None]  # (m, sizes, k)
            Zb = np.concatenate([Z, b[:, None]], axis=1)
            scaled = ((s**2 / D)[:, :, None] * Zb[:, None]).reshape(m, -1, k)
            M = (scaled @ Zb.transpose(0, 2, 1)).reshape(m, len(SIZES), c + 1, c + 1)
            explained, log_det = _factorise(
                np.eye(c) - M[..., :c, :c], M[..., c, :c], self._squares
            )
            explained += M[..., c, c]
            log_det += np.sum(np.log(D), axis=2)
        else:
            S = stack.squares[:, :, None] * np.eye(k) - Z.transpose(0, 2, 1) @ Z
            explained, log_det = _factorise(
                np.eye(k) + s[:, None] ** 2 * S[:, None], s * b[:, None], self._squares
            )
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
            found.append(Ranked(total, Choice(block, int(setting), int(size))))
        return found

    def rank_one(self, block: Block) -> Ranked:
        """One more cause, whose joints may have numbers of their own."""
        [common] = self.rank(block.alone)
        return self.let_joints_differ(common)

    def let_joints_differ(self, common: Ranked, least: float = -np.inf) -> Ranked:
        """A cause whose joints may have numbers of their own, unless it cannot have the log
        posterior `least`.

        The joints in which it is likely are taken in turn, the likeliest first: each has the number
        of the others, or its own if that is likelier though it is one more that was chosen.
        """
        block = common.best.block
        # The number for all explains as much as that joint which explains most by its own.
        if block.own is None or self._promise(len(block.own.columns) * [common.log_p]) < least:
            return common
        beside, own = self, dict[str, int]()
        while True:
            parts = (one for stack in block.parts for one in beside.rank(stack))
            left = [one for one in parts if one.best.block.name not in own]
            likeliest = max(left, key=lambda one: one.log_p, default=None)
            if not own and self._promise(one.log_p for one in left) < max(least, common.log_p):
                return common
            if likeliest is None or likeliest.log_p <= beside.log_p:
                break
            own[likeliest.best.block.name] = likeliest.best.setting
            beside = replace(beside, chosen=(*beside.chosen, likeliest.best))
        # What needs no number, such as the bend of a screw, is alone in some joints.
        own = {joint: one for joint, one in own.items() if block.settings[one]}
        if len(set(own.values())) < 2:
            return common
        found = [Ranked(common.log_p, common.best)]
        starts = [one for one in {common.best.setting, *own.values()} if block.settings[one]]
        for start in starts:
            apart, reached = dict[str, int](), self._weigh_alone(block.combine(start, {}))
            for joint in own:
                if own[joint] == start or len(apart) + 1 == len(block.own.columns):
                    continue  # one joint has the common number
                more = self._weigh_alone(block.combine(start, {**apart, joint: own[joint]}))
                if more and (reached is None or more.log_p > reached.log_p):
                    apart[joint], reached = own[joint], more
            if apart and reached:
                found.append(reached)
        found.sort(key=lambda one: -one.log_p)
        total = float(np.logaddexp.reduce([one.log_p for one in found]))
        near = (one.best for one in found[1:] if self.highest(one.log_p) > found[0].log_p)
        return Ranked(total, found[0].best, tuple(near))

    def _promise(self, each: Iterable[float]) -> float:
        """The log posterior that causes have together at most, at the peaks of their numbers, if
        `each` is that of one: they explain the sum of the squares that each explains."""
        power = (self.nu + self.dof) / 2
        shares = (1 - np.exp(min(self.log_p - one, 0.0) / power) for one in each)
        left = 1 - float(sum(shares)) / (1 - SCAN_LOSS)
        return self.log_p - power * float(np.log(max(left, 1e-12)))

    def highest(self, log_p: float) -> float:
        """The log posterior that one more cause has at most at the peak of numbers of which it has
        a `log_p` at those that were scanned."""
        return max(log_p, self.log_p + (log_p - self.log_p) / (1 - SCAN_LOSS))

    def _weigh_alone(self, block: Block | None) -> Ranked | None:
        """A cause with one setting beside others."""
        if block is None:
            return None
        weighed = self.weigh(block.alone)[0]
        best = Choice(block, 0, int(np.argmax(weighed)))
        return Ranked(float(np.logaddexp.reduce(weighed)), best)

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
