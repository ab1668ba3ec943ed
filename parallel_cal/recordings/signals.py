"""The recorded readings around the dwell of one sample."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.recordings.bag import read_bag
from parallel_cal.recordings.clocks import align_clocks
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.loading import load_dataset
from parallel_cal.recordings.options import ReadOptions
from parallel_cal.recordings.recording import Array, Bools
from parallel_cal.recordings.samplefile import holds_samples
from parallel_cal.recordings.table import is_table

MARGIN_S = 1.0  # s before and after the dwell


@dataclass(frozen=True)
class Signals:
    """Readings around one sample; times (s) count from its middle.

    `joints` (n, nq) in rad or m and the measured `position` (m, 3) in m are relative to the
    sample's values. `duration` (s) is the length of the dwell.
    """

    joint_names: tuple[str, ...]
    time: Array
    joints: Array
    pose_time: Array
    position: Array
    duration: float


def signals(
    dataset: Dataset, number: int, paths: Sequence[str | Path], options: ReadOptions
) -> Signals:
    """Return the signals of a sample of `load_sessions(paths)`; DatasetError for a sample file."""
    at = list(dataset.numbers).index(number)
    session = dataset.conditions.get("session", np.zeros(len(dataset))).astype(int)
    path = paths[session[at]]
    if holds_samples(Path(path)) or is_table(Path(path)):
        raise DatasetError(
            f"{path}: contains samples, not the raw readings from which they were made"
        )
    recording = align_clocks(read_bag(path, options))
    of_it = np.flatnonzero(session == session[at])
    # The time of a session continues from the one before.
    start = 0.0
    if session[at]:
        start = float(dataset.time[of_it[0]] - load_dataset(path, options).time[0])
    middle, duration = float(dataset.time[at]) - start, float(dataset.duration[at])
    order = [recording.joints.names.index(name) for name in dataset.joint_names]

    def near(time: Array) -> Bools:
        return np.asarray(np.abs(time - middle) <= duration / 2 + MARGIN_S)

    joints, poses = near(recording.joints.time), near(recording.pose.time)
    return Signals(
        joint_names=dataset.joint_names,
        time=recording.joints.time[joints] - middle,
        joints=recording.joints.position[joints][:, order] - dataset.q[at],
        pose_time=recording.pose.time[poses] - middle,
        position=recording.pose.position[poses] - dataset.r[at],
        duration=duration,
    )
