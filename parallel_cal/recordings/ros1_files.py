"""Read a bag of ROS 1 as if it were a recording of ROS 2.

The messages are converted one by one by the definitions that the bag itself holds, so that all
other modules see messages of ROS 2 only.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from parallel_cal.recordings.mcap_files import ROS_2, McapConnection

RENAMED = {"tf/msg/tfMessage": "tf2_msgs/msg/TFMessage"}  # types with another name in ROS 2
Convert = Callable[[bytes], Any]


@dataclass
class Ros1File:
    """A `.bag` file, with the interface of a rosbag2 storage."""

    path: Path
    connections: list[McapConnection] = field(default_factory=list)

    def open(self) -> None:
        """Read the index of the file; any error of the library if it is damaged."""
        from rosbags.rosbag1 import Reader
        from rosbags.typesys import Stores, get_typestore

        self._reader = Reader(self.path)
        self._reader.open()
        self._own, self._ros2 = get_typestore(Stores.EMPTY), get_typestore(Stores.ROS2_JAZZY)
        self._found: dict[int, McapConnection] = {}
        self._converters: dict[str, Convert] = {}
        for one in self._reader.connections:
            converted = self._register(one)
            self._found[one.id] = McapConnection(one.topic, *converted, one.msgcount)
        self.connections = [*self._found.values()]
        self.metadata = SimpleNamespace(
            message_count=self._reader.message_count, duration=self._reader.duration
        )

    def close(self) -> None:
        """Close the file."""
        self._reader.close()

    def messages(self, connections: Collection[Any]) -> Iterator[tuple[Any, int, bytes]]:
        """Yield (connection, log time in ns, bytes of the message in ROS 2)."""
        wanted = [one for one in self._reader.connections if self._found[one.id] in connections]
        for connection, time, data in self._reader.messages(connections=wanted):
            # Of bytes that are no message, none are left: the decoder counts them.
            try:
                data = bytes(self._converters[connection.msgtype](data))
            except Exception:
                data = b""
            yield self._found[connection.id], time, data

    def _register(self, connection: Any) -> tuple[str, str, str]:
        """Make the converter of a connection; return its type in ROS 2, encoding and definition."""
        from rosbags.convert.converter import generate_message_converter
        from rosbags.typesys import get_types_from_msg

        kind = connection.msgtype
        fields = get_types_from_msg(connection.msgdef.data, kind)
        self._own.register({n: f for n, f in fields.items() if n not in self._own.fielddefs})
        name = RENAMED.get(kind, kind)
        self._ros2.register({n: f for n, f in fields.items() if n not in self._ros2.fielddefs})
        self._converters[kind] = generate_message_converter(
            self._own, self._ros2, kind, name, {}, src_is2=False, dst_is2=True
        )
        return name, ROS_2, self._ros2.generate_msgdef(name, ros_version=2)[0]
