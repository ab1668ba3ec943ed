"""Tests that need no model of the robot: is there structure in these residuals?"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from parallel_cal.diagnosis.thresholds import (
    ENOUGH_COPIES,
    MIN_PERMUTATION_P,
    NEIGHBOURS,
    PERMUTATIONS,
)
from parallel_cal.recordings.replicates import average_groups

MAX_PLACES_WITHOUT_TREE = 500  # with fewer, the distances of all pairs take less than the import


def morans_i(
    field: np.ndarray, places: np.ndarray, group: np.ndarray, seed: int = 0
) -> tuple[float, float]:
    """Moran's I = sum w_ij f_i . f_j / sum f_i . f_i on nearest neighbours, and its p-value.

    field (N, k) and places (N, d) of every sample; p (one-sided: neighbours alike) by permuting
    the samples. Visits of one pose (`group`) are averaged: they are no neighbours but copies. The
    mean of many visits has less noise than one visit, so f is the mean times the root of their
    number: only then may the samples be permuted.
    """
    field = average_groups(field - field.mean(axis=0), group)
    field *= np.sqrt(np.unique(group, return_counts=True)[1])[:, None]
    places, n = average_groups(places, group), len(field)
    if n < NEIGHBOURS + 3 or not np.any(field):
        return 0.0, 1.0
    near, total = nearest(places, NEIGHBOURS).T, NEIGHBOURS * np.sum(field**2)
    rng = np.random.default_rng(seed)

    def index(order: np.ndarray) -> float:
        drawn = field[order]
        return float(np.vdot(drawn, drawn.take(near, axis=0).sum(axis=0)) / total)

    seen = index(np.arange(n))
    p = permutation_p_values([seen], ([index(rng.permutation(n))] for _ in range(PERMUTATIONS)))
    return seen, float(p[0])


def permutation_p_values(seen: Sequence[float], drawn: Iterable[Sequence[float]]) -> np.ndarray:
    """Probability that chance alone gives statistics (k,) as large as those `seen`.

    `drawn` are the statistics of copies with permuted samples. Once ENOUGH_COPIES are as large, no
    more are drawn (Besag and Clifford 1991). If none is, the probability is that of the Pearson
    type III distribution with the mean, variance and skewness of the copies (Mielke and Berry
    2007), which may be far smaller than one over their number.
    """
    copies, reached = list[Sequence[float]](), np.zeros(len(seen), dtype=int)
    for one in drawn:
        copies.append(one)
        reached += np.asarray(one) >= seen
        if reached.min() >= ENOUGH_COPIES:
            return reached / len(copies)
    p = (1 + reached) / (1 + len(copies))
    if (beyond := reached == 0).any():
        from scipy.special import gammaincc

        centre, spread = np.mean(copies, axis=0), np.maximum(np.std(copies, axis=0), 1e-300)
        skewness = np.mean(((copies - centre) / spread) ** 3, axis=0)
        shape = 4 / np.maximum(skewness, 1e-3) ** 2
        tail = gammaincc(shape, shape + (seen - centre) / spread * np.sqrt(shape))
        p[beyond] = np.clip(tail, MIN_PERMUTATION_P, p)[beyond]
    return p


def nearest(places: np.ndarray, k: int) -> np.ndarray:
    """Indices (N, k) of the nearest others, every coordinate scaled to its spread."""
    scaled = places / np.maximum(places.std(axis=0), 1e-12)
    if len(scaled) > MAX_PLACES_WITHOUT_TREE:
        from scipy.spatial import cKDTree

        _, near = cKDTree(scaled).query(scaled, k + 1)
        # Each place itself comes first, or after others at the same place: put it last.
        last = np.argsort(near == np.arange(len(near))[:, None], axis=1, kind="stable")
        return np.asarray(np.take_along_axis(near, last, axis=1)[:, :k])
    apart = np.linalg.norm(scaled[:, None] - scaled[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    return np.argpartition(apart, k - 1, axis=1)[:, :k]


def runs_test(series: np.ndarray) -> float:
    """p-value of too few changes of sign (Wald-Wolfowitz), k series (N, k) taken together."""
    excess, variance = 0.0, 0.0
    for column in series.T:
        sign = column > np.median(column)
        n1, n2 = int(sign.sum()), int((~sign).sum())
        n = n1 + n2
        if not (n1 and n2):
            continue
        expected = 1 + 2 * n1 * n2 / n
        excess += 1 + np.count_nonzero(sign[1:] != sign[:-1]) - expected
        variance += (expected - 1) * (expected - 2) / (n - 1)
    return normal_below(excess / variance**0.5) if variance > 0 else 1.0


def normal_below(z: float) -> float:
    """Probability that a standard normal number lies below z."""
    from math import erfc, sqrt

    return erfc(-z / sqrt(2)) / 2


def bonferroni_minimum(p_values: Sequence[float]) -> float:
    """The smallest of several p-values, corrected for their number (Bonferroni)."""
    return min(1.0, len(p_values) * min(p_values, default=1.0))
