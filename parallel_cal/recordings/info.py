"""Describe what a recording contains and how much is usable, without a model."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from parallel_cal.base.arguments import check_arguments
from parallel_cal.base.documents import to_json_value
from parallel_cal.base.errors import DatasetError
from parallel_cal.base.progress import Progress
from parallel_cal.base.threads import single_threaded
from parallel_cal.recordings.bag import list_topics, read_bag
from parallel_cal.recordings.channels import list_channels
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.loading import dataset_from_recording, load_table, select_samples
from parallel_cal.recordings.options import ReadOptions
from parallel_cal.recordings.recording import COORDINATES, Dropped, Recording
from parallel_cal.recordings.samplefile import holds_samples
from parallel_cal.recordings.samples import READING
from parallel_cal.recordings.table import is_table


@check_arguments(DatasetError)
@single_threaded()
def info(
    path: str | Path, options: ReadOptions | None = None, progress: Progress | None = None
) -> dict[str, Any]:
    """Describe what a recording contains and how much of it is usable.

    Parameters
    ----------
    path : str or Path
        A rosbag2 folder or file, or a file of samples.
    options : ReadOptions, optional
    progress : callable, optional
        Called with a stage in words and the completed share (0 to 1).

    Returns
    -------
    dict
        A JSON document in SI units: topics, rates, samples, dropped messages with reasons,
        replicates, noise, warnings. `load_dataset` raises DatasetError for doubtful units and for a
        recording without usable samples; `info` reports both as warnings.

    Raises
    ------
    BagError
        If the recording cannot be read.

    Examples
    --------
    >>> import parallel_cal as pc
    >>> pc.info("bags/delta_backlash")["samples"]
    94
    """
    options = options or ReadOptions()
    if holds_samples(Path(path)):
        return info_of(select_samples(Dataset.from_json(path), options))
    if is_table(Path(path)):
        return info_of(select_samples(load_table(Path(path), options), options))
    recording = read_bag(path, options, progress)
    duration = list_topics(path)[1]
    document = _recording_part(recording, duration)
    try:
        dataset = dataset_from_recording(recording, options.with_values(assume_units=True))
    except DatasetError as error:
        return document | {
            "mode": None,
            "samples": 0,
            "poses": 0,
            **_dropped(recording.dropped),
            "replicates": {"poses": 0, "samples": 0},
            "conditions": {},
            "readings": {},
            "noise": {},
            "warnings": [*recording.notes, str(error)],
        }
    return document | _dataset_part(select_samples(dataset, options))


def info_of(dataset: Dataset) -> dict[str, Any]:
    """Describe samples that are not a recording: without topics and duration."""
    return {
        "source": dataset.source,
        "sha256": dataset.sha256,
        "duration": None,
        "frame": dataset.frame,
        "topics": [],
        "channels": {},
        "joints": _joint_ranges(dataset.joint_names, dataset.q, dataset.joint_units),
        "measured": _coordinates(dataset.measured),
        **_dataset_part(dataset),
    }


def _recording_part(recording: Recording, duration: float) -> dict[str, Any]:
    """Describe topics, channels, joints and measured coordinates as recorded."""
    channels: dict[str, Any] = {
        "joints": recording.joints,
        "pose": recording.pose,
        **{
            name: recording.conditions.get(name)
            for name in list_channels("condition", among=recording.conditions)
        },
        "constraint": recording.constraint,
        **{_channel_name(name): gauge for name, gauge in recording.distances.items()},
        **recording.passive,
    }
    return {
        "source": recording.source,
        "sha256": recording.sha256,
        "duration": duration,
        "frame": recording.pose.frame,
        "topics": [
            vars(t) | {"rate": t.count / duration if t.count > 1 and duration > 0 else None}
            for t in recording.topics
        ],
        "channels": {name: (c.topic or None) if c else None for name, c in channels.items()},
        "joints": _joint_ranges(recording.joints.names, recording.joints.position),
        "measured": _coordinates(recording.pose.measured),
    }


def _channel_name(name: str) -> str:
    """Name a channel of readings; the corners of a board are one channel, their camera."""
    camera, _, corner = name.partition(".")
    return camera if corner.endswith((".u", ".v")) else f"distance {name}"


def _coordinates(measured: np.ndarray) -> list[str]:
    """List the coordinates that any row (n, 6) marks."""
    return np.array(COORDINATES)[measured.any(axis=0)].tolist()


def _joint_ranges(
    names: Sequence[str], q: np.ndarray, units: Sequence[str] | None = None
) -> dict[str, dict[str, Any]]:
    """Return the smallest and largest reading of each joint, in rad or m, and the unit if known."""
    ranges: dict[str, dict[str, Any]] = {
        name: dict(_range(readings)) for name, readings in zip(names, q.T, strict=True)
    }
    for name, unit in zip(names, units or (), strict=False):
        ranges[name]["unit"] = unit
    return ranges


def _range(values: np.ndarray) -> dict[str, float]:
    return {"min": float(values.min()), "max": float(values.max())}


def _dataset_part(dataset: Dataset) -> dict[str, Any]:
    """Describe samples, replicates, conditions, noise and warnings."""
    visits = np.bincount(dataset.pose_id, minlength=1)
    repeated = int((visits > 1).sum())
    warnings = list(dataset.warnings)
    if dataset.mode == "dwell" and len(np.unique(dataset.pose_id)) == len(dataset) > 1:
        warnings.append(
            "no pose was visited twice: noise cannot be distinguished from missing effects"
        )
    for name in dataset.joint_names:
        directions = set(dataset.conditions.get(f"direction.{name}", np.zeros(0)).tolist()) - {0.0}
        if len(directions) == 1:
            warnings.append(
                f"{name} was always approached from one side: backlash cannot be identified"
            )
    return {
        "mode": dataset.mode,
        "samples": len(dataset),
        "poses": int((visits > 0).sum()),
        **_dropped(dataset.dropped),
        "replicates": {"poses": repeated, "samples": int(visits[visits > 1].sum())},
        "conditions": {
            name: _range(values)
            for name, values in dataset.conditions.items()
            if len(values) and not name.startswith(READING)
        },
        "readings": {
            name.removeprefix(READING): int(np.isfinite(values).sum())
            for name, values in dataset.conditions.items()
            if name.startswith(READING)
        },
        "noise": _noise(dataset),
        "warnings": warnings,
    }


def _noise(dataset: Dataset) -> dict[str, Any]:
    """Return the scatter (1 sigma) of readings and of replicates, and what the device states."""
    noise = dataset.replicate_noise()
    with np.errstate(invalid="ignore"):
        stated = np.sqrt(np.diagonal(dataset.pose_cov, axis1=1, axis2=2))
    return {
        "within_dwell": {
            "joint": _medians(dataset.scatter_q),
            "pose": _medians(dataset.scatter_pose),
        },
        "between_replicates": {
            "joint": to_json_value(noise.joint),
            "pose": to_json_value(noise.pose),
            "dof": noise.dof,
        },
        "stated": {"pose": _medians(stated)},
    }


def _medians(values: np.ndarray) -> list[float | None]:
    """Return the median of the finite numbers per column."""
    columns = [column[np.isfinite(column)] for column in values.T]
    return [float(np.median(column)) if len(column) else None for column in columns]


def _dropped(dropped: Sequence[Dropped]) -> dict[str, Any]:
    """Count the dropped messages by reason, most frequent first, and list them."""
    counts = Counter[str]()
    for item in dropped:
        counts[item.reason] += item.count
    return {"dropped": dict(counts.most_common()), "dropped_list": to_json_value(dropped)}
