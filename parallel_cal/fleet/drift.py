"""What of a robot changes from recording to recording: a parameter that grows, or that jumps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from parallel_cal.fleet.population import stack_evidence
from parallel_cal.identification.evidence import Evidence
from parallel_cal.identification.thresholds import RELATIVE_RANK

MIN_RECORDINGS = 3  # recordings: two differ, and nobody knows why


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
    if len(recordings) < MIN_RECORDINGS or not np.ptp(times):
        return None
    from scipy.stats import f

    span = float(np.ptp(times))
    among = _RecordingDifferences.of(recordings)
    k, rate, sigma, gain, told = among.change((np.asarray(times) - np.mean(times)) / span)
    dof = (len(recordings) - 1) * among.rank - 1
    scatter = max(1.0, (among.chi2 - gain) / dof) if dof > 0 else 1.0
    p = float(f.sf(gain / scatter, 1, max(dof, 1)))
    return Trend(k, rate / span, sigma * scatter**0.5 / span, gain, min(1.0, p * told))


def jump(recordings: Sequence[Evidence]) -> Jump | None:
    """The one parameter whose change after one of a robot's recordings, from the first to the last,
    explains best how they differ; None of a single one, or where they tell nothing."""
    n, among = len(recordings), _RecordingDifferences.of(recordings)
    if n < 2 or not among.rank:
        return None
    changes = [(among.change((np.arange(n) > i) - 1 + (i + 1) / n), i) for i in range(n - 1)]
    (k, size, sigma, gain, _), after = max(changes, key=lambda one: one[0][3])
    return Jump(k, after, size, sigma, gain, among.chi2, (n - 1) * among.rank)


@dataclass(frozen=True)
class _RecordingDifferences:
    """What a robot's recordings say, information A (N, n, n), and what of their pull is `left`
    (N, n) where all say the same; the `inverse` of all their information."""

    A: np.ndarray
    left: np.ndarray
    inverse: np.ndarray

    @classmethod
    def of(cls, recordings: Sequence[Evidence]) -> _RecordingDifferences:
        A, g = stack_evidence(recordings)
        inverse = _inverse(A.sum(axis=0))
        return cls(A, g - A @ (inverse @ g.sum(axis=0)), inverse)

    @property
    def rank(self) -> int:
        """How many parameters they tell of together."""
        return int(np.linalg.matrix_rank(self.A.sum(axis=0), hermitian=True))

    @property
    def chi2(self) -> float:
        """Of all that they differ by."""
        rows = zip(self.left, self.A, strict=True)
        return sum(float(one @ _inverse(info) @ one) for one, info in rows)

    def change(self, t: np.ndarray) -> tuple[int, float, float, float, int]:
        """The parameter whose change in proportion to t (N,), of mean zero, explains most: its
        number, rate, 1 sigma, by how much chi2 falls, and how many parameters were looked at.

        p(t) = p_0 + rate t e_k with any p_0: the score test of each k.
        """
        first = np.einsum("i,ijk->jk", t, self.A)
        own = np.einsum("i,ijj->j", t**2, self.A)
        own = own - np.einsum("jk,kl,lj->j", first, self.inverse, first)
        score = t @ self.left
        told = own > 1e-9 * max(float(own.max()), 1e-300)
        gain = np.where(told, score**2 / np.where(told, own, 1.0), 0.0)
        k = int(np.argmax(gain))
        weight = max(float(own[k]), 1e-300)
        return k, float(score[k]) / weight, weight**-0.5, float(gain[k]), int(told.sum())


def _inverse(information: np.ndarray) -> np.ndarray:
    return np.linalg.pinv(information, RELATIVE_RANK**2, hermitian=True)
