"""What of a robot changes from recording to recording: one parameter that grows with time."""

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
    """A parameter that grows: by how much a second (tolerances/s), 1 sigma, and the p-value for
    having looked at all parameters."""

    parameter: int
    rate: float
    sigma: float
    p_value: float


def trend(recordings: Sequence[Evidence], times: Sequence[float]) -> Trend | None:
    """The one parameter whose steady change explains best how a robot's recordings differ.

    p(t) = p_0 + rate (t - t_0) e_k with any p_0: the score test of each k. What the recordings
    differ by beside it makes the sigma larger where it is more than noise. None where the
    recordings are fewer than three, or all of one time.
    """
    if len(recordings) < LEAST or not np.ptp(times):
        return None
    from scipy.stats import f

    A, g = stacked(recordings)
    span = float(np.ptp(times))
    t = (np.asarray(times) - np.mean(times)) / span
    inverse = np.linalg.pinv(A.sum(axis=0), RELATIVE_RANK**2, hermitian=True)
    mean = inverse @ g.sum(axis=0)
    left = g - A @ mean
    first = np.einsum("i,ijk->jk", t, A)
    own = np.einsum("i,ijj->j", t**2, A) - np.einsum("jk,kl,lj->j", first, inverse, first)
    score = t @ left
    told = own > 1e-9 * max(float(own.max()), 1e-300)
    gain = np.where(told, score**2 / np.where(told, own, 1.0), 0.0)
    k = int(np.argmax(gain))
    rank = int(np.linalg.matrix_rank(A.sum(axis=0), hermitian=True))
    between = sum(
        float(one @ np.linalg.pinv(info, RELATIVE_RANK**2, hermitian=True) @ one)
        for one, info in zip(left, A, strict=True)
    )
    dof = (len(recordings) - 1) * rank - 1
    scatter = max(1.0, (between - gain[k]) / dof) if dof > 0 else 1.0
    p = float(f.sf(gain[k] / scatter, 1, max(dof, 1)))
    rate, sigma = score[k] / own[k] / span, np.sqrt(scatter / own[k]) / span
    return Trend(k, float(rate), float(sigma), min(1.0, p * int(told.sum())))
