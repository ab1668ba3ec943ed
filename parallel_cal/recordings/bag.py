"""Read a recording on disk: rosbag2 (mcap or sqlite3), or a `.bag` of ROS 1. Other modules read
bags through this one."""

from __future__ import annotations

import contextlib
import hashlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from parallel_cal.base.errors import BagError, ParallelCalError
from parallel_cal.base.progress import Progress
from parallel_cal.recordings.channels import Channel, find_channel
from parallel_cal.recordings.cleaning import assemble
from parallel_cal.recordings.foreign_files import describe_foreign
from parallel_cal.recordings.joint_state_bytes import JointStateReader
from parallel_cal.recordings.mcap_files import MAGIC, ROS_2, McapFiles
from parallel_cal.recordings.options import ReadOptions
from parallel_cal.recordings.pose_bytes import PoseReader
from parallel_cal.recordings.pose_messages import (
    body_names,
    frame_of,
    read_pose,
    split_body,
    stamp_of,
)
from parallel_cal.recordings.recording import Raw, Recording, TopicInfo
from parallel_cal.recordings.ros1_files import Ros1File
from parallel_cal.recordings.standard_types import DEFINITIONS, collect_definitions
from parallel_cal.recordings.tf_chain import TF_TYPE, Transforms
from parallel_cal.recordings.topics import choose_topics

DATA_FILES = (".mcap", ".db3", ".zstd")
KINDS = {
    MAGIC: ".mcap",
    b"SQLite format 3\0": ".db3",
    b"#ROSBAG V": ".bag",
    b"\x28\xb5\x2f\xfd": ".zstd",
}
MAX_WAITING = 4096  # joint states that are read at once


def read_bag(
    path: str | Path, options: ReadOptions | None = None, progress: Progress | None = None
) -> Recording:
    """Read the channels of a bag.

    Single bad messages are dropped and counted; an unusable stream is a BagError.
    """
    options, path = options or ReadOptions(), Path(path)
    try:
        with _Bag(path) as bag:
            offer, images = (bag.topics, options.topics, bag.notes), bool(options.images)
            chosen = choose_topics(*offer, images, bool(options.passive_joints))
            raws = _read_messages(bag, chosen, options.topics, progress)
            recording = assemble(raws, options, str(path), bag.notes)
            if len(raws) == 1 and not recording.passive:
                choose_topics(*offer, images)  # names what else can be measured
            if options.images:
                recording = _add_images(bag, recording, options, progress)
        return replace(recording, sha256=data_hash(path), topics=bag.topics)
    except BagError as error:
        if str(path) in str(error):
            raise
        raise BagError(f"{path}: {error}") from None


def list_topics(path: str | Path) -> tuple[tuple[TopicInfo, ...], float]:
    """Return the topics of a bag and the duration of its log, in s."""
    with _Bag(Path(path)) as bag:
        return bag.topics, bag.reader.metadata.duration * 1e-9


@dataclass(frozen=True)
class RawMessage:
    """A message of the bag: topic, log time (ns) and its serialized bytes."""

    topic: str
    time: int
    data: bytes


def raw_messages(path: str | Path) -> Iterator[RawMessage]:
    """Yield every message of a bag in the order of its log; BagError if it cannot be read."""
    with _Bag(Path(path)) as bag:
        for connection, time, data in bag.messages(bag.connections):
            yield RawMessage(connection.topic, time, data)


def find_kind(file: Path) -> str:
    """Return the suffix of a data file by its first bytes, whatever its name is: `.mcap`, `.db3`,
    `.bag` (ROS 1) or `.zstd`; of another file its own."""
    with file.open("rb") as stream:
        begin = stream.read(16)
    return next((kind for magic, kind in KINDS.items() if begin.startswith(magic)), file.suffix)


def data_hash(path: str | Path) -> str:
    """Return the sha256 of a bag's data files in the order of their names, without metadata."""
    path, digest = Path(path), hashlib.sha256()
    for file in _data_files(path) if path.is_dir() else [path]:
        with file.open("rb") as stream:
            for block in iter(lambda: stream.read(1 << 20), b""):
                digest.update(block)
    return digest.hexdigest()


def _data_files(folder: Path) -> list[Path]:
    """Return the data files of a bag directory, sorted by name."""
    return sorted(file for file in folder.iterdir() if file.suffix in DATA_FILES)


class _Bag:
    """An open bag; every failure is a BagError that names the file and a remedy."""

    def __init__(self, path: Path) -> None:
        self.path, self.notes = path, list[str]()
        self.topics: tuple[TopicInfo, ...] = ()
        self.connections: list[Any] = []  # those whose messages can be read

    def __enter__(self) -> _Bag:
        file = self._openable()
        self.reader = self._open(file)
        counts = Counter[TopicInfo]()
        for c in self.reader.connections:
            encoding = c.ext.serialization_format or ROS_2
            counts[TopicInfo(c.topic, c.msgtype, 0, encoding)] += c.msgcount
        topics = [replace(topic, count=count) for topic, count in counts.items()]
        self.topics = tuple(sorted(topics, key=lambda t: t.name))
        if not self.reader.metadata.message_count:
            self.reader.close()
            raise BagError(f"{self.path}: the bag contains no message. Was anything published?")
        self.connections = [
            c for c in self.reader.connections if (c.ext.serialization_format or ROS_2) == ROS_2
        ]
        foreign = [f"{t.name} ({t.encoding})" for t in self.topics if t.encoding != ROS_2]
        if foreign:
            self.notes.append(
                f"{self.path}: not read, because only CDR messages of ROS 2 are: "
                f"{', '.join(foreign)}"
            )
        return self

    def __exit__(self, *_: object) -> None:
        self.reader.close()

    def _open(self, file: Path) -> Any:
        """Open the storage of a directory or data file; BagError if it is damaged."""
        from rosbags.rosbag2 import Reader

        if file.is_file() and find_kind(file) == ".bag":
            return self._open_ros1(file)
        try:
            storage: Any = Reader.STORAGE_PLUGINS["dir" if file.is_dir() else find_kind(file)](file)
            storage.open()
            found = storage.connections
            known = bool(found) or not storage.metadata.message_count
            if known and all(c.msgtype.count("/") == 2 for c in found):
                return storage
            storage.close()
            why: Exception = BagError("its channels or their types are not described")
        except Exception as error:  # a damaged file fails in any layer: struct, yaml, zstd, sqlite
            why = error
        files = _data_files(file) if file.is_dir() else [file]
        kinds = [find_kind(one) for one in files]
        try:
            if {*kinds} == {".mcap"}:
                storage = McapFiles(files)
            elif file.is_dir() and kinds == [".db3"]:
                storage = Reader.STORAGE_PLUGINS[".db3"](files[0])
            else:
                raise why
            storage.open()
        except Exception as error:  # the data are damaged, too
            raise self._damaged(why) from error
        if file.is_dir():
            reason = str(why).rstrip(".")
            self.notes.append(f"{file}: its data files are read without metadata.yaml ({reason})")
        return storage

    def _open_ros1(self, file: Path) -> Any:
        """Open a bag of ROS 1; BagError if it is damaged."""
        storage = Ros1File(file)
        try:
            storage.open()
        except Exception as error:  # a damaged file fails in any layer
            raise self._damaged(error, "'rosbag reindex' of ROS 1") from error
        return storage

    def _openable(self) -> Path:
        """Return the directory or data file to open; BagError if there is none."""
        if not self.path.exists():
            raise BagError(f"{self.path}: no such file or directory")
        if self.path.is_dir() and not (self.path / "metadata.yaml").exists():
            files = _data_files(self.path)
            if not files:
                raise BagError(
                    f"{self.path}: not a rosbag2 recording: it contains neither metadata.yaml "
                    f"nor a {', '.join(DATA_FILES)} file. Give the folder that 'ros2 bag "
                    "record' wrote."
                )
            if len(files) > 1:
                raise BagError(
                    f"{self.path}: no metadata.yaml; data files: "
                    f"{', '.join(f.name for f in files)}. "
                    "Give one data file, or rebuild it with 'ros2 bag reindex'."
                )
            self.notes.append(f"{self.path}: no metadata.yaml; read {files[0].name} directly")
            return self._require_data(files[0])
        if not self.path.is_dir():
            return self._require_data(self.path)
        return self.path

    def _require_data(self, file: Path) -> Path:
        """Return a data file that can be opened by itself; BagError if it is another file."""
        kind = find_kind(file)
        if kind in (".mcap", ".db3", ".bag"):
            return file
        if kind == ".zstd":
            raise BagError(
                f"{file}: compressed as a whole. Give the folder of the recording with its "
                f"metadata.yaml, or decompress the file with 'zstd -d {file.name}'"
            )
        if (foreign := describe_foreign(file)) is not None:
            raise BagError(f"{file}: {foreign}")
        raise BagError(
            f"{file}: not a recording; expected a bag directory, or an MCAP (.mcap), SQLite (.db3) "
            "or ROS 1 (.bag) file"
        )

    def messages(self, connections: list[Any]) -> Iterator[tuple[Any, int, bytes]]:
        """Yield (connection, log time in ns, bytes) of every message on some connections.

        rosbags passes over the messages of a topic in a data file, without an error, if
        metadata.yaml states another quality of service or hash of the type than the file. So the
        connections of the files themselves are asked for.
        """
        stored = [
            one for storage in getattr(self.reader, "storages", ()) for one in storage.connections
        ]
        asked = [
            mine._replace(ext=own.ext, digest=own.digest)
            for mine in connections
            for own in stored
            if (own.topic, own.msgtype) == (mine.topic, mine.msgtype)
        ]
        try:
            yield from self.reader.messages(connections=asked if stored else connections)
        except ParallelCalError:
            raise
        except Exception as error:
            raise self._damaged(error) from error

    def _damaged(
        self, error: Exception, tool: str = "'mcap recover' or 'ros2 bag reindex'"
    ) -> BagError:
        why = str(error).rstrip(".") or type(error).__name__
        return BagError(
            f"{self.path}: damaged or truncated ({why}). Recover it with {tool}, or record again "
            "and stop the recorder with Ctrl-C."
        )


def _read_messages(
    bag: _Bag,
    chosen: Mapping[str, TopicInfo],
    topics: Mapping[str, str],
    progress: Progress | None,
) -> dict[str, Raw]:
    """Decode the chosen topics' messages in one pass."""
    raws = {channel: Raw(topic.name, topic.type) for channel, topic in chosen.items()}
    decoders = {
        (raw.topic, raw.type): _Decoder(channel, raw, split_body(topics.get(name, ""))[1])
        for name, raw in raws.items()
        if (channel := find_channel(name))
    }
    connections = [c for c in bag.connections if (c.topic, c.msgtype) in decoders]
    store = _type_store(connections)
    total = max(1, sum(c.msgcount for c in connections))
    for i, (connection, log, data) in enumerate(bag.messages(connections)):
        decoders[connection.topic, connection.msgtype].take(store, log, data)
        if progress and i % 2000 == 0:
            progress(f"reading {bag.path.name}", i / total)
    for decoder in decoders.values():
        decoder.read_waiting()
        if decoder.needs_chain:
            _compose_chain(bag, decoder)
        decoder.require_body()
    if progress:
        progress(f"read {bag.path.name}", 1.0)
    return raws


def _compose_chain(bag: _Bag, decoder: _Decoder) -> None:
    """Compose poses of `PARENT->CHILD` that no message states directly, over the frames between."""
    connections = [c for c in bag.connections if c.msgtype == TF_TYPE]
    store, found = _type_store(connections), Transforms()
    for connection, log, data in bag.messages(connections):
        with contextlib.suppress(Exception):  # no message; `decoder` has counted it
            found.take(store.deserialize_cdr(data, TF_TYPE), log, connection.topic)
    parent, _, child = decoder.body.partition("->")
    bag.notes.append(found.compose(parent.strip("/"), child.strip("/"), decoder.raw))


def _add_images(
    bag: _Bag, recording: Recording, options: ReadOptions, progress: Progress | None
) -> Recording:
    """Add the corners of a board in the images of each camera, and the lens that it states.

    The joints were read before: they tell which images were taken at rest.
    """
    from parallel_cal.imaging.messages import CAMERA_INFO, COMPRESSED, IMAGE, describe_lens
    from parallel_cal.recordings.images import ImageReader, camera_topics

    streams, dropped = dict(recording.distances), [*recording.dropped]
    notes = [*recording.notes]
    for camera, topic in camera_topics(options.images).items():
        chosen = [
            c
            for c in bag.connections
            if c.topic.strip("/") == topic.strip("/") and c.msgtype in (IMAGE, COMPRESSED)
        ]
        if not sum(c.msgcount for c in chosen):
            there = [f"{t.name} [{t.type}] {t.count}" for t in bag.topics]
            raise BagError(
                f"no images on topic '{topic}' (images): expected {IMAGE} or {COMPRESSED}. "
                f"In the bag: {'; '.join(there)}"
            )
        folder = chosen[0].topic.removesuffix("/compressed").rpartition("/")[0]
        beside = f"{folder}/camera_info"
        lenses = [c for c in bag.connections if c.msgtype == CAMERA_INFO and c.topic == beside]
        reader = ImageReader(camera, chosen[0].topic, recording, options)
        store, lens = _type_store([*chosen, *lenses]), ""
        total = sum(c.msgcount for c in chosen)
        for connection, log, data in bag.messages([*chosen, *lenses]):
            try:
                message = store.deserialize_cdr(data, connection.msgtype)
            except Exception:  # bytes that are not a message fail in any manner; they are counted
                reader.add_problem("message cannot be decoded", log)
                continue
            if connection.msgtype == CAMERA_INFO:
                lens = lens or describe_lens(message)
            else:
                reader.take(log, message)
            if progress and reader.count % 50 == 0:
                progress(f"reading images of {bag.path.name}", reader.count / total)
        found, unusable, said = reader.finish()
        streams |= found
        dropped += unusable
        notes += said
        if lens:
            notes.append(f"{camera}: {beside} states the lens; sensor: camera: {{{lens}}}")
    return replace(recording, distances=streams, dropped=tuple(dropped), notes=tuple(notes))


class _Decoder:
    """Appends the messages of one topic to its rows; of a list of bodies, only the named one."""

    def __init__(self, channel: Channel, raw: Raw, body: str):
        self.channel, self.raw, self.body = channel, raw, body
        self.others: set[str] = set()  # bodies in messages that lack the named one
        self.joint_states = JointStateReader()
        self.frame = ""  # of the joint states that the reader knows
        self.waiting: list[tuple[int, bytes]] = []  # joint states that the reader knows
        self.poses = PoseReader(raw.type)

    def take(self, store: Any, log: int, data: bytes) -> None:
        if self.joint_states.fits(data):
            self.waiting.append((log, data))
            if len(self.waiting) == MAX_WAITING:
                self.read_waiting()
            return
        self.read_waiting()
        try:
            if (known := self.poses.read(data)) is not None:
                self.raw.append(log, *known)
                return
            message = store.deserialize_cdr(data, self.raw.type)
            if self.channel.kind == "joints":
                row = self.channel.decode(message)
                self.frame = frame_of(message)
                self.raw.append(log, stamp_of(message), row, self.frame)
                self.joint_states.learn(data, row[0])
            elif self.channel.kind != "poses":
                row = self.channel.decode(message)
                self.raw.append(log, stamp_of(message), row, frame_of(message))
            elif (found := read_pose(message, self.body)) is not None:
                self.raw.append(log, *found)
                self.poses.learn(data, found[1][0])
            else:
                self.others.update(body_names(message))
        except BagError as error:
            raise BagError(f"{self.raw.topic}: {error}") from None
        except Exception:  # bytes that are not a message fail in any manner; they are counted
            self.raw.undecodable += 1

    def read_waiting(self) -> None:
        """Read the joint states that wait, all at once."""
        if not self.waiting:
            return
        logs, messages = zip(*self.waiting, strict=True)
        stamps, rows = self.joint_states.read(messages)
        self.raw.log += logs
        self.raw.stamp += stamps
        self.raw.rows += rows
        self.raw.origins += [self.frame] * len(rows)
        self.waiting.clear()

    @property
    def needs_chain(self) -> bool:
        """Whether the body is a frame in another one that no message states directly."""
        named = self.raw.type == TF_TYPE and "->" in self.body
        return self.channel.kind == "poses" and named and not self.raw.rows

    def require_body(self) -> None:
        """Raise BagError if no message had the named body, or any pose at all."""
        if self.channel.kind != "poses" or self.raw.rows or self.raw.undecodable:
            return
        if self.others:
            raise BagError(
                f"{self.raw.topic}: no body '{self.body}' in its messages; they hold "
                f"{', '.join(sorted(self.others))}"
            )
        raise BagError(
            f"{self.raw.topic}: messages of type {self.raw.type} hold no pose, transform or point. "
            "If the driver also publishes tf, name that: measured_pose=/tf:PARENT->CHILD"
        )


def _type_store(connections: Sequence[Any]) -> Any:
    """Return the message types: the standard ones of Jazzy, and others as the bag defines them.

    A bag's own definition of a standard type is not used, so that it cannot interfere.
    """
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    types = {connection.msgtype for connection in connections}
    if types <= DEFINITIONS.keys():
        store, fields = get_typestore(Stores.EMPTY), dict[str, Any]()
        for name, text in collect_definitions(types).items():
            fields |= get_types_from_msg(text, name)
        store.register(fields)
        return store
    store = get_typestore(Stores.ROS2_JAZZY)
    for connection in connections:
        if connection.msgtype in store.types:
            continue
        text = getattr(connection.msgdef, "data", "")
        if not text:
            raise BagError(
                f"{connection.topic}: its type {connection.msgtype} is not a standard one, and the "
                "bag does not hold its definition: record as mcap (ros2 bag record -s mcap)"
            )
        own = get_types_from_msg(text, connection.msgtype)
        store.register({name: fields for name, fields in own.items() if name not in store.types})
    return store
