"""Read MCAP files that hold more than a ROS 2 recording, or do not say that they hold one.

The library that reads rosbag2 recordings refuses a file with a channel of another encoding (JSON,
protobuf), with another profile or with an unusual name. These files are sound. Here every record of
a file is checked, and its CDR channels, the messages of ROS 2, are read.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

MAGIC = b"\x89MCAP0\r\n"
ROS_2 = "cdr"  # the message encoding of ROS 2


@dataclass(frozen=True)
class McapConnection:
    """A channel of a topic: message type, encoding, definition of the type, number of messages."""

    topic: str
    msgtype: str
    encoding: str
    definition: str
    msgcount: int = 0

    @property
    def ext(self) -> Any:
        """The encoding as the reader of rosbag2 recordings gives it."""
        return SimpleNamespace(serialization_format=self.encoding)

    @property
    def msgdef(self) -> Any:
        """The definition as the reader of rosbag2 recordings gives it."""
        return SimpleNamespace(data=self.definition)


@dataclass
class McapFiles:
    """MCAP files of one recording, in their order, with the interface of a rosbag2 storage."""

    paths: Sequence[Path]
    connections: list[McapConnection] = field(default_factory=list)

    def open(self) -> None:
        """Read every record, so that a damaged file raises an error."""
        counts, times = Counter[McapConnection](), list[int]()
        for connection, time, _ in self.read():
            counts[connection] += 1
            times.append(time)
        self.connections = [replace(one, msgcount=count) for one, count in counts.items()]
        duration = max(times) - min(times) + 1 if times else 0
        self.metadata = SimpleNamespace(message_count=len(times), duration=duration)

    def close(self) -> None:
        """Do nothing: no file stays open."""

    def messages(self, connections: Collection[Any]) -> list[tuple[Any, int, bytes]]:
        """Return (connection, log time in ns, bytes) in the order of the log."""
        wanted = {replace(one, msgcount=0): one for one in connections}
        found = [(wanted[one], *more) for one, *more in self.read() if one in wanted]
        return sorted(found, key=lambda message: message[1])

    def read(self) -> Iterator[tuple[McapConnection, int, bytes]]:
        """Yield (connection, log time in ns, bytes) of each message in the order of the files; any
        error of the library if a file is damaged or has no end."""
        from mcap.records import Channel, Message, Schema
        from mcap.stream_reader import StreamReader

        for path in self.paths:
            schemas, channels = dict[int, Schema](), dict[int, McapConnection]()
            with path.open("rb") as stream:
                for record in StreamReader(stream, validate_crcs=True).records:
                    if isinstance(record, Schema):
                        schemas[record.id] = record
                    elif isinstance(record, Channel):
                        schema = schemas.get(record.schema_id)
                        channels[record.id] = describe_channel(record, schema)
                    elif isinstance(record, Message):
                        yield channels[record.channel_id], record.log_time, record.data


def describe_channel(channel: Any, schema: Any) -> McapConnection:
    """Return the connection of a channel. Types have the names of ROS 2: `sensor_msgs/JointState`
    is `sensor_msgs/msg/JointState`."""
    kind = schema.name if schema else ""
    if channel.message_encoding == ROS_2 and kind.count("/") == 1:
        kind = kind.replace("/", "/msg/")
    text = schema.data.decode(errors="replace") if schema and schema.encoding == "ros2msg" else ""
    return McapConnection(channel.topic, kind, channel.message_encoding or "no encoding", text)
