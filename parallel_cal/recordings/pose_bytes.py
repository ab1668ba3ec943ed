"""Read serialized poses whose frame is that of an earlier message, without decoding them.

Behind the frame, a message of one pose holds nothing but numbers.
"""

from __future__ import annotations

import numpy as np

from parallel_cal.recordings.joint_state_bytes import (
    HEADER,
    LITTLE_ENDIAN,
    STAMP,
    aligned,
    skip_text,
)

# The number of values behind the frame: position, quaternion, covariance.
VALUES = {
    "geometry_msgs/msg/PoseStamped": 7,
    "geometry_msgs/msg/PoseWithCovarianceStamped": 7 + 36,
}


class PoseReader:
    """The bytes of the frame of the last message that was decoded."""

    def __init__(self, type: str) -> None:
        self._values = VALUES.get(type, 0)
        self._constant = b""
        self._frame = ""

    def learn(self, data: bytes, frame: str) -> None:
        """Remember the bytes that hold this frame, after a message was decoded."""
        if data[:2] == LITTLE_ENDIAN and self._values:
            begin = HEADER + STAMP.size
            self._constant, self._frame = bytes(data[begin : skip_text(data, begin)]), frame

    def read(self, data: bytes) -> tuple[int, tuple] | None:
        """Return the stamp (ns) and the row (frame, position, quaternion, covariance or None).

        None for another layout. The message must end where its values end, give or take the
        padding.
        """
        begin = HEADER + STAMP.size
        end = begin + len(self._constant)
        if not self._constant or data[:2] != LITTLE_ENDIAN or data[begin:end] != self._constant:
            return None
        offset = aligned(end, 8)
        if not 0 <= len(data) - offset - 8 * self._values < 4:
            return None
        seconds, nanoseconds = STAMP.unpack_from(data, HEADER)
        values = np.frombuffer(data, "<f8", self._values, offset)
        x, y, z, qx, qy, qz, qw = values[:7].tolist()
        covariance = values[7:] if self._values > 7 else None
        row = (self._frame, (x, y, z), (qx, qy, qz, qw), covariance)
        return seconds * 1_000_000_000 + nanoseconds, row
