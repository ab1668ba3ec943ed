"""The contents of a recording as short tables (`recordings.info` makes the document), and what was
measured as short lines for a page."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import numpy as np

from parallel_cal.base.units import ARCMIN
from parallel_cal.identification.noise_figures import list_noise
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.registration import SENSOR, frames_of
from parallel_cal.model.model import Model
from parallel_cal.recordings.channels import find_channel, list_channels
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.recording import COORDINATES
from parallel_cal.reporting.blocks import Block, Table
from parallel_cal.reporting.readable import (
    format_fixed_vector,
    vector,
    with_unit,
    write_micro,
)


def describe_info(document: dict[str, Any]) -> Iterator[Block]:
    """Describe the document as short tables and sentences, in units for people."""
    duration = document["duration"]
    size = "samples" if duration is None else f"{duration:.1f} s"
    yield f"{document['source']}: {size}, sha256 {document['sha256'][:12]}"
    if document["topics"]:
        yield _topic_table(document)
    yield _joint_table(document)
    yield _sample_sentence(document)
    for reason, count in document["dropped"].items():
        first = next(d for d in document["dropped_list"] if d["reason"] == reason)
        yield f"  dropped {count}: {reason}; first at {first['time']:.2f} s: {first['detail']}"
    names = list_channels("condition", among=document["conditions"])
    units = {name: channel.unit for name in names if (channel := find_channel(name))}
    units["time"] = "s"
    for name, unit in units.items():
        if span := document["conditions"].get(name):
            yield f"{name}: {span['min']:.2f} to {span['max']:.2f} {unit}"
    for kind, noise in document["noise"].items():
        pose, parts = noise["pose"], []
        if any(v is not None for v in pose):
            parts.append(f"position {format_fixed_vector(pose[:3], 1e6, 1)} um")
            parts.append(f"orientation {format_fixed_vector(pose[3:], 1 / ARCMIN, 2)} arcmin")
        if "joint" in noise:
            parts.append(f"joints {format_fixed_vector(noise['joint'], 1e3, 4)} mrad|mm")
        about = f" ({noise['dof']} degrees of freedom)" if "dof" in noise else ""
        label = kind.replace("_", " ")
        if parts:
            yield f"noise {label}, 1 sigma{about}: {', '.join(parts)}"
    for warning in document["warnings"]:
        yield f"warning: {warning}"


def _topic_table(document: dict[str, Any]) -> Table:
    """Make the table of topics with type, count, rate and channel."""
    used = {topic: channel for channel, topic in document["channels"].items() if topic}
    rows = [
        (
            t["name"],
            t["type"],
            str(t["count"]),
            f"{t['rate']:.1f}" if t["rate"] else "-",
            used.get(t["name"], ""),
        )
        for t in document["topics"]
    ]
    return Table(("topic", "type", "count", "rate [Hz]", "used for"), rows)


def _joint_table(document: dict[str, Any]) -> Table:
    """Make the table of joints and their ranges, also in degrees of those that turn. A topic does
    not tell the unit of a joint; a column map, a model file and a set of samples do."""
    rows, header = [], ["joint", "from", "to"]
    units = {name: span.get("unit", "rad|m") for name, span in document["joints"].items()}
    turn = [name for name, unit in units.items() if unit != "m"]
    if turn:
        header.append("in degrees" if "rad|m" not in units.values() else "(if revolute)")
    for name, span in document["joints"].items():
        low, high, unit = span["min"], span["max"], units[name]
        row = [name, f"{low:.4f} {unit}", f"{high:.4f} {unit}"]
        if turn:
            deg = f"{np.degrees(low):.2f} to {np.degrees(high):.2f} deg"
            row.append(deg if name in turn else "")
        rows.append(tuple(row))
    return Table(tuple(header), rows)


def _sample_sentence(document: dict[str, Any]) -> str:
    again = document["replicates"]
    frame = f"frame {document['frame']}" if document["frame"] else "a frame without a name"
    pose = f"{' '.join(document['measured'])} in {frame}" if document["measured"] else ""
    read = ", ".join(_reading_words(document["readings"]))
    return (
        f"{document['samples']} samples ({document['mode'] or 'none'}) of {document['poses']} "
        f"poses; replicates: {again['samples']} samples of {again['poses']} poses; "
        f"measured: {'; '.join(filter(None, (pose, read))) or 'nothing'}"
    )


def _reading_words(readings: dict[str, int]) -> list[str]:
    """Name the channels with their number of readings; the corners of a board are one entry."""
    corners: dict[str, list[int]] = {}
    words = []
    for name, count in readings.items():
        if found := re.fullmatch(r"(\w+)\.\d+\.([uv])", name):
            corners.setdefault(found[1], []).extend([count] if found[2] == "u" else [])
        else:
            words.append(f"{name} ({count})")
    return words + [
        f"{camera} ({sum(counts)} readings of {len(counts)} corners)"
        for camera, counts in corners.items()
    ]


def describe_measurement(
    model: Model, dataset: Dataset, observations: Observations
) -> dict[str, str]:
    """Describe in a line each: the samples, what the device measured and where it is, the noise."""
    samples = f"{len(dataset)} at {len(np.unique(dataset.pose_id))} poses"
    if dataset.excluded:
        samples += f", {len(dataset.excluded)} excluded"
    axes = np.array(COORDINATES)[dataset.measured.any(axis=0)]
    frame = f"frame {dataset.frame}" if dataset.frame else "the frame of the device"
    device = [f"{' '.join(axes)} in {frame}"] if len(axes) else []
    if SENSOR in (sensor.name for sensor in model.sensors):
        at = vector(frames_of(model).f, "m", 1)
        device.append(f"registered at ({at}) mm in the frame of the base")
    device += [sensor.name.replace("_", " ") for sensor in model.sensors if sensor.name != SENSOR]
    noise = [f"{one.describe(with_unit)} ({one.source})" for one in list_noise(model, observations)]
    return {
        "samples": samples,
        "device": "; ".join(device) or "no pose was measured",
        "noise": write_micro("; ".join(noise)),
    }
