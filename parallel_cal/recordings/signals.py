"""What one sample was made of: the readings around its dwell, as they were recorded."""

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

MARGIN_S = 1.0  # s before and after the dwell


@dataclass(frozen=True)
class Signals:
    """Readings around one sample: times (s) from its middle, joints (n, nq) rad or m, measured
    positions (m, 3) m, both minus the sample's own; `duration` s of the dwell."""

    joint_names: tuple[str, ...]
    time: Array
    joints: Array
    pose_time: Array
    position: Array
    duration: float


def signals(
    dataset: Dataset, number: int, paths: Sequence[str | Path], options: ReadOptions
) -> Signals:
    """Those of a sample of `load_sessions(paths)`; DatasetError where only samples were kept."""
    at = list(dataset.numbers).index(number)
    session = dataset.conditions.get("session", np.zeros(len(dataset))).astype(int)
    path = paths[session[at]]
    if holds_samples(Path(path)):
        raise DatasetError(
            f"{path}: contains samples, not the raw readings from which they were made"
        )
    recording = align_clocks(read_bag(path, options))
    of_it = np.flatnonzero(session == session[at])
    # In a later session time goes on from the one before.
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
