"""Compare measured poses with predicted ones as both arrive. This module does not use ROS."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque

import numpy as np

# Poses that wait for one another: a minute at 100 Hz. On a busy computer one of the two streams may
# arrive seconds after the other.
MAX_WAITING_POSES = 6000
# A measured pose between two predictions that are further apart than this multiple of the usual
# interval is not compared: predictions between them are lost, and the robot may have moved.
MAX_GAP_FACTOR = 3.0
INTERVALS = 51  # intervals between predictions whose median is the usual one


class LiveErrors:
    """Interpolates predictions at the times of measured poses.

    Examples
    --------
    >>> errors = LiveErrors()
    >>> for t in (0.0, 0.01, 0.02):
    ...     _ = errors.add_predicted(t, np.array([t, 0.0, 0.0]))
    >>> [round(error, 6) for error in errors.add_measured(0.015, np.array([0.015, 0.0, 0.001]))]
    [0.001]
    """

    def __init__(self) -> None:
        self._predicted: deque[tuple[float, np.ndarray]] = deque(maxlen=MAX_WAITING_POSES)
        self._waiting: deque[tuple[float, np.ndarray]] = deque(maxlen=MAX_WAITING_POSES)

    def add_predicted(self, time: float, position: np.ndarray) -> list[float]:
        """Take a prediction (s, m); return the position errors that can now be told, m."""
        self._predicted.append((time, position))
        return self._compare()

    def add_measured(self, time: float, position: np.ndarray) -> list[float]:
        """Take a measured position (s, m); return the position errors that can now be told, m."""
        self._waiting.append((time, position))
        return self._compare()

    def _compare(self) -> list[float]:
        errors = []
        while self._waiting and self._predicted and self._waiting[0][0] <= self._predicted[-1][0]:
            at, measured = self._waiting.popleft()
            k = bisect_left(self._predicted, at, key=lambda one: one[0])
            if k == 0:
                continue
            (t0, r0), (t1, r1) = self._predicted[k - 1], self._predicted[k]
            latest = range(max(len(self._predicted) - INTERVALS - 1, 0), len(self._predicted))
            usual = float(np.median(np.diff([self._predicted[i][0] for i in latest])))  # s
            if t1 - t0 <= MAX_GAP_FACTOR * usual:
                predicted = r0 + (r1 - r0) * (at - t0) / (t1 - t0)
                errors.append(float(np.linalg.norm(measured - predicted)))
        return errors
