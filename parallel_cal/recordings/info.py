"""What a recording holds and what of it can be used, before any model is involved."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.recordings.bag import list_topics, read_bag
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.loading import dataset_from_recording, make_options
from parallel_cal.recordings.recording import COORDINATES, Dropped, Progress, Recording, Topics
from parallel_cal.recordings.samplefile import holds_samples
from parallel_cal.recordings.samples import READING

if TYPE_CHECKING:
    from rich.console import Console

ARCMIN = np.pi / 180 / 60


def info(
    path: str | Path,
    *,
    topics: Topics | None = None,
    joints: Sequence[str] | None = None,
    measures: Sequence[str] | None = None,
    stamps: str = "header",
    exclude: Sequence[int] = (),
    progress: Progress | None = None,
    **options: Any,
) -> dict[str, Any]:
    """Everything worth knowing about a recording as one JSON-able document, all values SI.

    Doubtful units and a recording without usable samples are warnings here; only a recording
    that cannot be read is a BagError.
    """
    if holds_samples(Path(path)):
        return info_of(Dataset.from_json(path).excluding(exclude))
    recording = read_bag(
        path, topics, joints=joints, measures=measures, stamps=stamps, progress=progress
    )
    duration = list_topics(path)[1]
    chosen = dataclasses.replace(make_options(**options), assume_units=True)
    document = _recording_part(recording, duration)
    try:
        dataset = dataset_from_recording(recording, chosen)
    except DatasetError as error:
        return document | _nothing_usable(recording, str(error))
    return document | _dataset_part(dataset.excluding(exclude))


def info_of(dataset: Dataset) -> dict[str, Any]:
    """The same of samples that are no recording (any more): no topics, no duration."""
    return {
        "source": dataset.source,
        "sha256": dataset.sha256,
        "duration": None,
        "frame": dataset.frame,
        "topics": [],
        "channels": {},
        "joints": _joint_ranges(dataset.joint_names, dataset.q),
        "measured": [COORDINATES[i] for i in np.flatnonzero(dataset.measured.any(axis=0))],
        **_dataset_part(dataset),
    }


def _recording_part(recording: Recording, duration: float) -> dict[str, Any]:
    """Topics, channels, joints and conditions as recorded."""
    channels: dict[str, Any] = {
        "joints": recording.joints,
        "pose": recording.pose,
        "temperature": recording.temperature,
        "payload": recording.payload,
        "constraint": recording.constraint,
        **{f"distance {name}": gauge for name, gauge in recording.distances.items()},
    }
    return {
        "source": recording.source,
        "sha256": recording.sha256,
        "duration": duration,
        "frame": recording.pose.frame,
        "topics": [
            {
                "name": t.name,
                "type": t.type,
                "count": t.count,
                "rate": t.count / duration if t.count > 1 and duration > 0 else None,
            }
            for t in recording.topics
        ],
        "channels": {name: (c.topic or None) if c else None for name, c in channels.items()},
        "joints": _joint_ranges(recording.joints.names, recording.joints.position),
        "measured": [COORDINATES[i] for i in np.flatnonzero(recording.pose.measured.any(axis=0))],
    }


def _joint_ranges(names: Sequence[str], q: np.ndarray) -> dict[str, dict[str, float]]:
    """Least and greatest reading of each joint, in rad or m."""
    low, high = q.min(axis=0).tolist(), q.max(axis=0).tolist()
    return {name: {"min": low[j], "max": high[j]} for j, name in enumerate(names)}


def _nothing_usable(recording: Recording, why: str) -> dict[str, Any]:
    """The rest of the document for a recording without samples."""
    return {
        "mode": None,
        "samples": 0,
        "poses": 0,
        "dropped": _grouped(recording.dropped),
        "dropped_list": _listed(recording.dropped),
        "replicates": {"poses": 0, "samples": 0},
        "conditions": {},
        "readings": {},
        "noise": {},
        "warnings": [*recording.notes, why],
    }


def _dataset_part(dataset: Dataset) -> dict[str, Any]:
    """Samples kept and dropped, replicates, conditions, noise, warnings."""
    visits = np.bincount(dataset.pose_id, minlength=1)
    repeated = int((visits > 1).sum())
    return {
        "mode": dataset.mode,
        "samples": len(dataset),
        "poses": int((visits > 0).sum()),
        "dropped": _grouped(dataset.dropped),
        "dropped_list": _listed(dataset.dropped),
        "replicates": {"poses": repeated, "samples": int(visits[visits > 1].sum())},
        "conditions": {
            name: {"min": float(values.min()), "max": float(values.max())}
            for name, values in dataset.conditions.items()
            if len(values) and not name.startswith(READING)
        },
        "readings": {
            name.removeprefix(READING): int(np.isfinite(values).sum())
            for name, values in dataset.conditions.items()
            if name.startswith(READING)
        },
        "noise": _noise(dataset),
        "warnings": list(dataset.warnings) + _thin_conditions(dataset),
    }


def _noise(dataset: Dataset) -> dict[str, Any]:
    """Typical 1-sigma scatter: of single readings, between replicates, and as the device states."""
    noise = dataset.replicate_noise()
    with np.errstate(invalid="ignore"):
        stated = np.sqrt(np.diagonal(dataset.pose_cov, axis1=1, axis2=2))
    return {
        "within_dwell": {
            "joint": _medians(dataset.scatter_q),
            "pose": _medians(dataset.scatter_pose),
        },
        "between_replicates": {
            "joint": _numbers(noise.joint),
            "pose": _numbers(noise.pose),
            "dof": noise.dof,
        },
        "stated": {"pose": _medians(stated)},
    }


def _medians(values: np.ndarray) -> list[float | None]:
    """Median per column of the numbers there are."""
    columns = [column[np.isfinite(column)] for column in values.T]
    return [float(np.median(column)) if len(column) else None for column in columns]


def _numbers(values: np.ndarray) -> list[float | None]:
    return [float(v) if np.isfinite(v) else None for v in values]


def _thin_conditions(dataset: Dataset) -> list[str]:
    """What the recording cannot tell because it never varied or was never repeated."""
    said = []
    if dataset.mode == "dwell" and len(np.unique(dataset.pose_id)) == len(dataset) > 1:
        said.append("no pose was visited twice: noise cannot be told from missing effects")
    for name in dataset.joint_names:
        ways = set(dataset.conditions.get(f"direction.{name}", np.zeros(0)).tolist()) - {0.0}
        if len(ways) == 1:
            said.append(f"{name} was always approached from one side: backlash cannot be seen")
    return said


def _grouped(dropped: Sequence[Dropped]) -> dict[str, int]:
    """Reason -> how many, most frequent first."""
    counts: dict[str, int] = {}
    for item in dropped:
        counts[item.reason] = counts.get(item.reason, 0) + item.count
    return dict(sorted(counts.items(), key=lambda pair: -pair[1]))


def _listed(dropped: Sequence[Dropped]) -> list[dict[str, Any]]:
    return [
        {"time": d.time, "reason": d.reason, "detail": d.detail, "count": d.count} for d in dropped
    ]


# ---- for people --------------------------------------------------------------------------------


def print_info(document: dict[str, Any], console: Console) -> None:
    """Print the document as short tables, in units for people."""
    duration = document["duration"]
    kind = "samples" if duration is None else f"{duration:.1f} s"
    console.print(f"{document['source']}: {kind}, sha256 {document['sha256'][:12]}")
    if document["topics"]:
        console.print(_topic_table(document))
    console.print(_joint_table(document))
    console.print(_sample_sentence(document))
    _print_dropped(document, console)
    _print_conditions(document["conditions"], console)
    _print_noise(document, console)
    for warning in document["warnings"]:
        console.print(f"[yellow]warning:[/yellow] {_escaped(warning)}", highlight=False)


def _print_dropped(document: dict[str, Any], console: Console) -> None:
    """How many were dropped for each reason, and the first of them."""
    for reason, count in document["dropped"].items():
        first = next(d for d in document["dropped_list"] if d["reason"] == reason)
        told = f"  dropped {count}: {reason}; at {first['time']:.2f} s: {first['detail']}"
        console.print(_escaped(told), highlight=False)


def _escaped(text: str) -> str:
    from rich.markup import escape

    return escape(text)


def _topic_table(document: dict[str, Any]) -> Any:
    """Topics with type, count, rate and the channel each serves."""
    from rich.table import Table

    table = Table("topic", "type", "messages", "rate", "used for", box=None, pad_edge=False)
    used = {topic: channel for channel, topic in document["channels"].items() if topic}
    for t in document["topics"]:
        rate = f"{t['rate']:.1f} Hz" if t["rate"] else ""
        table.add_row(t["name"], t["type"], str(t["count"]), rate, used.get(t["name"], ""))
    return table


def _joint_table(document: dict[str, Any]) -> Any:
    """Joints with their range; a joint's kind is unknown here, so both readings are given."""
    from rich.table import Table

    table = Table("joint", "from", "to", "(if revolute)", box=None, pad_edge=False)
    for name, span in document["joints"].items():
        low, high = span["min"], span["max"]
        degrees = f"{np.degrees(low):.2f} to {np.degrees(high):.2f} deg"
        table.add_row(name, f"{low:.4f} rad|m", f"{high:.4f} rad|m", degrees)
    return table


def _sample_sentence(document: dict[str, Any]) -> str:
    again = document["replicates"]
    frame = document["frame"] or "no frame_id"
    pose = f"{' '.join(document['measured'])} in frame {frame}" if document["measured"] else ""
    read = ", ".join(f"{name} ({count})" for name, count in document["readings"].items())
    return (
        f"{document['samples']} samples ({document['mode'] or 'none'}) of {document['poses']} "
        f"poses; {again['poses']} poses visited again ({again['samples']} samples); "
        f"measured: {'; '.join(filter(None, (pose, read))) or 'nothing'}"
    )


def _print_conditions(conditions: dict[str, dict[str, float]], console: Console) -> None:
    units = {"temperature": "degC", "payload": "kg", "time": "s"}
    for name, unit in units.items():
        if name in conditions:
            span = conditions[name]
            console.print(f"{name}: {span['min']:.2f} to {span['max']:.2f} {unit}", highlight=False)


def _print_noise(document: dict[str, Any], console: Console) -> None:
    """Scatter of position in um, of orientation in arcmin, of joints in their own unit."""
    for kind, noise in document["noise"].items():
        pose = noise["pose"]
        parts = []
        if any(v is not None for v in pose):
            parts.append(f"position {_triple(pose[:3], 1e-6, '.1f')} um")
            parts.append(f"orientation {_triple(pose[3:], ARCMIN, '.2f')} arcmin")
        if "joint" in noise:
            parts.append(f"joints {_triple(noise['joint'], 1e-3, '.4f')} mrad|mm")
        about = f" ({noise['dof']} degrees of freedom)" if "dof" in noise else ""
        label = kind.replace("_", " ")
        if parts:
            console.print(f"noise {label}, 1 sigma{about}: {', '.join(parts)}", highlight=False)


def _triple(values: list[float | None], unit: float, form: str) -> str:
    return " ".join("-" if v is None else format(v / unit, form) for v in values)
