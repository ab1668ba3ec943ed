"""The file that samples are saved in: JSON, SI units, null for a number that was not measured."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.recordings.recording import Dropped

FILE_VERSION = 1
PER_SAMPLE = (
    "q", "r", "R", "measured", "pose_cov", "time", "duration", "scatter_q", "scatter_pose",
    "count_q", "count_pose", "pose_id",
)  # fmt: skip


def holds_samples(path: Path) -> bool:
    """Whether a path is a sample file: by its name or, under another one, by its first byte."""
    if path.suffix == ".json" or not path.is_file():
        return path.suffix == ".json"
    with path.open("rb") as stream:
        return stream.read(1) == b"{"


def read_document(path: Path) -> dict[str, Any]:
    """The JSON document of a sample file; DatasetError when it is none."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path}: cannot read samples: {error}") from error
    version = document.get("parallel_cal_samples") if isinstance(document, dict) else None
    if version != FILE_VERSION:
        raise DatasetError(
            f"{path}: parallel_cal_samples is {version}; expected {FILE_VERSION}. "
            "Save the samples again with this version."
        )
    return document


def restored(name: str, document: dict[str, Any]) -> Any:
    """A field from JSON, with the type and shape it had."""
    value = document[name]
    if name in ("count_q", "count_pose", "pose_id"):
        return np.array(value, np.int64)
    if name == "measured":
        return np.array(value, bool).reshape(-1, 6)
    if name in PER_SAMPLE:
        tail = {"r": (3,), "R": (3, 3), "pose_cov": (6, 6), "scatter_pose": (6,)}
        joints = (len(document["joint_names"]),)
        shape = tail.get(name, joints if name in ("q", "scatter_q") else ())
        return np.array(value, float).reshape(len(document["time"]), *shape)
    if name == "joint_sigma":
        return None if value is None else np.array(value, float)
    if name == "conditions":
        return {key: np.array(item, float) for key, item in value.items()}
    if name == "dropped":
        return tuple(Dropped(**item) for item in value)
    return tuple(value) if isinstance(value, list) else value
