"""Messages as they came, as an MCAP that `look`, `fit` and `replay` take."""

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
    """A recording that goes on until it is closed; OSError where it cannot be written."""

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
        """Append one message of a standard type; others are left out."""
        if type not in self._store.types:
            return
        if channel not in self._topics:
            self._topics[channel] = self._writer.add_connection(
                channel, type, typestore=self._store
            )
        data = self._store.serialize_cdr(_bare(message), type)
        self._writer.write(self._topics[channel], received_ns, data)

    def close(self) -> None:
        """Finish the file; before, it is not whole."""
        self._writer.close()


def _bare(value: Any) -> Any:
    """A message as rosbags writes it; what rclpy serializes is longer than it says."""
    if hasattr(value, "get_fields_and_field_types"):
        fields = value.get_fields_and_field_types()
        return SimpleNamespace(**{name: _bare(getattr(value, name)) for name in fields})
    return np.asarray(value) if isinstance(value, array) else value
