"""Find standstills by the spread of joint readings, never by their velocity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from parallel_cal.recordings.recording import Array, Bools

Indices = NDArray[np.intp]

# The standstill tolerance is a few times the spread at rest, limited to these shares of the travel.
# Below MIN_TOLERANCE_SHARE, settling would cut dwells short. A calm spread above MAX_CALM_SHARE may
# be slow motion. Above MAX_TOLERANCE_SHARE, it is not noise of a robot that can be calibrated.
MIN_TOLERANCE_SHARE = 2e-5
MAX_CALM_SHARE = 1e-3
MAX_TOLERANCE_SHARE = 5e-2
MIN_READINGS_PER_WINDOW = 8  # with fewer, noise cannot be distinguished from motion


@dataclass(frozen=True)
class Interval:
    """Readings first..last (inclusive) that stay within the tolerance of their median."""

    first: int
    last: int


def still_tolerance(time: Array, q: Array, min_dwell: float) -> Array:
    """Return how far each joint (nq,) may deviate from its median while it stands still.

    Four times the spread of the calmest tenth of all windows of length `min_dwell` (up to 1e-3 of
    the joint's travel), at least 10 sigma of the reading-to-reading noise and 1.5 encoder steps,
    within 2e-5 to 5e-2 of the travel; up to 6 sigma if a window has enough readings to distinguish
    noise from motion. A joint that never moves more than that always stands still.
    """
    if len(time) < 2:
        return np.full(q.shape[1], 1e-12)
    travel = np.ptp(q, axis=0)
    calm = np.quantile(window_spread(time, q, min_dwell), 0.1, axis=0)
    sigma = jitter(time, q, min_dwell)
    noise = noise_span(sigma, q)
    tolerance = np.maximum(noise, np.minimum(4.0 * calm, MAX_CALM_SHARE * travel))
    dense = min_dwell > MIN_READINGS_PER_WINDOW * np.median(np.diff(time))
    ceiling = np.maximum(MAX_TOLERANCE_SHARE * travel, 6.0 * sigma if dense else 0.0)
    tolerance = np.clip(tolerance, MIN_TOLERANCE_SHARE * travel, ceiling)
    rests = travel <= 1.5 * np.maximum(noise, 4.0 * calm)
    return np.where(rests, np.maximum(travel, 1e-12), tolerance)


def window_spread(time: Array, q: Array, length: float) -> Array:
    """Return max - min of readings (m, nq) in the window of `length` s from each reading."""
    last = np.searchsorted(time, time + length, side="right") - 1
    whole = time + length <= time[-1] + 1e-9
    if not whole.any():
        return np.ptp(q, axis=0)[None]
    return _range(q, np.flatnonzero(whole), last[whole])


def _range(q: Array, first: Indices, last: Indices) -> Array:
    """Return max - min of q[first..last] for many windows, from two overlapping blocks of 2^k."""
    spread = np.zeros((len(first), q.shape[1]))
    level = np.frexp(last - first + 1)[1] - 1
    low = high = q
    for k in range(int(level.max(initial=0)) + 1):
        at = level == k
        a, b = first[at], last[at] + 1 - 2**k
        spread[at] = np.maximum(high[a], high[b]) - np.minimum(low[a], low[b])
        step = 2**k
        low, high = np.minimum(low[:-step], low[step:]), np.maximum(high[:-step], high[step:])
    return spread


def jitter(time: Array, q: Array, length: float) -> Array:
    """Return the noise sigma (nq,): rms second difference of the calmest windows."""
    if len(q) < 11:
        return np.zeros(q.shape[1])
    width = int(np.clip(length / np.median(np.diff(time)), MIN_READINGS_PER_WINDOW, len(q) - 3))
    second = q[2:] - 2.0 * q[1:-1] + q[:-2]
    sums = np.cumsum(np.vstack([np.zeros(q.shape[1]), second**2]), axis=0)
    mean = np.maximum(sums[width:] - sums[:-width], 0.0) / width
    return np.sqrt(np.quantile(mean, 0.1, axis=0) / 6.0)


def noise_span(sigma: Array, q: Array) -> Array:
    """Return how far apart (nq,) noise moves readings: 10 sigma or 1.5 encoder steps."""
    return np.maximum(10.0 * sigma, 1.5 * encoder_step(q))


def encoder_step(q: Array) -> Array:
    """Return the smallest step (nq,) of joints that often repeat a reading; 0 for others."""
    change = np.abs(np.diff(q, axis=0))
    repeats = np.sum(change == 0.0, axis=0) > 0.3 * len(change)
    smallest = np.min(np.where(change > 0.0, change, np.inf), axis=0, initial=np.inf)
    return np.where(repeats & np.isfinite(smallest), smallest, 0.0)


def still_intervals(
    time: Array, q: Array, tolerance: Array, shortest: float, max_gap: float
) -> list[Interval]:
    """Return the maximal intervals of at least `shortest` s without motion and without gap."""
    n = len(time)
    if n < 3:
        return []
    last = np.searchsorted(time, time + shortest, side="left")
    last = np.maximum(last, np.arange(n) + 2)
    first = np.flatnonzero(last < n)
    last = last[first]
    gaps = np.concatenate([[0], np.cumsum(np.diff(time) > max_gap)])
    still = (_range(q, first, last) <= tolerance).all(axis=1) & (gaps[last] == gaps[first])
    # Two successive readings belong together if a still window contains both.
    joined = np.zeros(n, np.int64)
    np.add.at(joined, first[still], 1)
    np.add.at(joined, last[still], -1)
    intervals = []
    for a, b in _runs(np.cumsum(joined) > 0):
        intervals += _split(q, a, b + 1, tolerance)
    return [i for i in intervals if time[i.last] - time[i.first] >= 0.999 * shortest]


def find_interruptions(
    time: Array, q: Array, intervals: Sequence[Interval], tolerance: Array, min_dwell: float
) -> Bools:
    """Mark the odd readings (n,) that cut a standstill in two.

    They lie between two intervals at the same level, and are too few or too short for a motion
    there and back: fewer than three readings, or less time than a third of `min_dwell`.
    """
    odd = np.zeros(len(time), bool)
    level = [np.median(q[i.first : i.last + 1], axis=0) for i in intervals]
    for k, (a, b) in enumerate(pairwise(intervals)):
        lapse, count = time[b.first] - time[a.last], b.first - a.last - 1
        brief = lapse < min_dwell / 3 or (count < 3 and lapse < min_dwell)
        if brief and (np.abs(level[k + 1] - level[k]) <= tolerance).all():
            odd[a.last + 1 : b.first] = True
    return odd


def _runs(flags: ArrayLike) -> list[tuple[int, int]]:
    """Return first and last index of every run of True."""
    edges = np.diff(np.concatenate([[0], np.asarray(flags, int), [0]]))
    starts, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1
    return list(zip(starts.tolist(), ends.tolist(), strict=True))


def _split(q: Array, first: int, last: int, tolerance: Array) -> list[Interval]:
    """Cut a calm stretch into intervals within the tolerance of their own median.

    A stretch is longer than one dwell if the robot moved slowly from one to the next.
    """
    done, pending = [], [(first, last)]
    while pending:
        a, b = pending.pop()
        if b - a < 2:
            continue
        part = q[a : b + 1]
        near = np.all(np.abs(part - np.median(part, axis=0)) <= tolerance, axis=1)
        runs = _runs(near)
        if not runs:  # no reading is near the median in all joints
            pending += [(a, (a + b) // 2), ((a + b) // 2 + 1, b)]
            continue
        i, j = max(runs, key=lambda run: run[1] - run[0])
        done.append(Interval(a + i, a + j))
        pending += [(a, a + i - 1), (a + j + 1, b)]
    return sorted(done, key=lambda interval: interval.first)


def drift(q: Array) -> Array:
    """Return how far readings (n, nq) moved from the first to the last third of an interval."""
    third = max(1, len(q) // 3)
    return q[-third:].mean(axis=0) - q[:third].mean(axis=0)


def approach(q: Array, at: Sequence[int], level: Array, threshold: Array) -> NDArray[np.int64]:
    """Return the direction (N, nq) in -1 0 1 of each joint's last motion before reading `at` (N,).

    Going back in time, the first reading further than `threshold` from the sample's `level` (N, nq)
    determines the direction; 0 if the joint never moved that far.
    """
    direction = np.zeros(level.shape, np.int64)
    for i, end in enumerate(at):
        for j in range(q.shape[1]):
            direction[i, j] = _came_from(q[:end, j], level[i, j], threshold[j])
    return direction


def _came_from(before: Array, level: float, threshold: float) -> int:
    """Return the sign of the last motion, which is mostly recent: look back in growing steps."""
    end, step = len(before), 256
    while end > 0:
        begin = max(0, end - step)
        far = np.flatnonzero(np.abs(before[begin:end] - level) > threshold)
        if len(far):
            return int(np.sign(level - before[begin + far[-1]]))
        end, step = begin, 4 * step
    return 0
