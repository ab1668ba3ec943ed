"""Merge joint states of several publishers, each of which has some of the joints.

The joints of one message were read at one time. Those of the other publishers are interpolated to
this time, between their messages before and after it, so that a moving robot has no error of the
delay between its publishers.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from parallel_cal.base.keyed_warning import KeyedWarning
from parallel_cal.recordings.recording import Array, Bools, Raw

MAX_GAP_PERIODS = 5.0  # usual periods of a publisher over which its readings are interpolated

Groups = dict[tuple[str, ...], list[int]]


def merge_partial_states(
    raw: Raw, wanted: Sequence[str] | None, by_log: bool, notes: list[str]
) -> Raw:
    """Return joint states with all joints of each message; rows are (names, q, effort).

    Parameters
    ----------
    raw : Raw
        Joint states as received.
    wanted : sequence of str, optional
        The joints of the model. Without them, nothing tells which parts belong together.
    by_log : bool
        Whether the time of reception counts instead of the stamp.
    notes : list
        Receives a sentence if messages were merged.

    Returns
    -------
    Raw
        `raw` itself if a message has all joints, or no set of messages has.
    """
    groups: Groups = {}
    for i, (present, q, _) in enumerate(raw.rows):
        if len(present) == len(q):
            groups.setdefault(present, []).append(i)
    if not wanted or any(set(wanted) <= set(present) for present in groups):
        return raw
    parts = _choose_groups(groups, wanted)
    if not parts:
        return raw
    stamped = not by_log and all(raw.stamp[i] > 0 for at in parts.values() for i in groups[at])
    time = np.array(raw.stamp if stamped else raw.log, np.int64)
    slowest = min(parts.values(), key=lambda present: len(groups[present]))
    at = np.array(groups[slowest])
    columns = [
        _interpolate(raw, time, groups[present], present.index(joint), at)
        for joint, present in parts.items()
    ]
    q, effort, silent = (np.stack([column[k] for column in columns], axis=1) for k in range(3))
    usable = np.flatnonzero(~silent.any(axis=1))
    if not len(usable):
        return raw
    merged = raw.select(at[usable].tolist())
    merged.rows = [(tuple(parts), q[i], effort[i]) for i in usable]
    listed = "; ".join(", ".join(present) for present in dict.fromkeys(parts.values()))
    text = (
        f"{raw.topic}: no message has all joints, so the messages of several publishers were "
        f"merged ({listed}): {len(usable)} readings of all joints, at the {len(at)} times of "
        f"{', '.join(slowest)} where none was silent"
    )
    notes.append(KeyedWarning(text, "merged joint states", raw.topic))
    return merged


def _choose_groups(groups: Groups, joints: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Return the names of the messages from which each joint is taken, as few kinds of messages as
    possible; empty if a joint is in none."""
    chosen: dict[str, tuple[str, ...]] = {}
    while missing := [joint for joint in joints if joint not in chosen]:
        best = max(groups, key=lambda g: (len({*missing} & {*g}), len(groups[g])), default=())
        found = [joint for joint in missing if joint in best]
        if not found:
            return {}
        chosen |= dict.fromkeys(found, best)
    return {joint: chosen[joint] for joint in joints}


def _interpolate(
    raw: Raw, time: NDArray[np.int64], own: Sequence[int], column: int, at: NDArray[np.intp]
) -> tuple[Array, Array, Bools]:
    """Return positions and efforts of a joint at the times of the messages `at`, and where its
    publisher was silent."""
    order = np.array(own)[np.argsort(time[own], kind="stable")]
    known, asked = (time[order] - time[0]) * 1e-9, (time[at] - time[0]) * 1e-9
    after = np.clip(np.searchsorted(known, asked), 1, max(1, len(known) - 1))
    if len(known) > 1:
        gap = known[after] - known[after - 1]
        silent = gap > MAX_GAP_PERIODS * np.median(np.diff(known))
    else:
        silent = np.zeros(len(asked), bool)
    silent |= (asked < known[0]) | (asked > known[-1])
    found = []
    for k in (1, 2):
        values = np.array(
            [raw.rows[i][k][column] if len(raw.rows[i][k]) > column else np.nan for i in order],
            float,
        )
        found.append(np.interp(asked, known, values))
    return found[0], found[1], silent
