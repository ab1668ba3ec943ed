"""Decide which messages of a topic can be used, and at which time each was sent."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from parallel_cal.base.errors import BagError
from parallel_cal.recordings.gate import (
    MAX_STAMP_JUMP_NS,
    MIN_AGREEING_MESSAGES,
    Gate,
    StampedMessage,
)
from parallel_cal.recordings.recording import Array, Bools, Dropped, Raw

STRAY_STAMP = "stamp fits neither the previous nor the next message"


class Sieve:
    """Marks messages of one topic as unusable, and counts them by reason."""

    def __init__(
        self,
        raw: Raw,
        stamp: NDArray[np.int64],
        start_ns: int,
        strays: Bools | None = None,
    ) -> None:
        self.topic = raw.topic
        self.time = np.asarray((stamp - start_ns) * 1e-9, float)
        self.keep: Bools = np.ones(len(stamp), bool)
        self.dropped: list[Dropped] = []
        if strays is not None:
            self.drop(strays, STRAY_STAMP)
        latest = np.maximum.accumulate(np.where(self.keep, stamp, stamp[self.keep].min()))
        before = np.concatenate([[stamp[0] - 1], latest[:-1]])
        for i in np.flatnonzero(self.keep & (stamp < before - MAX_STAMP_JUMP_NS))[:1]:
            raise BagError(
                f"{self.topic}: time runs backwards at message {i}: {stamp[i] * 1e-9:.3f} s comes "
                f"after {before[i] * 1e-9:.3f} s. Record again with one clock, cut the bag there, "
                "or read it by log time (stamps='log')."
            )
        header = np.array(raw.stamp, np.int64)
        unstamped = (header <= 0) & (stamp != np.array(raw.log))
        self.drop(unstamped, "header stamp is zero or negative")
        self.drop(stamp < before, "stamp earlier than the message before")
        self.drop(stamp == before, "stamp repeats the message before")

    def drop(
        self, bad: ArrayLike, reason: str, hint: str = "", values: Array | None = None
    ) -> None:
        """Drop the messages marked in `bad` (n,); BagError if no message remains.

        The report shows the first one with its row of `values`.
        """
        bad = np.asarray(bad, bool) & self.keep
        if not bad.any():
            return
        self.keep &= ~bad
        first, count = int(np.argmax(bad)), int(bad.sum())
        shown = "" if values is None else ": " + " ".join(f"{v:.6g}" for v in values[first])
        message = f"message {first}{shown}"
        if not self.keep.any():
            raise BagError(
                (
                    f"{self.topic}: none of its {len(bad)} messages can be used; the last "
                    f"{count} were dropped because: {reason} ({message}). {hint}"
                ).rstrip()
            )
        detail = f"{self.topic}: {count} of {len(bad)} messages; the first is {message}"
        self.dropped.append(Dropped(float(self.time[first]), reason, detail, count))


def find_stray_stamps(stamp: NDArray[np.int64], log: Sequence[int]) -> Bools:
    """Mark the messages (n,) that the gate of a live node would not let through."""
    strays = np.zeros(len(stamp), bool)
    if (np.abs(np.diff(stamp)) <= MAX_STAMP_JUMP_NS).all():
        return strays
    gate, passed = Gate(""), list[StampedMessage]()
    for i, (sent, received) in enumerate(zip(stamp.tolist(), log, strict=True)):
        passed += gate.take(sent, received, 0, i)
    passed += gate.flush()
    strays[:] = True
    strays[[message.message for message in passed]] = False
    return strays


def require_messages(raw: Raw) -> None:
    """Raise BagError if no message of a topic can be decoded."""
    if raw.stamp:
        return
    why = f" ({raw.undecodable} cannot be decoded)" if raw.undecodable else ""
    raise BagError(
        f"{raw.topic}: no usable message{why}. Record this topic again; if messages were "
        "compressed one by one, give the bag's folder with its metadata.yaml."
    )


def resolve_stamps(raw: Raw, stamps: str, notes: list[str]) -> NDArray[np.int64]:
    """Return the time (n,) in ns of each message: of its header, or of the log if none has one."""
    header, log = np.array(raw.stamp, np.int64), np.array(raw.log, np.int64)
    if stamps == "log":
        return log
    empty = header <= 0
    if np.count_nonzero(~empty) < min(MIN_AGREEING_MESSAGES, len(header)):
        notes.append(
            f"{raw.topic}: header stamps are zero or negative; the log time is used instead"
        )
        return log
    # Among real stamps, a missing one takes the stamp before it, so that time goes on; the sieve
    # drops it.
    last = np.maximum.accumulate(np.where(empty, int(np.argmin(empty)), np.arange(len(header))))
    return header[last]
