"""Recordings of set-ups without a pose device, as Datasets: `reading.CHANNEL` a sample."""

import numpy as np

from parallel_cal.recordings.dataset import Dataset

JOINTS = ("joint1", "joint2", "joint3")


def dataset(plate, readings, ties):
    """Encoder readings of a tip tied to a plate or a hole in it."""
    channels = {name: np.where(ties == name, 0.0, np.nan) for name in np.unique(ties)}
    return blind(readings, plate.joint, channels)


def blind(q, joint_sigma, channels):
    """Joints and channels; nothing of the pose was measured."""
    n = len(q)
    return Dataset.from_arrays(
        JOINTS,
        q,
        np.zeros((n, 3)),
        measured=np.zeros((n, 6), dtype=bool),
        joint_sigma=[joint_sigma] * 3,
        conditions={f"reading.{name}": values for name, values in channels.items()},
        pose_id=np.arange(n),
        source="virtual plate",
    )
