"""Select n of K groups of measurements: greedy exchange and simulated annealing (5.3.9).

Groups are blocks A_k (K, rows, p) of the whitened Jacobian, columns in tolerances. A selection has
the information M = M0 + sum A_k^T A_k with the prior information M0. Criteria are minimised:
D: -log det M; A: trace M^-1; prediction: trace M^-1 W; condition and noise_amplification of M.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from parallel_cal.planning.options import LINEAR

MAX_SWEEPS = 20
MIN_RELATIVE_WEIGHT = 1e-14  # of the largest eigenvalue: below it there are rounding errors only
MIN_RELATIVE_GAIN = 1e-6  # of an exchange: smaller gains only swap equal groups

Report = Callable[[float], None]


@dataclass(frozen=True)
class SelectionProblem:
    """Blocks (K, rows, p), prior information (p, p), weight W (p, p), criterion; `rank`: the number
    of directions in a spectral criterion."""

    blocks: np.ndarray
    before: np.ndarray
    weight: np.ndarray
    criterion: str
    rank: int

    @cached_property
    def weight_factor(self) -> np.ndarray:
        """L (p, rank of W) with W = L L^T: few columns where the weight is of low rank."""
        values, vectors = np.linalg.eigh(self.weight)
        kept = values > MIN_RELATIVE_WEIGHT * values[-1]
        return np.asarray(vectors[:, kept] * np.sqrt(values[kept]))

    def information(self, chosen: np.ndarray) -> np.ndarray:
        A = self.blocks[chosen].reshape(-1, self.blocks.shape[2])
        return np.asarray(self.before + A.T @ A)

    def cost(self, M: np.ndarray) -> float:
        """The criterion of an information matrix, as a logarithm: smaller is better."""
        if self.criterion == "D":
            return -float(np.linalg.slogdet(M)[1]) / len(M)
        if self.criterion in LINEAR:
            return float(np.log(np.trace(np.linalg.solve(M, self.weight))))
        s = np.maximum(np.linalg.eigvalsh(M)[::-1][: self.rank], 1e-300)
        power = 1.0 if self.criterion == "condition" else 2.0
        return float(np.log(s[0]) - power * np.log(s[-1])) / 2


def exchange(problem: SelectionProblem, n: int, report: Report) -> np.ndarray:
    """Select groups (n,): add the best one n times, then replace single ones by better ones until
    no replacement improves (Fedorov). Every step costs one pass over the candidates."""
    chosen: list[int] = []
    M = problem.before.copy()
    for k in range(n):
        chosen.append(int(np.argmax(_gains(problem, np.linalg.inv(M), chosen))))
        M += _square(problem, chosen[-1])
        report(0.3 * (k + 1) / n)
    for sweep in range(MAX_SWEEPS):
        if not _sweep(problem, chosen):
            break
        report(0.3 + 0.7 * (sweep + 1) / MAX_SWEEPS)
    return np.sort(np.array(chosen))


def _sweep(problem: SelectionProblem, chosen: list[int]) -> bool:
    """Replace each selected group by the best other one, if that is better; say if any changed."""
    changed = False
    for i, old in enumerate(list(chosen)):
        others = chosen[:i] + chosen[i + 1 :]
        # Recompute from all the others: an inverse updated a thousand times drifts.
        V = np.linalg.inv(problem.information(np.array(others, dtype=int)))
        gains = _gains(problem, V, others)
        best = int(np.argmax(gains))
        if gains[best] > gains[old] + MIN_RELATIVE_GAIN * abs(gains[old]):
            chosen[i], changed = best, True
    return changed


def _square(problem: SelectionProblem, k: int) -> np.ndarray:
    return np.asarray(problem.blocks[k].T @ problem.blocks[k])


def _gains(problem: SelectionProblem, V: np.ndarray, taken: list[int]) -> np.ndarray:
    """Return how much each candidate (K,) improves the criterion; V is the inverse of M without it.

    det(M + A^T A) = det M det(I + A V A^T); V falls by V A^T (I + A V A^T)^-1 A V.
    """
    A = problem.blocks
    AV = A.reshape(-1, A.shape[2]) @ V
    B = AV.reshape(A.shape) @ A.transpose(0, 2, 1) + np.eye(A.shape[1])
    if problem.criterion == "D":
        gains = np.linalg.slogdet(B)[1]
    else:
        # trace(B^-1 AV W (AV)^T) with W = L L^T
        AVL = (AV @ problem.weight_factor).reshape(*A.shape[:2], -1)
        gains = np.einsum("kij,kij->k", AVL, np.linalg.solve(B, AVL))
    gains = np.array(gains)
    gains[taken] = -np.inf
    return gains


def anneal(
    problem: SelectionProblem, n: int, rng: np.random.Generator, report: Report, steps: int = 20000
) -> np.ndarray:
    """Select groups (n,) by simulated annealing (Zhuang 94): random exchanges from a random set.
    A worse set is accepted with probability exp(-rise / T) while T falls by a factor of 1e5."""
    order = rng.permutation(len(problem.blocks))
    M = problem.information(order[:n])
    cost = problem.cost(M)
    best, best_cost = order[:n].copy(), cost
    # The first temperature is the typical change by a random exchange: most are accepted.
    changed: list[Any] = []
    for _ in range(30):
        i, j = rng.integers(n), rng.integers(min(n, len(order) - 1), len(order))
        trial = M - _square(problem, order[i]) + _square(problem, order[j])
        changed.append(problem.cost(trial))
    T0 = float(np.std(changed)) + 1e-9
    for step in range(steps if len(order) > n else 0):
        i, j = rng.integers(n), rng.integers(n, len(order))
        trial = M - _square(problem, order[i]) + _square(problem, order[j])
        new = problem.cost(trial)
        temperature = T0 * 1e-5 ** (step / steps)
        if new <= cost or rng.random() < np.exp((cost - new) / temperature):
            order[[i, j]] = order[[j, i]]
            M, cost = trial, new
            if cost < best_cost:
                best, best_cost = order[:n].copy(), cost
        if step % 1000 == 0:
            M = problem.information(order[:n])  # subtractions accumulate rounding errors
            report(step / steps)
    return np.sort(best)
