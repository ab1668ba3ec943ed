"""Order recorded joint states by joint name."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from parallel_cal.base.errors import BagError
from parallel_cal.base.float_fields import NEGATIVE_INT, UNCONVERTED, is_unconverted
from parallel_cal.recordings.recording import MAX_PLAUSIBLE_READING, Array, Bools, JointStream, Raw
from parallel_cal.recordings.sieve import Sieve


@dataclass(frozen=True)
class OrderedReadings:
    """Joint readings and efforts (n, nq) of messages, in the order of the names; NaN if not given.

    `missing` marks messages without some of the joints, `ragged` those with more or fewer positions
    than names.
    """

    names: tuple[str, ...]
    q: Array
    effort: Array
    missing: Bools
    ragged: Bools

    def select(self, at: Sequence[int]) -> OrderedReadings:
        return OrderedReadings(
            self.names, self.q[at], self.effort[at], self.missing[at], self.ragged[at]
        )


def order_readings(
    raw: Raw, wanted: Sequence[str] | None, notes: list[str], passive: Sequence[str] = ()
) -> OrderedReadings:
    """Return joint readings in the order of `wanted`; the raw rows are (names, q, effort).

    `passive` are joints whose readings `split_passive` takes: no note names them as ignored.
    """
    names = _joint_names(raw, wanted, notes, passive)
    q = np.full((len(raw.rows), len(names)), np.nan)
    effort = np.full_like(q, np.nan)
    missing, ragged = np.zeros(len(q), bool), np.zeros(len(q), bool)
    groups: dict[tuple[str, ...], list[int]] = {}
    for i, (present, _, _) in enumerate(raw.rows):
        groups.setdefault(present, []).append(i)
    for present, numbers in groups.items():
        which = np.array(numbers)
        if not set(names) <= set(present):
            missing[which] = True
            continue
        index = [present.index(name) for name in names]
        for column, values in ((1, q), (2, effort)):
            complete = np.array([len(raw.rows[i][column]) for i in which]) == len(present)
            if complete.any():
                found = np.array([raw.rows[i][column] for i in which[complete]])
                values[which[complete]] = found[:, index]
            if column == 1:
                ragged[which[~complete]] = True
    effort[ragged] = np.nan
    return OrderedReadings(names, q, effort, missing, ragged)


def clean_joints(topic: str, readings: OrderedReadings, sieve: Sieve) -> JointStream:
    """Return the usable joint readings."""
    names, q = readings.names, readings.q
    hint = f"Expected a position in rad or m for each of {', '.join(names)}: check their driver."
    sieve.drop(readings.missing, f"lacks some of the joints {', '.join(names)}")
    sieve.drop(readings.ragged, "position and name differ in length", hint)
    unconverted = is_unconverted(q).any(axis=1)
    sieve.drop(unconverted, UNCONVERTED, "", q)
    also = NEGATIVE_INT if unconverted.any() else ""
    sieve.drop(~np.isfinite(q).all(axis=1), f"joint reading is not finite{also}", hint, q)
    sieve.drop(
        (np.abs(q) > MAX_PLAUSIBLE_READING).any(axis=1), "joint reading is beyond 1e9", hint, q
    )
    keep = sieve.keep
    return JointStream(topic, names, sieve.time[keep], q[keep], readings.effort[keep])


def split_passive(raw: Raw, passive: Sequence[str]) -> dict[str, Raw]:
    """Return the readings of passive joints in joint states, by name; rows are (value,)."""
    found: dict[str, Raw] = {}
    if not passive:  # as most robots: nothing to look for in each message
        return found
    for log, stamp, (names, q, _), origin in zip(
        raw.log, raw.stamp, raw.rows, raw.origins, strict=True
    ):
        if len(names) == len(q):
            for name, value in zip(names, q, strict=True):
                if name in passive:
                    stream = found.setdefault(name, Raw(f"{raw.topic} ({name})", raw.type))
                    stream.append(log, stamp, (value,), origin)
    return found


def _joint_names(
    raw: Raw, wanted: Sequence[str] | None, notes: list[str], passive: Sequence[str]
) -> tuple[str, ...]:
    """Return the requested joints, or those of most messages; BagError if one never occurs."""
    counts = Counter(row[0] for row in raw.rows)
    names = tuple(wanted) if wanted else counts.most_common(1)[0][0]
    seen = list(dict.fromkeys(name for present in counts for name in present))
    unknown = [name for name in names if name not in seen]
    if unknown or not names or len(set(names)) < len(names):
        raise BagError(
            f"{raw.topic}: joints expected: {', '.join(names) or 'none'}; joints recorded: "
            f"{', '.join(seen) or 'none'}; not found: {', '.join(unknown) or 'none'}. "
            "Give the joints' names as they are recorded, each once."
        )
    if not any(set(names) <= set(present) for present in counts):
        raise BagError(
            f"{raw.topic}: no message contains all the joints {', '.join(names)}; the "
            f"messages contain {'; '.join(', '.join(present) for present in counts)}. "
            "Publish all joints in one message."
        )
    extra = [name for name in seen if name not in (*names, *passive)]
    if extra:
        notes.append(f"{raw.topic}: ignored joints: {', '.join(extra)}")
    return names
