"""Join several datasets of one robot."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.model.configuration import Configuration
from parallel_cal.recordings.configuration import explain_difference
from parallel_cal.recordings.dataset import NUMBER, Dataset
from parallel_cal.recordings.recording import Array
from parallel_cal.recordings.replicates import replicate_ids
from parallel_cal.recordings.samplefile import PER_SAMPLE
from parallel_cal.recordings.samples import READING

SETUP_FIELDS = ("joint_names", "joint_sigma", "mode")


def join_datasets(
    datasets: Sequence[Dataset],
    starts: Sequence[int] | None = None,
    tolerance: float | None = None,
) -> Dataset:
    """Return one dataset of all samples, with all times in s since the start of the first one.

    Without `starts`, each dataset is a session, and the condition `session` numbers them 0, 1, ...
    Each session begins at the end of the one before, however long the pause was. Poses are
    replicates within a session only.

    With `starts` (ns), the datasets are parts of one session, and replicates are detected again,
    within `tolerance`. A start of 0 is unknown: the next part follows its last sample.

    Sessions may be measured in different frames: a fit registers each of them. The result names the
    frame of the first.

    A condition that one dataset lacks is dropped with a warning. A missing reading of a sensor is
    NaN. DatasetError if the datasets differ in their set-up, or if a recording is given twice.
    """
    if starts is None:
        _check_joinable(datasets, SETUP_FIELDS)
        together = _concatenate(_number_sessions(datasets))
    else:
        _check_joinable(datasets, ["joint_names"])
        times = _compute_part_starts(starts, datasets[0])
        parts = [_shift_times(d, time) for d, time in zip(datasets, times, strict=True)]
        together = _concatenate(parts)
        at = Configuration(together.q, together.r, together.R)
        ids = replicate_ids(at, together.measured, together.scatter_q, tolerance)
        together = dataclasses.replace(together, pose_id=ids)
    hashes = [d.sha256 for d in datasets]
    if not all(hashes):
        return dataclasses.replace(together, sha256=fingerprint(together), recordings=())
    return dataclasses.replace(
        together,
        sha256=hashlib.sha256("".join(hashes).encode()).hexdigest(),
        recordings=tuple(hashes) if starts is None else (),
    )


def _number_sessions(datasets: Sequence[Dataset]) -> list[Dataset]:
    """Return each dataset as a session: one after the other, with its number, and with poses of its
    own."""
    ends = [float(np.max(d.time + d.duration / 2, initial=0.0)) for d in datasets]
    times = np.cumsum([0.0, *ends[:-1]])
    firsts = np.cumsum([0, *[int(d.pose_id.max(initial=-1)) + 1 for d in datasets[:-1]]])
    sessions = []
    for k, dataset in enumerate(datasets):
        d = _shift_times(dataset, times[k])
        conditions = {**d.conditions, "session": np.full(len(d), float(k))}
        sessions.append(
            dataclasses.replace(d, pose_id=d.pose_id + firsts[k], conditions=conditions)
        )
    return sessions


def _concatenate(parts: Sequence[Dataset]) -> Dataset:
    """Return one dataset of all samples, with the conditions that all parts have, and warnings."""
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(d, name) for d in parts]) for name in PER_SAMPLE
    }
    names = dict.fromkeys(name for part in parts for name in part.conditions)
    shared = {
        name: np.concatenate(
            [part.conditions.get(name, np.full(len(part), np.nan)) for part in parts]
        )
        for name in names
        if name.startswith(READING) or all(name in part.conditions for part in parts)
    }
    warnings = _merge_warnings(parts)
    for d in parts:
        if lost := [name for name in d.conditions if name not in shared]:
            warnings.append(
                f"{', '.join(lost)} of {d.source} is not used: it was not recorded in every session"
            )
    titles = parts[0].names
    if NUMBER not in shared:
        firsts = np.cumsum([0, *map(len, parts[:-1])])
        titles = {
            int(first) + k: d.names[number]
            for first, d in zip(firsts, parts, strict=True)
            for k, number in enumerate(d.numbers.tolist())
            if number in d.names
        }
    return dataclasses.replace(
        parts[0],
        **columns,
        conditions=shared,
        dropped=tuple(dropped for d in parts for dropped in d.dropped),
        warnings=tuple(dict.fromkeys(warnings)),
        sides_from_order=any(d.sides_from_order for d in parts),
        source=", ".join(dict.fromkeys(d.source for d in parts)),
        names=titles,
    )


def _merge_warnings(parts: Sequence[Dataset]) -> list[str]:
    """List the warnings of all recordings; what several of them share is one sentence that names
    these recordings."""
    found = dict[str, str]()
    sources = dict[str, list[str]]()
    for d in parts:
        for words in d.warnings:
            own = f"{d.source}: "
            shared = words.removeprefix(own)
            if shared in sources:
                sources[shared].append(d.source)
                found[shared] = f"{', '.join(dict.fromkeys(sources[shared]))}: {shared}"
            else:
                found[shared] = words
                if words.startswith(own):
                    sources[shared] = [d.source]
    return list(found.values())


def fingerprint(dataset: Dataset) -> str:
    """Return the sha256 of what was measured, for data that is in no file.

    It does not depend on the stated noise, nor on the last digits, in which numbers differ that
    were converted from different units.
    """
    digest = hashlib.sha256()
    readings = sorted(name for name in dataset.conditions if name.startswith(READING))
    for numbers in (
        *(getattr(dataset, name) for name in ("q", "r", "R", "time")),
        *(dataset.conditions[name] for name in readings),
    ):
        digest.update(np.asarray(numbers, dtype=np.float32, order="C").tobytes())
    digest.update(" ".join(readings).encode())
    return digest.hexdigest()


def _check_joinable(datasets: Sequence[Dataset], equal: Sequence[str]) -> None:
    """Raise DatasetError if a recording is given twice, or if the `equal` fields differ."""
    known: dict[str, str] = {}
    for dataset in datasets:
        if dataset.sha256 and dataset.sha256 in known:
            raise DatasetError(
                f"{dataset.source}: the same recording as {known[dataset.sha256]}; give "
                "it once, otherwise the uncertainties would be too small"
            )
        known[dataset.sha256] = dataset.source
    for other in datasets[1:]:
        if difference := explain_difference(other.configuration, datasets[0].configuration):
            raise DatasetError(
                f"{other.source}: {difference} in {datasets[0].source}; only samples that were "
                "imported with one configuration can be joined"
            )
        stated = datasets[0].joint_units is not None and other.joint_units is not None
        for name in (*equal, "joint_units") if stated else equal:
            one, two = getattr(datasets[0], name), getattr(other, name)
            if not _are_equal(one, two):
                raise DatasetError(
                    f"{other.source}: {name} is {two}, but {one} in {datasets[0].source}; "
                    "only recordings of one robot and one set-up can be joined"
                )


def _are_equal(one: Any, two: Any) -> bool:
    """Whether two fields agree. Numbers that were converted from different units differ in their
    last digits."""
    a, b = np.asarray(one), np.asarray(two)
    if a.dtype.kind == b.dtype.kind == "f" and a.shape == b.shape:
        return np.allclose(a, b, rtol=1e-9, atol=0.0)
    return np.array_equal(a, b)


def _compute_part_starts(starts: Sequence[int], first: Dataset) -> Array:
    """Return the starts of the parts, in s since the first one's start."""
    if starts[0]:
        return np.array([(start - starts[0]) * 1e-9 for start in starts])
    # Samples from a file do not know when they began: the next part follows the last of them.
    end = float(first.time.max())
    return np.array([0.0, *[end + (start - starts[1]) * 1e-9 for start in starts[1:]]])


def _shift_times(dataset: Dataset, start: float) -> Dataset:
    time = dataset.time + start
    late = tuple(dataclasses.replace(d, time=d.time + start) for d in dataset.dropped)
    conditions = dict(dataset.conditions)
    if "time" in conditions:  # otherwise only the order of the samples is known
        conditions["time"] = time
    return dataclasses.replace(dataset, time=time, dropped=late, conditions=conditions)
