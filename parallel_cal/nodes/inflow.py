"""How far a node has read and processed what a measuring device sends; knows nothing of ROS."""

from __future__ import annotations

import time
from collections import Counter
from typing import Protocol


class Reader(Protocol):
    """A thread that reads messages, such as a Pump."""

    read_until: float


class Inflow:
    """Counts measurements in constant time, whoever asks.

    Threads that read them call `receive`, the one that makes samples of them calls `process`.
    Whoever waits for a measurement looks here and keeps neither from its work. Moments are those of
    `time.monotonic`.
    """

    def __init__(self) -> None:
        self.holds = False  # whether something was said that is a measurement until the next word
        # By channel: each has one thread that receives, so that no count is lost between two.
        self._received, self._processed = Counter[str](), Counter[str]()
        self._latest: dict[str, float] = {}
        self._readers: list[Reader] = []

    def add_reader(self, reader: Reader) -> None:
        self._readers.append(reader)

    def receive(self, channel: str, received_ns: int) -> None:
        """Count a measurement that was read; `received_ns` is when it came in, by `time.time`."""
        self._received[channel] += 1
        age = max(0.0, 1e-9 * (time.time_ns() - received_ns))
        self._latest[channel] = time.monotonic() - age

    def process(self, channel: str) -> None:
        """Count a measurement that samples are made of from now on."""
        self._processed[channel] += 1

    @property
    def latest(self) -> float | None:
        """When the newest measurement came in; None before the first one."""
        return max(list(self._latest.values()), default=None)

    @property
    def unprocessed(self) -> int:
        """Measurements that were read and are not processed yet."""
        return sum(list(self._received.values())) - sum(list(self._processed.values()))

    def has_read_until(self, moment: float) -> bool:
        """Whether every measurement that came in before a moment has been read."""
        return all(reader.read_until >= moment for reader in self._readers)
