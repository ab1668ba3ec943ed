"""Writes messages as received to an MCAP file that `look`, `fit` and `replay` read."""

from __future__ import annotations

import time
from array import array
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore


class Recorder:
    """A recording in progress until it is closed; OSError if it cannot be written."""

    def __init__(self, folder: Path):
        folder.mkdir(parents=True, exist_ok=True)
        moment = time.strftime("%Y%m%dT%H%M%S", time.gmtime())
        names = (folder / f"raw-{moment}{end}" for end in ("", *(f"-{n}" for n in range(1, 100))))
        self.path = next(name for name in names if not name.exists())
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._topics: dict[str, Any] = {}
        self._writer = Writer(self.path, version=9, storage_plugin=StoragePlugin.MCAP)
        self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._writer.open()

    def write(self, channel: str, type: str, message: Any, received_ns: int) -> None:
        """Append a message of a standard type; ignore one of another type."""
        if type not in self._store.types:
            return
        if channel not in self._topics:
            self._topics[channel] = self._writer.add_connection(
                channel, type, typestore=self._store
            )
        data = self._store.serialize_cdr(_convert_message(message), type)
        self._writer.write(self._topics[channel], received_ns, data)

    def close(self) -> None:
        """Complete the file; until then it cannot be read."""
        self._writer.close()


def _convert_message(value: Any) -> Any:
    """Convert a message, or a field of one, to the objects that rosbags serializes.

    The bytes that rclpy serializes cannot be used: they are longer than the message.
    """
    if hasattr(value, "get_fields_and_field_types"):
        fields = value.get_fields_and_field_types()
        return SimpleNamespace(**{name: _convert_message(getattr(value, name)) for name in fields})
    return np.asarray(value) if isinstance(value, array) else value
