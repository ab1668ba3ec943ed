"""Several recordings of one robot -> one Dataset whose samples know their session."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.recording import Array
from parallel_cal.recordings.samplefile import PER_SAMPLE
from parallel_cal.recordings.samples import READING

SAME = ("joint_names", "joint_sigma", "mode", "frame")


def joined(datasets: Sequence[Dataset]) -> Dataset:
    """One Dataset of all samples, `session` 0, 1, ... among their conditions.

    Time goes on from one session to the next, whatever lay between them. Poses are replicates
    within a session only. Conditions that some session lacks are left out, with a warning.
    DatasetError where joints, their sigma, mode or frame differ, or a recording comes twice.
    """
    _check_different(datasets)
    _check_alike(datasets)
    starts = np.cumsum([0.0, *[_length(d) for d in datasets[:-1]]])
    firsts = np.cumsum([0, *[int(d.pose_id.max(initial=-1)) + 1 for d in datasets[:-1]]])
    parts = [_moved(d, starts[k], firsts[k], k) for k, d in enumerate(datasets)]
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(d, name) for d in parts]) for name in PER_SAMPLE
    }
    shared = joined_conditions(parts)
    return dataclasses.replace(
        parts[0],
        **columns,
        conditions=shared,
        dropped=tuple(dropped for d in parts for dropped in d.dropped),
        warnings=(*(w for d in parts for w in d.warnings), *_left_out(parts, list(shared))),
        source=", ".join(d.source for d in parts),
        sha256=hashlib.sha256("".join(d.sha256 for d in parts).encode()).hexdigest(),
    )


def _check_different(datasets: Sequence[Dataset]) -> None:
    known: dict[str, str] = {}
    for dataset in datasets:
        if dataset.sha256 and dataset.sha256 in known:
            raise DatasetError(
                f"{dataset.source}: the same recording as {known[dataset.sha256]}; give it once, "
                "or the result would look surer than it is"
            )
        known[dataset.sha256] = dataset.source


def _check_alike(datasets: Sequence[Dataset]) -> None:
    for other in datasets[1:]:
        for name in SAME:
            one, two = getattr(datasets[0], name), getattr(other, name)
            if not np.array_equal(one, two):
                raise DatasetError(
                    f"{other.source}: {name} is {two}, but {one} in {datasets[0].source}; "
                    "only recordings of one robot and one set-up can be taken together"
                )


def _length(dataset: Dataset) -> float:
    """Time in s from a recording's beginning to the end of its last sample."""
    return float(np.max(dataset.time + dataset.duration / 2, initial=0.0))


def _moved(dataset: Dataset, start: float, first: int, session: int) -> Dataset:
    """The samples of one session, their times and pose numbers behind those before it."""
    time = dataset.time + start
    at = {"time": time, "session": np.full(len(dataset), float(session))}
    late = tuple(dataclasses.replace(d, time=d.time + start) for d in dataset.dropped)
    return dataclasses.replace(
        dataset,
        time=time,
        pose_id=dataset.pose_id + first,
        conditions={**dataset.conditions, **at},
        dropped=late,
    )


def _left_out(parts: Sequence[Dataset], shared: Sequence[str]) -> list[str]:
    """A sentence for each session's conditions that the others do not have."""
    lost = [(d.source, [c for c in d.conditions if c not in shared]) for d in parts]
    return [f"{', '.join(names)} of {source} is not used: not recorded in every session"
            for source, names in lost if names]  # fmt: skip


def joined_conditions(parts: Sequence[Dataset]) -> dict[str, Array]:
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
