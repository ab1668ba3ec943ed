"""Lets through the messages on one clock; holds back and counts the others.

A live node and the reader of recordings use it. A message consists of its stamp, its time of
reception and its publisher's sequence number (0 in a recording). Publishers on one clock all pass:
`publishers` distinguishes them by the content of their messages. A publisher on another clock does
not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from parallel_cal.base.keyed_warning import KeyedWarning
from parallel_cal.recordings.sources import Source, Sources

# A stamp that differs more from its neighbour is wrong, or belongs to another clock.
MAX_STAMP_JUMP_NS = 1_000_000_000
# Another clock is believed after so many consecutive messages.
MIN_AGREEING_MESSAGES = 3
# Another publisher is believed when the previous one has been silent for so long.
PUBLISHER_TIMEOUT_NS = 300_000_000
# No message passes for so long after the last sign of two active publishers.
MIXED_PUBLISHERS_HOLD_NS = 2_000_000_000
# Why messages are dropped.
TWO_PUBLISHERS = "because two publishers are active whose clocks differ"
NO_NEIGHBOUR = "because its stamp fits neither the previous nor the next message"
STAMP_JUMP = "stamp jump"


@dataclass(frozen=True)
class StampedMessage:
    """A message; times in ns; stamp 0 and sequence 0 mean that it has none."""

    stamp: int
    log: int
    sequence: int
    message: Any
    source: Source | None = None


class Gate:
    """The gate of one stream.

    `strays` counts the dropped messages, `lost` those that were never received, and `trouble`
    describes the last drop.
    """

    def __init__(self, name: str):
        self._name = name
        self._last: StampedMessage | None = None
        self._held: list[StampedMessage] = []
        self._sources = Sources()
        self._mixed: int | None = None  # when two publishers were last seen to be active
        self._is_slow = False  # whether the last messages are further apart than neighbours are
        self.strays = 0
        self.trouble = ""

    @property
    def lost(self) -> int:
        return self._sources.lost

    def take(self, stamp: int, log: int, sequence: int, message: Any) -> Sequence[StampedMessage]:
        """Return the messages that may pass now; the new one may be among them."""
        new = StampedMessage(stamp, log, sequence, message, self._sources.identify(sequence))
        last, held = self._last, self._held
        if last is None:
            return self._take_first(new)
        if last.stamp and not stamp:  # the reader drops and counts it; it tells of no clock
            return [new]
        if _near(new, last):
            # The stream continues: the messages held back in between do not belong to it.
            if held and held[0].source is not last.source:
                self._drop_mixed(held, log)
            elif held:
                off = (held[0].stamp - last.stamp) * 1e-9
                why = f"because its stamp is {off:+.1f} s from its neighbours"
                self._drop(held, STAMP_JUMP, why)
            return self._release([new])
        if not held:
            self._held = [new]
            return ()
        previous = held[-1]
        if new.source is previous.source and self._may_follow(new, previous):
            held.append(new)
            return self._release(held) if self._has_agreement(last) else ()
        if new.source is previous.source:
            self._drop(held, NO_NEIGHBOUR)
        else:
            self._drop_mixed(held, log)
        self._held = [new]
        return ()

    def flush(self, now: int | None = None) -> Sequence[StampedMessage]:
        """Return the held messages that may pass because no others came for a while.

        `now` is None if no others will ever come.
        """
        last, held = self._last, self._held
        if not held or (now is not None and now - held[-1].log < PUBLISHER_TIMEOUT_NS):
            return ()
        first = last is None
        ahead = last and held[-1].source is last.source and held[0].stamp > last.stamp
        return self._release(held) if first or ahead or len(held) >= MIN_AGREEING_MESSAGES else ()

    def _take_first(self, new: StampedMessage) -> Sequence[StampedMessage]:
        """Take a message while none is trusted yet.

        Two neighbouring messages are trusted, or several of a slow device.
        """
        held = self._held
        if held and _near(new, held[-1]):
            self._drop(held[:-1], NO_NEIGHBOUR)
            return self._release([held[-1], new])
        if held and new.source is not held[-1].source:
            self._drop_mixed(held, new.log)
            held = []
        elif held and new.stamp < held[-1].stamp:
            self._drop(held, NO_NEIGHBOUR)
            held = []
        self._held = [*held, new]
        return self._release(self._held) if len(self._held) >= MIN_AGREEING_MESSAGES else ()

    def _may_follow(self, new: StampedMessage, held: StampedMessage) -> bool:
        """Whether a message may be the next one of a held message's clock: a neighbour, or a later
        one of a device that is slow or was silent."""
        later = self._is_slow or new.log - held.log > PUBLISHER_TIMEOUT_NS
        return _near(new, held) or (later and new.stamp > held.stamp)

    def _has_agreement(self, last: StampedMessage) -> bool:
        """Whether the held messages may replace the stream that ended with `last`."""
        held = self._held
        enough = len(held) >= MIN_AGREEING_MESSAGES
        if held[0].source is not last.source:
            return enough and held[-1].log - last.log > PUBLISHER_TIMEOUT_NS
        return enough or held[0].stamp > last.stamp

    def _release(self, trusted: list[StampedMessage]) -> Sequence[StampedMessage]:
        before = trusted[-2] if len(trusted) > 1 else self._last
        self._is_slow = before is not None and not _near(trusted[-1], before)
        self._last, self._held = trusted[-1], []
        if self._mixed is not None and trusted[-1].log - self._mixed < MIXED_PUBLISHERS_HOLD_NS:
            self._drop(trusted, TWO_PUBLISHERS)
            return ()
        return trusted

    def _drop_mixed(self, dropped: Sequence[StampedMessage], now: int) -> None:
        self._mixed = now
        self._drop(dropped, TWO_PUBLISHERS)

    def _drop(self, dropped: Sequence[StampedMessage], kind: str, why: str = "") -> None:
        if dropped:
            self.strays += len(dropped)
            words = f"{self._name}: {self.strays} messages dropped, the last one {why or kind}"
            self.trouble = KeyedWarning(words, kind, self._name)


def _near(one: StampedMessage, other: StampedMessage) -> bool:
    return not one.stamp or not other.stamp or abs(one.stamp - other.stamp) <= MAX_STAMP_JUMP_NS
