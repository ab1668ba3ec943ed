"""The sample file: JSON, SI units, null for a number that was not measured.

Reading checks every column, because the users of a Dataset rely on its shapes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.files import MEGABYTE, read_text
from parallel_cal.base.float_fields import UNCONVERTED, find_unconverted
from parallel_cal.recordings.recording import Dropped

FILE_VERSION = 1
PER_SAMPLE = (
    "q",
    "r",
    "R",
    "measured",
    "pose_cov",
    "time",
    "duration",
    "scatter_q",
    "scatter_pose",
    "count_q",
    "count_pose",
    "pose_id",
)
SAMPLES_SUFFIX = ".json"
MAX_SAMPLE_FILE_BYTES = 512 * MEGABYTE  # a million samples
NULLABLE_FIELDS = ("pose_cov", "scatter_q", "scatter_pose")  # null if the device does not state it
OPTIONAL_FIELDS = ("joint_units", "recordings", "excluded", "sides_from_order", "names")
MAX_ORTHOGONALITY_ERROR = 1e-6  # largest difference of an entry of R R^T from the identity


def holds_samples(path: Path) -> bool:
    """Return whether a path is a sample file: by its suffix .json, else by its first byte."""
    if path.suffix == SAMPLES_SUFFIX or not path.is_file():
        return path.suffix == SAMPLES_SUFFIX
    with path.open("rb") as stream:
        return stream.read(1) == b"{"


def read_document(path: Path) -> dict[str, Any]:
    """Return the JSON document of a sample file; DatasetError if it is not one."""
    try:
        document = json.loads(read_text(path, MAX_SAMPLE_FILE_BYTES))
    except OSError as error:
        raise DatasetError(f"{path}: cannot read samples: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise DatasetError(
            f"{path}: cannot read samples: {error}. The file seems truncated or "
            "damaged: save the samples again, or copy the file again"
        ) from None
    version = document.get("parallel_cal_samples") if isinstance(document, dict) else None
    if version != FILE_VERSION:
        raise DatasetError(
            f"{path}: parallel_cal_samples is {version}; expected {FILE_VERSION}. "
            "Save the samples again with this version."
        )
    return document


def is_expected(name: str, document: Mapping[str, Any]) -> bool:
    """Return whether a document must contain a field; files of older versions lack some."""
    return name in document or name not in OPTIONAL_FIELDS


def restore_field(name: str, document: Mapping[str, Any]) -> Any:
    """Return a field of the document with its type and shape; DatasetError names a wrong key."""
    try:
        value = _convert_field(name, document)
    except KeyError:
        raise DatasetError(f"the key '{name}' is missing") from None
    except (TypeError, ValueError, AttributeError, OverflowError):
        raise DatasetError(
            f"{name} is not of the type and shape that a sample file needs"
        ) from None
    if name in PER_SAMPLE:
        _check_column(name, value, len(document["time"]))
    if name == "conditions":
        for key, column in value.items():
            _check_length(f"conditions.{key}", column, len(document["time"]))
    if name == "sides_from_order" and not isinstance(value, bool):
        raise DatasetError(f"sides_from_order is {value}: expected true or false")
    if name == "joint_names":
        good = isinstance(value, tuple) and all(isinstance(n, str) for n in value)
        if not good or not value or len(set(value)) < len(value):
            raise DatasetError(f"joint_names are {value}: expected a name for each joint")
    if name == "joint_units" and value is not None:
        joints = len(document["joint_names"])
        if len(value) != joints or not {*value} <= {"rad", "m"}:
            raise DatasetError(f"joint_units are {value}: expected rad or m for {joints} joints")
    if name == "joint_sigma" and value is not None:
        joints = len(document["joint_names"])
        if value.shape != (joints,) or not (value > 0).all():
            raise DatasetError(f"joint_sigma is {value}: expected {joints} numbers above 0")
    return value


def _check_column(name: str, column: np.ndarray, n: int) -> None:
    _check_length(name, column, n)
    flat = column.reshape(n, -1)
    if name not in NULLABLE_FIELDS and not np.isfinite(flat).all():
        i = int(np.argmin(np.isfinite(flat).all(axis=1)))
        raise DatasetError(f"{name} of sample {i} is null: expected numbers")
    if name in ("q", "r") and (at := find_unconverted(column)) is not None:
        shown = " ".join(f"{v:.4g}" for v in flat[at])
        raise DatasetError(f"{name} of sample {at} is {shown}: {UNCONVERTED}")
    if name == "R" and n:
        off = np.abs(column @ np.swapaxes(column, 1, 2) - np.eye(3)).max(axis=(1, 2))
        mirrored = np.linalg.det(column) < 0
        bad = (off > MAX_ORTHOGONALITY_ERROR) | mirrored
        if bad.any():
            i = int(np.argmax(bad))
            how = (
                "it is a reflection: its determinant is -1"
                if mirrored[i]
                else "it is not orthogonal"
            )
            raise DatasetError(f"R of sample {i} is not a rotation: {how}")


def _check_length(name: str, column: np.ndarray, n: int) -> None:
    if column.ndim < 1 or len(column) != n:
        raise DatasetError(f"{name} has {np.shape(column)[:1]} entries; time has {n}")


def _convert_field(name: str, document: Mapping[str, Any]) -> Any:
    if name == "configuration":  # files of older versions have none
        return {key: float(number) for key, number in document.get(name, {}).items()}
    value = document[name]
    if name in ("excluded", "names"):
        return {int(number): str(text) for number, text in value.items()}
    if name in ("count_q", "count_pose", "pose_id"):
        return np.array(value, np.int64)
    if name == "measured":
        if np.array(value).dtype != bool:
            raise ValueError
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
