"""Cut the calm part out of a standstill, with its readings, poses and constraints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parallel_cal.recordings.dwells import Indices, Interval
from parallel_cal.recordings.options import SampleOptions
from parallel_cal.recordings.readings import readings_between, words_between
from parallel_cal.recordings.recording import Bools, Recording


@dataclass
class Dwell:
    """The calm part of a standstill.

    `readings` and `poses` select its joint readings and pose messages, and `measured` says what the
    poses measure. Messages in `less` measure fewer coordinates and are not used. `held` are the
    constraints of the tip in their order, and `shown` the means of other sensors (m).
    """

    interval: Interval
    start: float
    end: float
    readings: slice
    poses: Indices
    less: Indices
    measured: Bools
    held: list[str]
    shown: dict[str, float]


def make_dwell(recording: Recording, interval: Interval, options: SampleOptions) -> Dwell:
    """Trim an interval: the robot settles at its start, and may leave before its end."""
    joints, pose = recording.joints, recording.pose
    start = joints.time[interval.first] + options.trim_start
    end = joints.time[interval.last] - options.trim_end
    a, b = np.searchsorted(joints.time, [start, end])
    c, d = np.searchsorted(pose.time, [start, end])
    poses = np.arange(c, max(c, d))
    # A coordinate counts as measured if most messages measure it; the others are not used.
    measured = pose.measured[poses].mean(axis=0) > 0.5 if len(poses) else np.zeros(6, bool)
    enough = (pose.measured[poses] | ~measured).all(axis=1)
    readings = slice(int(a), int(max(a, b)))
    held = words_between(recording.constraint, start, end)
    shown = readings_between(recording, start, end)
    return Dwell(
        interval, start, end, readings, poses[enough], poses[~enough], measured, held, shown
    )
