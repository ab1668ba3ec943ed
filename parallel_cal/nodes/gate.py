"""Lets through the messages of one publisher on one clock; what strays is held back and counted.

Knows nothing of ROS: a message is its stamp, when it was received and its publisher's count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from parallel_cal.nodes.sources import Source, Sources

JUMP = 1_000_000_000  # ns; a stamp further off than this is astray, or of another clock
AGREE = 3  # messages that must follow each other on another clock before it is believed
SILENT = 300_000_000  # ns for which the publisher before says nothing, until another is believed
MIXED = 2_000_000_000  # ns after the last sign of two publishers in which nothing is taken


@dataclass(frozen=True)
class Said:
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
        self._last: Said | None = None
        self._held: list[Said] = []
        self._sources = Sources()
        self._mixed: int | None = None
        self.strays = 0
        self.trouble = ""

    @property
    def lost(self) -> int:
        return self._sources.lost

    def take(self, stamp: int, log: int, sequence: int, message: Any) -> Sequence[Said]:
        """The messages that may go on now, this one among them or not."""
        said = Said(stamp, log, sequence, message, self._sources.of(sequence))
        last, held = self._last, self._held
        if last is None:
            return self._first(said)
        if said.source is last.source and _near(said, last):
            if held:
                self._drop_held(last, log)
            return self._passed([said])
        if held and said.source is held[-1].source and said.stamp >= held[-1].stamp - JUMP:
            held.append(said)
            return self._passed(held) if self._believed(last) else ()
        if held and said.source is not held[-1].source:
            self._mixed = log
            self._stray(held, "two publishers speak at once")
        else:
            self._stray(held, "fits neither what came before nor what came after")
        self._held = [said]
        return ()

    def flush(self, now: int | None = None) -> Sequence[Said]:
        """What is held where nothing else came for a while, or (None) will ever come."""
        last, held = self._last, self._held
        if not held or (now is not None and now - held[-1].log < SILENT):
            return ()
        first = last is None
        ahead = last and held[-1].source is last.source and held[0].stamp > last.stamp
        return self._passed(held) if first or ahead or len(held) >= AGREE else ()

    def _first(self, said: Said) -> Sequence[Said]:
        """Messages before any that can be trusted: two that are near each other, or several of a
        device that is slow; what strayed from those is none of them."""
        held = self._held
        if held and said.source is not held[-1].source:
            self._mixed = said.log
            self._stray(held, "two publishers speak at once")
            held = []
        elif held and _near(said, held[-1]):
            self._stray(held[:-1], "fits neither what came before nor what came after")
            return self._passed([held[-1], said])
        elif held and said.stamp < held[-1].stamp:
            self._stray(held, "fits neither what came before nor what came after")
            held = []
        self._held = [*held, said]
        return self._passed(self._held) if len(self._held) >= AGREE else ()

    def _believed(self, last: Said) -> bool:
        held = self._held
        if held[0].source is not last.source:
            return len(held) >= AGREE and held[-1].log - last.log > SILENT
        return held[0].stamp > last.stamp or len(held) >= AGREE

    def _passed(self, said: list[Said]) -> Sequence[Said]:
        self._last, self._held = said[-1], []
        if self._mixed is not None and said[-1].log - self._mixed < MIXED:
            self._stray(said, "two publishers speak at once")
            return ()
        return said

    def _drop_held(self, last: Said, now: int) -> None:
        if self._held[0].source is not last.source:
            self._mixed = now
            self._stray(self._held, "two publishers speak at once")
        else:
            off = (self._held[0].stamp - last.stamp) * 1e-9
            self._stray(self._held, f"stamped {off:+.1f} s from those around it")
        self._held = []

    def _stray(self, said: Sequence[Said], why: str) -> None:
        if said:
            self.strays += len(said)
            self.trouble = f"{self._name}: {self.strays} messages dropped, the last {why}"


def _near(one: Said, other: Said) -> bool:
    return not one.stamp or not other.stamp or abs(one.stamp - other.stamp) <= JUMP
