"""Read serialized joint states whose names are those of an earlier message, without decoding them.

Almost all messages of a recording are joint states, and their names and frame do not change. Only
the numbers behind them are read then, of thousands of messages at once. Reading a recording takes
half the time.
"""

from __future__ import annotations

from collections.abc import Sequence
from struct import Struct

import numpy as np

LITTLE_ENDIAN = b"\x00\x01"  # the first bytes of plain CDR (OMG DDSI-RTPS 10.5)
HEADER = 4  # bytes before the message; alignment counts from there
STAMP = Struct("<iI")
COUNT = Struct("<I")


class JointStateReader:
    """The layout of the last message that was decoded: where its names and its arrays lie."""

    def __init__(self) -> None:
        self._names: tuple[str, ...] = ()
        self._length = -1  # no message has this length
        self._constant: list[tuple[slice, bytes]] = []  # bytes from frame to names, and counts
        self._arrays: list[slice] = []

    def learn(self, data: bytes, names: tuple[str, ...]) -> None:
        """Remember the layout of a message with these names, after it was decoded."""
        self._length = -1
        if data[:2] != LITTLE_ENDIAN:
            return
        begin = HEADER + STAMP.size
        end = aligned(skip_text(data, begin), 4) + COUNT.size
        for _ in names:
            end = skip_text(data, aligned(end, 4))
        constant, arrays = [slice(0, 2), slice(begin, end)], []
        for _ in ("position", "velocity", "effort"):
            at = aligned(end, 4)
            (count,) = COUNT.unpack_from(data, at)
            end = at + COUNT.size
            constant.append(slice(at, end))
            begin = aligned(end, 8) if count else end
            end = begin + 8 * count
            arrays.append(slice(begin, end))
        if not 0 <= len(data) - end < 4:  # the message ends there, give or take the padding
            return
        self._names, self._arrays = names, arrays
        self._constant = [(part, bytes(data[part])) for part in constant]
        self._length = len(data)

    def fits(self, data: bytes) -> bool:
        """Return whether a message has this layout, with the same frame and names."""
        if len(data) != self._length:
            return False
        for part, expected in self._constant:  # noqa: SIM110  (`all` takes twice the time)
            if data[part] != expected:
                return False
        return True

    def read(self, messages: Sequence[bytes]) -> tuple[list[int], list[tuple]]:
        """Return stamps (ns) and rows (names, positions, efforts) of messages that fit."""
        table = np.frombuffer(b"".join(messages), np.uint8).reshape(len(messages), -1)
        seconds = table[:, HEADER : HEADER + 4].copy().view("<i4")[:, 0].astype(np.int64)
        nanoseconds = table[:, HEADER + 4 : HEADER + 8].copy().view("<u4")[:, 0]
        position, _, effort = (table[:, part].copy().view("<f8") for part in self._arrays)
        rows = [(self._names, *both) for both in zip(position, effort, strict=True)]
        return (seconds * 1_000_000_000 + nanoseconds).tolist(), rows


def aligned(position: int, size: int) -> int:
    """Return the next position at a multiple of a size, counted from the end of the header."""
    return position + (HEADER - position) % size


def skip_text(data: bytes, position: int) -> int:
    """Return the position behind a text: its length and its bytes."""
    return position + COUNT.size + int(COUNT.unpack_from(data, position)[0])
