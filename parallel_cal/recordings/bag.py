"""A recording on disk (rosbag2: mcap or sqlite3) -> channels; the only file that opens a bag."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from parallel_cal.base.errors import BagError, ParallelCalError
from parallel_cal.recordings.cleaning import assemble
from parallel_cal.recordings.recording import Progress, Raw, Recording, TopicInfo, Topics
from parallel_cal.recordings.topics import (
    CONSTRAINT,
    DISTANCE,
    JOINTS,
    PAYLOAD,
    POINTS,
    POSES,
    TEMPERATURE,
    choose_topics,
)

DATA_FILES = (".mcap", ".db3", ".zstd")


def read_bag(
    path: str | Path,
    topics: Topics | None = None,
    *,
    joints: Sequence[str] | None = None,
    measures: Sequence[str] | None = None,
    stamps: str = "header",
    progress: Progress | None = None,
) -> Recording:
    """Read joint states, poses, what holds the tip, distances, temperature and payload of a bag.

    `joints` gives the joints' names in the model's order (default: as recorded), `measures` the
    coordinates the device really measures (default: what the messages say), `stamps` is "header"
    or "log". Single bad messages are dropped and counted; an unusable stream is a BagError.
    """
    if stamps not in ("header", "log"):
        raise BagError(f"stamps='{stamps}' unknown; expected 'header' or 'log'")
    notes: list[str] = []
    path = Path(path)
    try:
        with _Bag(path, notes) as bag:
            chosen = choose_topics(bag.topics, topics or Topics(), notes)
            raws = _read_messages(bag, chosen, progress)
        return assemble(
            raws["joints"],
            raws.get("pose"),
            temperature=raws.get("temperature"),
            payload=raws.get("payload"),
            constraint=raws.get("constraint"),
            distance=raws.get("distance"),
            joint_names=joints,
            measures=measures,
            stamps=stamps,
            source=str(path),
            sha256=data_hash(path),
            topics=bag.topics,
            notes=notes,
        )
    except BagError as error:
        if str(path) in str(error):
            raise
        raise BagError(f"{path}: {error}") from None


def list_topics(path: str | Path) -> tuple[tuple[TopicInfo, ...], float]:
    """The topics of a bag and the time it spans by its log, in s."""
    with _Bag(Path(path), []) as bag:
        return bag.topics, bag.reader.duration * 1e-9


@dataclass(frozen=True)
class RawMessage:
    """A message as it lies in the bag: topic, type, log time (ns) and its serialized bytes."""

    topic: str
    type: str
    time: int
    data: bytes


def raw_messages(path: str | Path) -> Iterator[RawMessage]:
    """Every message of a bag in the order of its log; BagError where it cannot be read."""
    with _Bag(Path(path), []) as bag:
        for connection, time, data in bag.messages(list(bag.reader.connections)):
            yield RawMessage(connection.topic, connection.msgtype, time, data)


def data_hash(path: str | Path) -> str:
    """sha256 of a bag's data files in the order of their names, without its metadata."""
    path, digest = Path(path), hashlib.sha256()
    for file in _data_files(path) if path.is_dir() else [path]:
        with file.open("rb") as stream:
            for block in iter(lambda: stream.read(1 << 20), b""):
                digest.update(block)
    return digest.hexdigest()


def _data_files(folder: Path) -> list[Path]:
    """The data files of a bag directory, sorted by name."""
    return sorted(file for file in folder.iterdir() if file.suffix in DATA_FILES)


class _Bag:
    """An open bag whose every failure is a BagError that names the file and a way out."""

    def __init__(self, path: Path, notes: list[str]) -> None:
        self.path, self.notes = path, notes
        self.topics: tuple[TopicInfo, ...] = ()

    def __enter__(self) -> _Bag:
        from rosbags.rosbag2 import Reader

        file = self._openable()
        try:
            self.reader: Any = Reader(file)
            self.reader.open()
        except Exception as error:  # a damaged file fails in any layer: struct, yaml, zstd, sqlite
            raise self._damaged(error) from error
        counts = [TopicInfo(c.topic, c.msgtype, c.msgcount) for c in self.reader.connections]
        self.topics = tuple(sorted(counts, key=lambda t: t.name))
        if not self.reader.message_count:
            self.reader.close()
            raise BagError(f"{self.path}: the bag holds no message. Was anything published?")
        return self

    def __exit__(self, *_: object) -> None:
        self.reader.close()

    def _openable(self) -> Path:
        """The directory or data file to open; BagError when there is none."""
        if not self.path.exists():
            raise BagError(f"{self.path}: no such file or directory")
        if self.path.is_dir() and not (self.path / "metadata.yaml").exists():
            files = _data_files(self.path)
            if len(files) != 1:
                raise BagError(self._no_metadata(files))
            self.notes.append(f"{self.path}: no metadata.yaml; read {files[0].name} directly")
            return files[0]
        if self.path.is_file() and self.path.suffix not in (".mcap", ".db3"):
            raise BagError(
                f"{self.path}: not a rosbag2 recording; expected a bag directory, .mcap or .db3 "
                "(convert a ROS 1 .bag with 'rosbags-convert')"
            )
        return self.path

    def _no_metadata(self, files: list[Path]) -> str:
        if not files:
            return (
                f"{self.path}: not a rosbag2 recording: it holds neither metadata.yaml nor a "
                f"{', '.join(DATA_FILES)} file. Give the folder that 'ros2 bag record' wrote."
            )
        return (
            f"{self.path}: no metadata.yaml; data files: {', '.join(f.name for f in files)}. "
            "Give one data file, or rebuild it with 'ros2 bag reindex'."
        )

    def messages(self, connections: list[Any]) -> Iterator[tuple[Any, int, bytes]]:
        """(connection, log time in ns, bytes) of every message on some connections."""
        try:
            yield from self.reader.messages(connections=connections)
        except ParallelCalError:
            raise
        except Exception as error:
            raise self._damaged(error) from error

    def _damaged(self, error: Exception) -> BagError:
        why = str(error).rstrip(".") or type(error).__name__
        return BagError(
            f"{self.path}: damaged or cut short ({why}). Recover it with 'mcap recover' or "
            "'ros2 bag reindex', or record again and stop the recorder with Ctrl-C."
        )


def _read_messages(
    bag: _Bag, chosen: dict[str, TopicInfo], progress: Progress | None
) -> dict[str, Raw]:
    """Decode the chosen topics' messages in one pass."""
    from rosbags.typesys import Stores, get_typestore

    # the standard types as Jazzy defines them: a bag's odd custom definitions cannot get in the way
    store = get_typestore(Stores.ROS2_JAZZY)
    raws = {channel: Raw(topic.name, topic.type) for channel, topic in chosen.items()}
    targets = {(raw.topic, raw.type): raw for raw in raws.values()}
    connections = [c for c in bag.reader.connections if (c.topic, c.msgtype) in targets]
    total = max(1, sum(c.msgcount for c in connections))
    for i, (connection, log, data) in enumerate(bag.messages(connections)):
        _decode(targets[connection.topic, connection.msgtype], log, data, store)
        if progress and i % 2000 == 0:
            progress(i / total, f"reading {bag.path.name}")
    if progress:
        progress(1.0, f"read {bag.path.name}")
    return raws


def _decode(raw: Raw, log: int, data: bytes, store: Any) -> None:
    """Append one message's time and content to its topic."""
    try:
        message = store.deserialize_cdr(data, raw.type)
        row = MESSAGE_ROWS[raw.type](message)
    except Exception:  # bytes that are no message fail in any way; they are counted
        raw.undecodable += 1
        return
    raw.log.append(log)
    raw.stamp.append(stamp_of(message))
    raw.rows.append(row)


def stamp_of(message: Any) -> int:
    """The time in a message's header in ns; 0 where it has no header."""
    if not hasattr(message, "header"):
        return 0
    stamp = message.header.stamp
    return int(stamp.sec * 1_000_000_000 + stamp.nanosec)


def _joint_row(message: Any) -> tuple:
    return tuple(message.name), message.position, message.effort


def _pose_row(message: Any) -> tuple:
    return _frame_and_pose(message, message.pose, None)


def _covariant_row(message: Any) -> tuple:
    return _frame_and_pose(message, message.pose.pose, message.pose.covariance)


def _frame_and_pose(message: Any, pose: Any, covariance: Any) -> tuple:
    p, o = pose.position, pose.orientation
    return message.header.frame_id, (p.x, p.y, p.z), (o.x, o.y, o.z, o.w), covariance


def _point_row(message: Any) -> tuple:
    p = message.point
    return message.header.frame_id, (p.x, p.y, p.z), None, None


MESSAGE_ROWS: dict[str, Callable[[Any], tuple]] = {
    JOINTS[0]: _joint_row,
    POSES[0]: _covariant_row,
    POSES[1]: _pose_row,
    POINTS[0]: _point_row,
    TEMPERATURE[0]: lambda message: (message.temperature,),
    PAYLOAD[0]: lambda message: (message.inertia.m,),
    CONSTRAINT[0]: lambda message: (message.data,),
    DISTANCE[0]: lambda message: (message.header.frame_id, message.range),
}
