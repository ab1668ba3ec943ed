"""Lets through the messages of one publisher on one clock; what strays is held back and counted.

Knows nothing of ROS: a message is its stamp, when it was received and its publisher's count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from parallel_cal.base.keyed_warning import KeyedWarning
from parallel_cal.nodes.sources import Source, Sources

MAX_STAMP_JUMP_NS = (
    1_000_000_000  # ns; a stamp further off than this is astray, or of another clock
)
MIN_AGREEING_MESSAGES = (
    3  # messages that must follow each other on another clock before it is believed
)
PUBLISHER_TIMEOUT_NS = (
    300_000_000  # ns for which the publisher before says nothing, until another is believed
)
MIXED_PUBLISHERS_HOLD_NS = (
    2_000_000_000  # ns after the last sign of two publishers in which nothing is taken
)
# Why messages are dropped.
TWO_PUBLISHERS = "because two publishers are active"
NO_NEIGHBOUR = "because its stamp fits neither the previous nor the next message"
STAMP_JUMP = "stamp jump"


@dataclass(frozen=True)
class StampedMessage:
    """A message; times in ns, stamp 0 and sequence 0 where it has none."""

    stamp: int
    log: int
    sequence: int
    message: Any
    source: Source | None = None


class Gate:
    """One stream; `strays` were dropped, `lost` never came, `trouble` is about the last of them."""

    def __init__(self, name: str):
        self._name = name
        self._last: StampedMessage | None = None
        self._held: list[StampedMessage] = []
        self._sources = Sources()
        self._mixed: int | None = None
        self.strays = 0
        self.trouble = ""

    @property
    def lost(self) -> int:
        return self._sources.lost

    def take(self, stamp: int, log: int, sequence: int, message: Any) -> Sequence[StampedMessage]:
        """The messages that may go on now, this one among them or not."""
        said = StampedMessage(stamp, log, sequence, message, self._sources.identify(sequence))
        last, held = self._last, self._held
        if last is None:
            return self._first(said)
        if said.source is last.source and _near(said, last):
            if held:
                self._drop_held(last, log)
            return self._release([said])
        if (
            held
            and said.source is held[-1].source
            and said.stamp >= held[-1].stamp - MAX_STAMP_JUMP_NS
        ):
            held.append(said)
            return self._release(held) if self._has_agreement(last) else ()
        if held and said.source is not held[-1].source:
            self._mixed = log
            self._stray(held, TWO_PUBLISHERS)
        else:
            self._stray(held, NO_NEIGHBOUR)
        self._held = [said]
        return ()

    def flush(self, now: int | None = None) -> Sequence[StampedMessage]:
        """What is held where nothing else came for a while, or (None) will ever come."""
        last, held = self._last, self._held
        if not held or (now is not None and now - held[-1].log < PUBLISHER_TIMEOUT_NS):
            return ()
        first = last is None
        ahead = last and held[-1].source is last.source and held[0].stamp > last.stamp
        return self._release(held) if first or ahead or len(held) >= MIN_AGREEING_MESSAGES else ()

    def _first(self, said: StampedMessage) -> Sequence[StampedMessage]:
        """Messages before any that can be trusted: two that are near each other, or several of a
        device that is slow; what strayed from those is none of them."""
        held = self._held
        if held and said.source is not held[-1].source:
            self._mixed = said.log
            self._stray(held, TWO_PUBLISHERS)
            held = []
        elif held and _near(said, held[-1]):
            self._stray(held[:-1], NO_NEIGHBOUR)
            return self._release([held[-1], said])
        elif held and said.stamp < held[-1].stamp:
            self._stray(held, NO_NEIGHBOUR)
            held = []
        self._held = [*held, said]
        return self._release(self._held) if len(self._held) >= MIN_AGREEING_MESSAGES else ()

    def _has_agreement(self, last: StampedMessage) -> bool:
        held = self._held
        if held[0].source is not last.source:
            return (
                len(held) >= MIN_AGREEING_MESSAGES
                and held[-1].log - last.log > PUBLISHER_TIMEOUT_NS
            )
        return held[0].stamp > last.stamp or len(held) >= MIN_AGREEING_MESSAGES

    def _release(self, said: list[StampedMessage]) -> Sequence[StampedMessage]:
        self._last, self._held = said[-1], []
        if self._mixed is not None and said[-1].log - self._mixed < MIXED_PUBLISHERS_HOLD_NS:
            self._stray(said, TWO_PUBLISHERS)
            return ()
        return said

    def _drop_held(self, last: StampedMessage, now: int) -> None:
        if self._held[0].source is not last.source:
            self._mixed = now
            self._stray(self._held, TWO_PUBLISHERS)
        else:
            off = (self._held[0].stamp - last.stamp) * 1e-9
            self._stray(
                self._held, STAMP_JUMP, f"because its stamp is {off:+.1f} s from its neighbours"
            )
        self._held = []

    def _stray(self, said: Sequence[StampedMessage], kind: str, why: str = "") -> None:
        if said:
            self.strays += len(said)
            words = f"{self._name}: {self.strays} messages dropped, the last one {why or kind}"
            self.trouble = KeyedWarning(words, kind, self._name)


def _near(one: StampedMessage, other: StampedMessage) -> bool:
    return not one.stamp or not other.stamp or abs(one.stamp - other.stamp) <= MAX_STAMP_JUMP_NS
