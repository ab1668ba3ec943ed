"""Find a parameter of a robot that drifts steadily, or that jumps, between its recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from parallel_cal.fleet.population import stack_evidence
from parallel_cal.identification.evidence import Evidence
from parallel_cal.identification.thresholds import RELATIVE_RANK

MIN_RECORDINGS = 3  # for a trend: two recordings cannot distinguish a drift from a jump
MIN_RELATIVE_WEIGHT = 1e-9  # of the largest weight: below it a parameter is not determined


@dataclass(frozen=True)
class Trend:
    """A parameter that changes steadily: `rate` and `sigma` in tolerances/s.

    `gain` is the decrease of chi2; `p_value` is corrected for testing all parameters."""

    parameter: int
    rate: float
    sigma: float
    gain: float
    p_value: float


@dataclass(frozen=True)
class Jump:
    """A parameter that changes between the recordings `after` and `after + 1`.

    `size` and `sigma` are in tolerances; `gain` is the decrease of chi2. `between` is the chi2 of
    all differences between the recordings, with `dof` degrees of freedom."""

    parameter: int
    after: int
    size: float
    sigma: float
    gain: float
    between: float
    dof: int


def trend(recordings: Sequence[Evidence], times: Sequence[float]) -> Trend | None:
    """Find the parameter whose steady change explains best how a robot's recordings differ.

    If the recordings differ by more than this change and the noise, its sigma is enlarged
    accordingly. None if there are fewer than three recordings or if all have the same time.
    """
    if len(recordings) < MIN_RECORDINGS or not np.ptp(times):
        return None
    from scipy.stats import f

    span = float(np.ptp(times))
    among = _RecordingDifferences.of(recordings)
    k, rate, sigma, gain, n_tested = among.find_change((np.asarray(times) - np.mean(times)) / span)
    dof = (len(recordings) - 1) * among.rank - 1
    scatter = max(1.0, (among.chi2 - gain) / dof) if dof > 0 else 1.0
    p = float(f.sf(gain / scatter, 1, max(dof, 1)))
    return Trend(k, rate / span, sigma * scatter**0.5 / span, gain, min(1.0, p * n_tested))


def jump(recordings: Sequence[Evidence]) -> Jump | None:
    """Find the parameter, and the recording after which it changes, that explain best how a
    robot's recordings differ.

    The recordings are in order of time. None if there is one recording only, or if they determine
    no parameter."""
    n, among = len(recordings), _RecordingDifferences.of(recordings)
    if n < 2 or not among.rank:
        return None
    # A step after recording i, of mean zero over all recordings.
    changes = [(among.find_change((np.arange(n) > i) - 1 + (i + 1) / n), i) for i in range(n - 1)]
    (k, size, sigma, gain, _), after = max(changes, key=lambda one: one[0][3])
    return Jump(k, after, size, sigma, gain, among.chi2, (n - 1) * among.rank)


@dataclass(frozen=True)
class _RecordingDifferences:
    """How a robot's N recordings differ: their information A (N, n, n), the `residual` pull (N, n)
    at the parameters that fit all of them, and the `inverse` (n, n) of their total information."""

    A: np.ndarray
    residual: np.ndarray
    inverse: np.ndarray

    @classmethod
    def of(cls, recordings: Sequence[Evidence]) -> _RecordingDifferences:
        A, g = stack_evidence(recordings)
        inverse = _inverse(A.sum(axis=0))
        return cls(A, g - A @ (inverse @ g.sum(axis=0)), inverse)

    @property
    def rank(self) -> int:
        """The number of parameters that the recordings determine together."""
        return int(np.linalg.matrix_rank(self.A.sum(axis=0), hermitian=True))

    @property
    def chi2(self) -> float:
        """The chi2 of all differences between the recordings."""
        rows = zip(self.residual, self.A, strict=True)
        return sum(float(one @ _inverse(info) @ one) for one, info in rows)

    def find_change(self, t: np.ndarray) -> tuple[int, float, float, float, int]:
        """Find the parameter whose change in proportion to t (N,), of mean zero, explains most.

        Returns its number, its rate, 1 sigma of the rate, the decrease of chi2, and the number of
        parameters tested. The score test of p(t) = p_0 + rate t e_k, with any p_0, for each k.
        """
        first = np.einsum("i,ijk->jk", t, self.A)
        weights = np.einsum("i,ijj->j", t**2, self.A)
        weights = weights - np.einsum("jk,kl,lj->j", first, self.inverse, first)
        score = t @ self.residual
        determined = weights > MIN_RELATIVE_WEIGHT * max(float(weights.max()), 1e-300)
        gain = np.where(determined, score**2 / np.where(determined, weights, 1.0), 0.0)
        k = int(np.argmax(gain))
        weight = max(float(weights[k]), 1e-300)
        return k, float(score[k]) / weight, weight**-0.5, float(gain[k]), int(determined.sum())


def _inverse(information: np.ndarray) -> np.ndarray:
    return np.linalg.pinv(information, RELATIVE_RANK**2, hermitian=True)
