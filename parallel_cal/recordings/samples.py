"""The Sample, and statistics that dwells and continuous motion share."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.rotation import nearest_rotation
from parallel_cal.recordings.options import SampleOptions
from parallel_cal.recordings.recording import Array, Bools, Dropped, JointStream

# Prefix of a dataset's columns of other sensors than the pose device, in m or px
READING = "reading."


def list_channel_groups(channels: Iterable[str]) -> list[str]:
    """List channels for a message: the many corners of a camera (`camera.12.u`) as one group."""
    groups: dict[str, None] = {}
    for channel in channels:
        sensor, *rest = channel.split(".")
        groups.setdefault(f"the corners of {sensor}" if len(rest) == 2 else channel)
    return list(groups)


@dataclass
class Sample:
    """One sample: joints, pose, measured coordinates and the scatter of single readings.

    `readings` (m) are the readings of other sensors, by channel.
    """

    time: float
    duration: float
    q: Array
    effort: Array
    velocity: Array
    scatter_q: Array
    r: Array
    R: Array
    measured: Bools
    pose_cov: Array
    scatter_pose: Array
    count_q: int
    count_pose: int
    first_reading: int  # of the untrimmed interval; motion before it determines the direction
    readings: dict[str, float] = field(default_factory=dict)
    acceleration: Array | None = None  # None at a standstill


@dataclass
class Samples:
    """The samples, the standstill tolerance (nq,) and what was dropped."""

    mode: str
    kept: list[Sample]
    tolerance: Array
    dropped: list[Dropped]
    warnings: list[str] = field(default_factory=list)


def broadcast_to_joints(value: float | Sequence[float], names: Sequence[str], what: str) -> Array:
    """Return a positive number per joint (nq,) from one number or one per joint."""
    try:
        values = np.atleast_1d(np.asarray(value, float))
    except (TypeError, ValueError):
        values = np.zeros(0)
    if values.shape not in ((1,), (len(names),)) or not (values > 0).all():
        raise DatasetError(
            f"{what}={value}: expected one positive number, or one for each of {', '.join(names)}"
        )
    return np.broadcast_to(values, (len(names),)).copy()


def max_gap(joints: JointStream, options: SampleOptions) -> float:
    """Return the longest gap in s between joint messages of one sample."""
    if options.max_gap is not None:
        return options.max_gap
    return max(0.5, 5.0 * joints.period)


def mean_rotation(R: Array) -> Array:
    """Return the chordal mean (3, 3) of rotations (n, 3, 3)."""
    return nearest_rotation(R.mean(axis=0))


def sample_sd(values: Array) -> Array:
    """Return the sample standard deviation per column; NaN for a single row."""
    if len(values) < 2:
        return np.full(values.shape[1], np.nan)
    return values.std(axis=0, ddof=1)


def slope(time: Array, values: Array) -> Array:
    """Return the mean velocity: the slope of the line through the readings."""
    t = time - time.mean()
    return t @ values / max(float(t @ t), 1e-300)
