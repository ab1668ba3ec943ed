"""Schedule the next session: blocks of poses, cold, warm and cold again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

BLOCKS = 3
MIN_WARMING_K = 4.0  # K at least between cold and warm: less changes too little
DEFAULT_WAIT_S = 1800.0  # s in which an idle robot cools or a busy one warms up, if not recorded
DEFAULT_POSE_TIME_S = 60.0  # s for a pose, if not recorded


@dataclass(frozen=True)
class Schedule:
    """Blocks of poses after a recording: start (B,) s and temperature (B,) degC of each block, and
    the time for a pose (s).

    The temperature rises and falls again, so that it does not correlate with time.
    """

    begin: np.ndarray
    temperature: np.ndarray
    step: float

    @classmethod
    def after(cls, recorded: Mapping[str, np.ndarray], poses: int) -> Schedule:
        """Schedule between the recorded temperatures, at the recorded rate; each block has room for
        `poses` poses."""
        time = np.sort(np.asarray(recorded.get("time", [0.0])))
        air = np.asarray(recorded.get("temperature", [20.0]))
        lasted = float(time[-1] - time[0])
        step = float(np.median(np.diff(time))) if len(time) > 1 else DEFAULT_POSE_TIME_S
        low, high = float(air.min()), max(float(air.max()), float(air.min()) + MIN_WARMING_K)
        rate = np.ptp(air) / lasted if lasted > 0 and np.ptp(air) >= MIN_WARMING_K / 2 else 0.0
        wait = (high - low) / rate if rate > 0 else max(lasted / 2, DEFAULT_WAIT_S)
        begin = float(time[-1]) + wait * np.arange(1, 4) + poses * step * np.arange(3)
        return cls(begin, np.array([low, high, low]), step)

    def describe(self, blocks: np.ndarray, warm: bool) -> str:
        """Describe how to do it, for poses (n,) in these blocks; `warm`: temperature matters."""
        first, then, last = np.bincount(blocks, minlength=BLOCKS)
        low, high = self.temperature[:2]
        stay = "Leave device and joint zeros unchanged."
        if not warm:
            wait = (self.begin[1] - self.begin[0]) / 60
            return (
                f"Measure blocks of {first}, {then} and {last} poses; start each {wait:.0f} min "
                f"after the one before. {stay}"
            )
        return (
            f"Measure {first} poses at {low:.0f} degC, {then} after the robot has warmed up to "
            f"{high:.0f} degC by its own work, and {last} after it has cooled again. {stay}"
        )
