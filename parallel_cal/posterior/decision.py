"""Choose measurements that decide between sets of causes: those after which the entropy of their
posterior is expected to be least.

Refitted to the data in hand, a set i of causes predicts new rows y, in units of the noise, as a
Gaussian with mean m_i and covariance V_i = 1 + X_i X_i': the noise, and what the data leave
uncertain of the geometry and of the coefficients of the causes. So y is drawn from a mixture of
Gaussians with the probabilities p_i, and the expected entropy of the posterior is

    E[H(i | y)] = H(i) - I(i; y),     I(i; y) >= -sum_i p_i log sum_j p_j exp(-B_ij)

with the Bhattacharyya distances of the Gaussians

    B_ij = (m_i - m_j)' V^-1 (m_i - m_j)/8 + (log|V| - (log|V_i| + log|V_j|)/2)/2,
    V = (V_i + V_j)/2

(Kolchinsky and Tracey, Entropy 19, 361, 2017: a bound that is exact where the predictions agree and
where they lie far apart). The expected logarithm of the Bayes factor of two sets, the criterion of
Box and Hill (Technometrics 9, 57, 1967), has no such limit: it would still be raised by measuring
on what is decided.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Rival:
    """What one set of causes predicts of K poses with r rows each, in units of the noise.

    Attributes
    ----------
    p : float
        Its probability.
    mean : array (K, r)
    spread : array (K, r, k)
        X of the covariance 1 + X X' of all rows together.
    """

    p: float
    mean: np.ndarray = field(repr=False)
    spread: np.ndarray = field(repr=False)


@dataclass
class _Gaussian:
    """Rows of chosen poses, with covariance 1 + X X', and how far a difference d lies in it."""

    spread: np.ndarray
    d: np.ndarray
    log_det: float = 0.0
    squares: float = 0.0

    def __post_init__(self) -> None:
        k = self.spread.shape[2]
        self.information, self.onto = np.eye(k), np.zeros(k)

    def with_each(self) -> tuple[np.ndarray, np.ndarray]:
        """log det and squared length (K,) with each one of the poses in addition."""
        X = self.spread
        XV = (X.reshape(-1, X.shape[2]) @ np.linalg.inv(self.information)).reshape(X.shape)
        S = XV @ X.transpose(0, 2, 1) + np.eye(X.shape[1])
        away = self.d - XV @ self.onto
        more = np.einsum("kr,kr->k", away, np.linalg.solve(S, away[:, :, None])[:, :, 0])
        return self.log_det + np.linalg.slogdet(S)[1], self.squares + more

    def add(self, pose: int) -> None:
        log_det, squares = self.with_each()
        self.log_det, self.squares = float(log_det[pose]), float(squares[pose])
        X = self.spread[pose]
        self.information = self.information + X.T @ X
        self.onto = self.onto + X.T @ self.d[pose]


def compute_entropy(p: np.ndarray) -> float:
    """Entropy of probabilities, in nats."""
    p = p[p > 0]
    return float(-(p * np.log(p)).sum())


def compute_certainty(entropy: float) -> float:
    """Probability of the likeliest of two sets whose posterior has this entropy (nats)."""
    from scipy.optimize import brentq

    if entropy >= np.log(2):  # more than two sets
        return float(np.exp(-entropy))
    return float(brentq(lambda p: compute_entropy(np.array([p, 1 - p])) - entropy, 0.5, 1.0))


def choose_deciding_poses(
    rivals: Sequence[Rival], most: int, enough: float
) -> tuple[list[int], list[float]]:
    """Choose poses one by one, each that after which the expected entropy is least, until it is
    `enough` or there are `most`.

    Returns
    -------
    tuple of list of int and list of float
        The poses, and an upper bound of the expected entropy after each, in nats.
    """
    p = np.array([rival.p for rival in rivals]) / sum(rival.p for rival in rivals)
    n, K = len(rivals), len(rivals[0].mean)
    own = [_Gaussian(one.spread, np.zeros_like(one.mean)) for one in rivals]
    pairs = {
        (i, j): _Gaussian(
            np.concatenate([rivals[i].spread, rivals[j].spread], axis=2) / np.sqrt(2),
            rivals[i].mean - rivals[j].mean,
        )
        for i in range(n)
        for j in range(i)
    }
    chosen, entropy = list[int](), list[float]()
    while len(chosen) < min(most, K):
        log_det = [one.with_each()[0] for one in own]
        B = np.zeros((K, n, n))
        for (i, j), pair in pairs.items():
            both, squares = pair.with_each()
            B[:, i, j] = squares / 8 + (both - (log_det[i] + log_det[j]) / 2) / 2
            B[:, j, i] = B[:, i, j]
        expected = compute_entropy(p) + np.log(np.exp(-B) @ p) @ p
        expected[chosen] = np.inf
        best = int(np.argmin(expected))
        for one in (*own, *pairs.values()):
            one.add(best)
        chosen.append(best)
        entropy.append(float(expected[best]))
        if entropy[-1] <= enough:
            break
    return chosen, entropy
