"""Several datasets of one robot as one."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.replicates import replicate_ids
from parallel_cal.recordings.samplefile import PER_SAMPLE
from parallel_cal.recordings.samples import READING
from parallel_cal.recordings.sessions import joined_conditions


def joined(parts: Sequence[tuple[Dataset, int]], tolerance: float | None = None) -> Dataset:
    """One dataset of (dataset, start in ns) parts, times from the first start, replicates anew.

    Samples of a file do not know when they were taken (start 0): the next part follows them. A
    condition that a part lacks is left out with a warning, a sensor's reading is NaN there;
    DatasetError for different joints.
    """
    first, start = parts[0]
    if len(parts) == 1:
        return first if first.sha256 else dataclasses.replace(first, sha256=fingerprint(first))
    datasets, end = [first], float(first.time.max())
    for part, its_start in parts[1:]:
        if part.joint_names != first.joint_names:
            raise DatasetError(
                f"samples of different joints cannot be joined: {', '.join(first.joint_names)} "
                f"and {', '.join(part.joint_names)}. Clear the collection first"
            )
        shift = (its_start - start) * 1e-9 if start else end
        datasets.append(_later(part, shift))
    return _stacked(datasets, tolerance)


def fingerprint(dataset: Dataset) -> str:
    """sha256 of the samples' numbers, for data that is in no file."""
    digest = hashlib.sha256()
    for name in ("q", "r", "R", "measured", "pose_cov", "time"):
        digest.update(np.ascontiguousarray(getattr(dataset, name)).tobytes())
    for name in sorted(c for c in dataset.conditions if c.startswith(READING)):
        digest.update(name.encode() + dataset.conditions[name].tobytes())
    return digest.hexdigest()


def _later(dataset: Dataset, shift: float) -> Dataset:
    conditions = {k: v + shift if k == "time" else v for k, v in dataset.conditions.items()}
    return dataclasses.replace(dataset, time=dataset.time + shift, conditions=conditions)


def _stacked(datasets: list[Dataset], tolerance: float | None) -> Dataset:
    first = datasets[0]
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(d, name) for d in datasets]) for name in PER_SAMPLE
    }
    shared = joined_conditions(datasets)
    lacking = sorted({c for d in datasets for c in d.conditions} - set(shared))
    warnings = [w for d in datasets for w in d.warnings]
    if lacking:
        warnings.append(f"not known for all samples, left out: {', '.join(lacking)}")
    q, r, R, measured, scatter = (columns[n] for n in ("q", "r", "R", "measured", "scatter_q"))
    columns["pose_id"] = replicate_ids(q, r, R, measured, scatter, tolerance)
    together = dataclasses.replace(
        first,
        **columns,
        conditions=shared,
        warnings=tuple(dict.fromkeys(warnings)),
        source=" + ".join(dict.fromkeys(d.source for d in datasets)),
    )
    return dataclasses.replace(together, sha256=fingerprint(together))
