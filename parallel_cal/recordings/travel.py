"""The travel of a joint: its signed distance since the last reversal."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from parallel_cal.recordings.recording import Array


def travel(
    q: Array,
    at: Sequence[int],
    level: Array,
    direction: NDArray[np.int64],
    threshold: Array,
) -> Array:
    """Return the signed distance (N, nq) from each joint's last reversal to the sample's `level`.

    `direction` (N, nq) is the direction of the last motion, from `dwells.approach`. A motion back
    by at most `threshold` (nq,) is noise, not a reversal. 0 if the joint never moved.
    """
    distance = np.zeros(level.shape)
    for i, end in enumerate(at):
        for j in np.flatnonzero(direction[i]):
            sign = direction[i, j]
            distance[i, j] = sign * _since_reversal(q[:end, j], level[i, j], sign, threshold[j])
    return distance


def _since_reversal(q: Array, level: float, direction: int, threshold: float) -> float:
    """Return how far the joint was behind its `level` at its last reversal before the end of `q`.

    Look back in growing steps: back in time, the distance grows until the reversal and then shrinks
    again.
    """
    step = 256
    while True:
        behind = direction * (level - q[-step:][::-1])
        furthest = np.maximum.accumulate(behind)
        nearer = np.flatnonzero(behind < furthest - threshold)
        if len(nearer):
            return float(furthest[nearer[0]])
        if step >= len(q):
            return float(furthest[-1])
        step *= 4
