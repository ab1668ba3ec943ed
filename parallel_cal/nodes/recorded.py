"""A recording as serialized messages in the order in which they were recorded."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from parallel_cal.bag import _Bag
from parallel_cal.errors import BagError


@dataclass(frozen=True)
class RecordedTopic:
    """A topic of a recording: name, message type, number of messages, latched or not."""

    name: str
    type: str
    count: int
    latched: bool


@dataclass(frozen=True)
class Extent:
    """What is to be replayed: its topics, and the log times in ns where the bag begins and ends."""

    topics: tuple[RecordedTopic, ...]
    begin: int
    end: int

    @property
    def count(self) -> int:
        return sum(topic.count for topic in self.topics)


def extent(path: str | Path, topics: Sequence[str] = ()) -> Extent:
    """The topics of a bag, or those named; BagError for a name that is not in it."""
    with _Bag(Path(path), []) as bag:
        found: dict[str, RecordedTopic] = {}
        for c in bag.reader.connections:
            before = found[c.topic].count if c.topic in found else 0
            found[c.topic] = RecordedTopic(c.topic, c.msgtype, before + c.msgcount, _latched(c))
        unknown = [t for t in topics if t.strip("/") not in {f.strip("/") for f in found}]
        if unknown:
            raise BagError(f"{path}: no topic {', '.join(unknown)}; there are {', '.join(found)}")
        wanted = {t.strip("/") for t in topics or found}
        chosen = tuple(t for t in found.values() if t.name.strip("/") in wanted)
        return Extent(chosen, bag.reader.start_time, bag.reader.end_time)


def raw_messages(path: str | Path, topics: Sequence[str]) -> Iterator[tuple[str, int, bytes]]:
    """(topic, log time in ns, CDR bytes) of every message on these topics, in log order."""
    with _Bag(Path(path), []) as bag:
        connections = [c for c in bag.reader.connections if c.topic in topics]
        for connection, log, data in bag.messages(connections):
            yield connection.topic, log, data


def _latched(connection: Any) -> bool:
    """Whether it was offered to those who come late."""
    profiles = getattr(connection.ext, "offered_qos_profiles", None) or []
    return any(getattr(p.durability, "name", "") == "TRANSIENT_LOCAL" for p in profiles)
