"""How far a joint has come since it last turned back."""

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
    """Signed way (N, nq) of each joint since its last reversal, up to the sample's `level`.

    `direction` (N, nq) is that of the last motion, as `dwells.approach` tells it; way back by no
    more than `threshold` (nq,) is noise and no reversal. 0 where the joint never moved.
    """
    ways = np.zeros(level.shape)
    for i, end in enumerate(at):
        for j in np.flatnonzero(direction[i]):
            behind = direction[i, j] * (level[i, j] - q[:end, j])
            ways[i, j] = direction[i, j] * _since_reversal(behind, threshold[j])
    return ways


def _since_reversal(behind: Array, threshold: float) -> float:
    """How far `behind` (n,) the readings were at the last reversal; looks back in growing steps.

    Going back in time the joint falls further behind, until it comes nearer again.
    """
    step = 256
    while True:
        back = behind[::-1][:step]
        furthest = np.maximum.accumulate(back)
        nearer = np.flatnonzero(back < furthest - threshold)
        if len(nearer):
            return float(furthest[nearer[0]])
        if step >= len(behind):
            return float(furthest[-1])
        step *= 4
