"""Count the measurements that a node has read and processed. This module does not use ROS."""

from __future__ import annotations

import math
import time
from collections import Counter
from typing import Protocol


class Reader(Protocol):
    """A thread that reads messages, such as a Pump."""

    read_until: float


class Inflow:
    """Counts measurements in constant time, without a lock.

    Threads that read measurements call `receive`. The thread that makes samples of them calls
    `process`. A thread that waits for a measurement polls the counts and blocks neither. Times are
    those of `time.monotonic`.
    """

    def __init__(self) -> None:
        self.holds = False  # whether the last word is a measurement until the next one arrives
        # One count per channel: only one thread receives a channel, so that no count is lost.
        self._received, self._processed = Counter[str](), Counter[str]()
        self._latest: dict[str, float] = {}
        self._readers: list[Reader] = []
        self.joint_reader: Reader | None = None  # reads the joint states
        # When the last image arrived that shows too little of the board, and the reason.
        self.unusable: tuple[float, str] = (-math.inf, "")

    def add_reader(self, reader: Reader) -> None:
        self._readers.append(reader)

    def remove_reader(self, reader: Reader) -> None:
        """Wait no more for a reader that has ended; another one reads its topic."""
        self._readers = [one for one in self._readers if one is not reader]

    def receive(self, channel: str, received_ns: int) -> None:
        """Count a measurement that was read and had arrived at `received_ns` of `time.time_ns`."""
        self._received[channel] += 1
        self._latest[channel] = _monotonic_time(received_ns)

    def note_unusable(self, received_ns: int, why: str) -> None:
        """Note an image that arrived at `received_ns` of `time.time_ns` and shows too little."""
        self.unusable = _monotonic_time(received_ns), why

    def process(self, channel: str) -> None:
        """Count a measurement that the next samples will contain."""
        self._processed[channel] += 1

    @property
    def latest(self) -> float | None:
        """When the newest measurement arrived; None before the first one."""
        return max(list(self._latest.values()), default=None)

    @property
    def unprocessed(self) -> int:
        """The number of measurements that were read and are not processed yet."""
        return sum(list(self._received.values())) - sum(list(self._processed.values()))

    def has_read_until(self, moment: float) -> bool:
        """Return whether every measurement that arrived before a time has been read."""
        return all(reader.read_until >= moment for reader in self._readers)

    def joints_read_until(self) -> float:
        """Return the time until which every joint state that arrived has been read."""
        return time.monotonic() if self.joint_reader is None else self.joint_reader.read_until


def _monotonic_time(received_ns: int) -> float:
    """Convert a time of `time.time_ns` in the past to that of `time.monotonic`."""
    return time.monotonic() - max(0.0, 1e-9 * (time.time_ns() - received_ns))
