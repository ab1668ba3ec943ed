"""Several datasets of one robot as one."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.model.configuration import Configuration
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.recording import Array
from parallel_cal.recordings.replicates import replicate_ids
from parallel_cal.recordings.samplefile import PER_SAMPLE
from parallel_cal.recordings.samples import READING

SETUP_FIELDS = ("joint_names", "joint_sigma", "mode", "frame")


def join_datasets(
    datasets: Sequence[Dataset],
    starts: Sequence[int] | None = None,
    tolerance: float | None = None,
) -> Dataset:
    """One dataset of all samples, times (also of what was dropped) from the first one's start.

    Without `starts` each is a session, `session` 0, 1, ... among its samples' conditions: time goes
    on from one to the next, whatever lay between, and poses are replicates within a session only.
    With `starts` (ns, 0 where unknown: the next follows its samples) they are parts of one session
    and replicates are looked for anew, within `tolerance`. A condition that one lacks is left out
    with a warning, a sensor's reading is NaN there. DatasetError where they do not go together, or
    a recording comes twice.
    """
    _check_different(datasets)
    _check_alike(datasets, SETUP_FIELDS if starts is None else ["joint_names"])
    times = _times(datasets) if starts is None else _compute_part_starts(starts, datasets[0])
    parts = [_shift_times(d, time) for d, time in zip(datasets, times, strict=True)]
    if starts is None:
        firsts = np.cumsum([0, *[int(d.pose_id.max(initial=-1)) + 1 for d in parts[:-1]]])
        parts = [_session(d, k, firsts[k]) for k, d in enumerate(parts)]
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(d, name) for d in parts]) for name in PER_SAMPLE
    }
    if starts is not None:
        at = Configuration(columns["q"], columns["r"], columns["R"])
        columns["pose_id"] = replicate_ids(at, columns["measured"], columns["scatter_q"], tolerance)
    shared = _join_conditions(parts)
    warnings = [*(w for d in parts for w in d.warnings), *_list_missing_conditions(parts, shared)]
    together = dataclasses.replace(
        parts[0],
        **columns,
        conditions=shared,
        dropped=tuple(dropped for d in parts for dropped in d.dropped),
        warnings=tuple(dict.fromkeys(warnings)),
        source=", ".join(dict.fromkeys(d.source for d in parts)),
    )
    hashes = [d.sha256 for d in parts]
    of_hashes = hashlib.sha256("".join(hashes).encode()).hexdigest()
    return dataclasses.replace(together, sha256=of_hashes if all(hashes) else fingerprint(together))


def fingerprint(dataset: Dataset) -> str:
    """sha256 of the samples' numbers, for data that is in no file."""
    digest = hashlib.sha256()
    for name in ("q", "r", "R", "measured", "pose_cov", "time"):
        digest.update(np.ascontiguousarray(getattr(dataset, name)).tobytes())
    for name in sorted(c for c in dataset.conditions if c.startswith(READING)):
        digest.update(name.encode() + dataset.conditions[name].tobytes())
    return digest.hexdigest()


def _check_different(datasets: Sequence[Dataset]) -> None:
    known: dict[str, str] = {}
    for dataset in datasets:
        if dataset.sha256 and dataset.sha256 in known:
            raise DatasetError(
                f"{dataset.source}: the same recording as {known[dataset.sha256]}; give "
                "it once, otherwise the uncertainties would be too small"
            )
        known[dataset.sha256] = dataset.source


def _check_alike(datasets: Sequence[Dataset], names: Sequence[str]) -> None:
    for other in datasets[1:]:
        for name in names:
            one, two = getattr(datasets[0], name), getattr(other, name)
            if not np.array_equal(one, two):
                raise DatasetError(
                    f"{other.source}: {name} is {two}, but {one} in {datasets[0].source}; "
                    "only recordings of one robot and one set-up can be joined"
                )


def _times(datasets: Sequence[Dataset]) -> Array:
    """When each session begins (s): at the end of the last sample of the one before."""
    lengths = [float(np.max(d.time + d.duration / 2, initial=0.0)) for d in datasets]
    return np.cumsum([0.0, *lengths[:-1]])


def _compute_part_starts(starts: Sequence[int], first: Dataset) -> Array:
    """When each part begins, in s since the first; samples of a file do not know their start."""
    if starts[0]:
        return np.array([(start - starts[0]) * 1e-9 for start in starts])
    end = float(first.time.max())
    return np.array([0.0, *[end + (start - starts[1]) * 1e-9 for start in starts[1:]]])


def _shift_times(dataset: Dataset, start: float) -> Dataset:
    time = dataset.time + start
    late = tuple(dataclasses.replace(d, time=d.time + start) for d in dataset.dropped)
    conditions = dict(dataset.conditions)
    if "time" in conditions:  # else its samples have an order only, and that is no time
        conditions["time"] = time
    return dataclasses.replace(dataset, time=time, dropped=late, conditions=conditions)


def _session(dataset: Dataset, number: int, first: int) -> Dataset:
    """The samples of one session, their pose numbers behind those before it."""
    known = {**dataset.conditions, "session": np.full(len(dataset), float(number))}
    return dataclasses.replace(dataset, pose_id=dataset.pose_id + first, conditions=known)


def _join_conditions(parts: Sequence[Dataset]) -> dict[str, Array]:
    """Conditions (N,) of several datasets as one: those that all have, and every reading, NaN
    in the parts where its sensor read nothing."""
    names = dict.fromkeys(name for part in parts for name in part.conditions)
    return {
        name: np.concatenate(
            [part.conditions.get(name, np.full(len(part), np.nan)) for part in parts]
        )
        for name in names
        if name.startswith(READING) or all(name in part.conditions for part in parts)
    }


def _list_missing_conditions(parts: Sequence[Dataset], shared: dict[str, Array]) -> list[str]:
    """A sentence for each part's conditions that the others do not have."""
    lost = [(d.source, [c for c in d.conditions if c not in shared]) for d in parts]
    return [
        (f"{', '.join(names)} of {source} is not used: it was not recorded in every session")
        for source, names in lost
        if names
    ]
