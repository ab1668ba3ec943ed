"""Distinguish the publishers of a topic by their message counts, and count lost messages."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import count

MAX_CONSECUTIVE_LOSSES = 10_000  # messages that a known publisher may lose in a row
MAX_PUBLISHERS = 8  # publishers of one topic that are remembered


@dataclass(eq=False)
class Source:
    """A publisher: the count of its last message, and its number in the order of their arrival."""

    sequence: int
    number: int = 1


class Sources:
    """The publishers of one topic; `lost` counts their messages that never arrived."""

    def __init__(self) -> None:
        self._known: list[Source] = []
        self._numbers = count(1)
        self.lost = 0

    def identify(self, sequence: int | None) -> Source | None:
        """Return the publisher whose count this continues; None if messages are not counted."""
        if not sequence:
            return None
        last = self._known[-1] if self._known else None
        if last is not None and sequence == last.sequence + 1:  # nearly always
            last.sequence = sequence
            return last
        behind = [s for s in self._known if 0 < sequence - s.sequence <= MAX_CONSECUTIVE_LOSSES]
        if not behind:
            self._known = [
                *self._known[1 - MAX_PUBLISHERS :],
                Source(sequence, next(self._numbers)),
            ]
            return self._known[-1]
        source = max(behind, key=lambda s: s.sequence)
        self.lost += sequence - source.sequence - 1
        source.sequence = sequence
        return source
