"""Read serialized joint states whose names are those of an earlier message, without decoding them.

Almost all messages of a recording are joint states, and their names and frame do not change. Only
the numbers behind them are read then. Reading a recording takes little more than half the time.
"""

from __future__ import annotations

from struct import Struct

import numpy as np

LITTLE_ENDIAN = b"\x00\x01"  # the first bytes of plain CDR (OMG DDSI-RTPS 10.5)
HEADER = 4  # bytes before the message; alignment counts from there
_STAMP = Struct("<iI")
_COUNT = Struct("<I")


class JointStateReader:
    """The bytes from frame to names of the last message that was decoded, and its names."""

    def __init__(self) -> None:
        self._constant = b""
        self._names: tuple[str, ...] = ()

    def learn(self, data: bytes, names: tuple[str, ...]) -> None:
        """Remember the bytes that hold the frame and these names, after a message was decoded."""
        if data[:2] != LITTLE_ENDIAN:
            return
        end = _skip_text(data, HEADER + _STAMP.size)
        end = _aligned(end, 4) + _COUNT.size
        for _ in names:
            end = _skip_text(data, _aligned(end, 4))
        self._constant, self._names = bytes(data[HEADER + _STAMP.size : end]), names

    def read(self, data: bytes) -> tuple[int, tuple] | None:
        """Return the stamp (ns) and the row (names, positions, efforts); None for another layout.

        The message must end where its last array ends, give or take the padding.
        """
        begin = HEADER + _STAMP.size
        end = begin + len(self._constant)
        if not self._constant or data[:2] != LITTLE_ENDIAN or data[begin:end] != self._constant:
            return None
        arrays = []
        for _ in ("position", "velocity", "effort"):
            end = _aligned(end, 4)
            if end + _COUNT.size > len(data):
                return None
            (count,) = _COUNT.unpack_from(data, end)
            end += _COUNT.size
            if count:
                end = _aligned(end, 8)
                if end + 8 * count > len(data):
                    return None
                arrays.append(np.frombuffer(data, "<f8", count, end))
                end += 8 * count
            else:
                arrays.append(np.empty(0))
        if len(data) - end >= 4:
            return None
        seconds, nanoseconds = _STAMP.unpack_from(data, HEADER)
        return seconds * 1_000_000_000 + nanoseconds, (self._names, arrays[0], arrays[2])


def _aligned(position: int, size: int) -> int:
    """The next position at a multiple of a size, counted from the end of the header."""
    return position + (HEADER - position) % size


def _skip_text(data: bytes, position: int) -> int:
    """The position behind a text: its length and its bytes."""
    return position + _COUNT.size + int(_COUNT.unpack_from(data, position)[0])
