"""What of a robot changes from recording to recording: a parameter that grows, or that jumps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from parallel_cal.fleet.population import stacked
from parallel_cal.identification.evidence import Evidence
from parallel_cal.identification.thresholds import RELATIVE_RANK

LEAST = 3  # recordings: two differ, and nobody knows why


@dataclass(frozen=True)
class Trend:
    """A parameter that grows: by how much a second (tolerances/s), 1 sigma, by how much that lowers
    chi2, and the p-value for having looked at all parameters."""

    parameter: int
    rate: float
    sigma: float
    gain: float
    p_value: float


@dataclass(frozen=True)
class Jump:
    """A parameter that changes from one recording to the next, by their number: by how much
    (tolerances), 1 sigma, and by how much that lowers chi2; `between` is the chi2 of all that the
    recordings differ by, with its degrees of freedom."""

    parameter: int
    after: int
    size: float
    sigma: float
    gain: float
    between: float
    dof: int


def trend(recordings: Sequence[Evidence], times: Sequence[float]) -> Trend | None:
    """The one parameter whose steady change explains best how a robot's recordings differ.

    What the recordings differ by beside it makes the sigma larger where it is more than noise. None
    where the recordings are fewer than three, or all of one time.
    """
    if len(recordings) < LEAST or not np.ptp(times):
        return None
    from scipy.stats import f

    span = float(np.ptp(times))
    k, rate, sigma, gain, told = _change(recordings, (np.asarray(times) - np.mean(times)) / span)
    between, rank = _between(recordings)
    dof = (len(recordings) - 1) * rank - 1
    scatter = max(1.0, (between - gain) / dof) if dof > 0 else 1.0
    p = float(f.sf(gain / scatter, 1, max(dof, 1)))
    return Trend(k, rate / span, sigma * scatter**0.5 / span, gain, min(1.0, p * told))


def jump(recordings: Sequence[Evidence]) -> Jump | None:
    """The one parameter whose change after one of a robot's recordings, from the first to the last,
    explains best how they differ; None of a single one, or where they tell nothing."""
    n, (between, rank) = len(recordings), _between(recordings)
    if n < 2 or not rank:
        return None
    changes = [(_change(recordings, (np.arange(n) > i) - 1 + (i + 1) / n), i) for i in range(n - 1)]
    (k, size, sigma, gain, _), after = max(changes, key=lambda one: one[0][3])
    return Jump(k, after, size, sigma, gain, between, (n - 1) * rank)


def _change(recordings: Sequence[Evidence], t: np.ndarray) -> tuple[int, float, float, float, int]:
    """The parameter whose change in proportion to t (N,), of mean zero, explains most: its number,
    rate, 1 sigma, by how much chi2 falls, and how many parameters were looked at.

    p(t) = p_0 + rate t e_k with any p_0: the score test of each k.
    """
    A, g = stacked(recordings)
    inverse = np.linalg.pinv(A.sum(axis=0), RELATIVE_RANK**2, hermitian=True)
    left = g - A @ (inverse @ g.sum(axis=0))
    first = np.einsum("i,ijk->jk", t, A)
    own = np.einsum("i,ijj->j", t**2, A) - np.einsum("jk,kl,lj->j", first, inverse, first)
    score = t @ left
    told = own > 1e-9 * max(float(own.max()), 1e-300)
    gain = np.where(told, score**2 / np.where(told, own, 1.0), 0.0)
    k = int(np.argmax(gain))
    weight = max(float(own[k]), 1e-300)
    return k, float(score[k]) / weight, weight**-0.5, float(gain[k]), int(told.sum())


def _between(recordings: Sequence[Evidence]) -> tuple[float, int]:
    """chi2 of what recordings differ by, and how many parameters they tell of together."""
    A, g = stacked(recordings)
    whole = A.sum(axis=0)
    left = g - A @ (np.linalg.pinv(whole, RELATIVE_RANK**2, hermitian=True) @ g.sum(axis=0))
    chi2 = sum(
        float(one @ np.linalg.pinv(info, RELATIVE_RANK**2, hermitian=True) @ one)
        for one, info in zip(left, A, strict=True)
    )
    return chi2, int(np.linalg.matrix_rank(whole, hermitian=True))
