"""Write a simulated session or messages as a recording; the only module that writes a bag."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from heapq import merge
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from parallel_cal.base.arguments import check_arguments
from parallel_cal.base.errors import BagError
from parallel_cal.recordings.channels import CHANNELS

if TYPE_CHECKING:
    from parallel_cal.recordings.recording import PoseStream, ScalarStream, TextStream
    from parallel_cal.recordings.simulate import Simulation

START = 1_767_225_600_000_000_000  # ns, 2026-01-01 00:00:00 UTC: equal seeds give equal files
STORAGES = ("mcap", "sqlite3")
WRITTEN_CHANNELS = ("payload", "temperature", "joint_states", "measured_pose")


@check_arguments(BagError)
def write_bag(session: Simulation, path: str | Path, storage: str = "mcap") -> None:
    """Write a simulated session as a rosbag2 folder.

    Parameters
    ----------
    session : Simulation
    path : str or Path
        A folder that does not exist yet. It is written completely or not at all.
    storage : str, optional
        `"mcap"` or `"sqlite3"`.

    Raises
    ------
    BagError
        If the folder exists or cannot be written.

    Examples
    --------
    >>> import parallel_cal as pc
    >>> from tempfile import mkdtemp
    >>> path = mkdtemp() + "/bag"
    >>> pc.write_bag(pc.simulate(pc.new_model("delta24"), 5), path)
    >>> len(pc.load_dataset(path))
    5
    """
    if storage not in STORAGES:
        raise BagError(f"storage '{storage}' unknown; expected {' or '.join(STORAGES)}")
    messages = _Session()
    others = {
        "distance": bool(session.recording.distances),
        "constraint": session.recording.constraint is not None,
    }
    written = [*WRITTEN_CHANNELS, *(name for name, is_written in others.items() if is_written)]
    kinds = {name: CHANNELS[name].types[0] for name in written}
    # A long session has millions of messages: make each when it is written.
    stream = merge(*messages.streams(session), key=lambda m: m[0])
    data = ((n, t, messages.store.serialize_cdr(m, kinds[n])) for t, n, m in stream)
    latched = {name for name in written if CHANNELS[name].latched}
    _write(Path(path), kinds, data, latched, storage, lambda folder: folder)


def write_messages(
    path: str | Path,
    kinds: Mapping[str, str],
    messages: Iterable[tuple[str, int, Any]],
    latched: Container[str],
) -> None:
    """Write messages (topic, stamp in ns, bytes) as an MCAP file; `kinds` are the topics' types."""
    _write(Path(path), kinds, messages, latched, "mcap", lambda folder: next(folder.glob("*.mcap")))


def _write(
    target: Path,
    kinds: Mapping[str, str],
    messages: Iterable[tuple[str, int, Any]],
    latched: Container[str],
    storage: str,
    wanted: Callable[[Path], Path],
) -> None:
    """Write completely or not at all; `wanted` selects what is moved to the target."""
    if target.exists():
        raise BagError(f"{target}: already exists; remove it or give another name")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=target.parent, prefix=".bag") as scratch:
            # The writer names the data file after its folder.
            folder = Path(scratch) / target.name
            _record(folder, kinds, messages, latched, storage)
            shutil.move(wanted(folder), target)
    except OSError as error:
        raise BagError(f"{target}: cannot be written: {error.strerror or error}") from None


def _record(
    folder: Path,
    kinds: Mapping[str, str],
    messages: Iterable[tuple[str, int, Any]],
    latched: Container[str],
    storage: str,
) -> None:
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    store = Messages().store
    writer = Writer(folder, version=9, storage_plugin=StoragePlugin[storage.upper()])
    if storage == "mcap":  # compresses within the file; sqlite3 could only be packed as a whole
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        topics = {
            name: writer.add_connection(
                name, kind, typestore=store, offered_qos_profiles=[_quality(name in latched)]
            )
            for name, kind in kinds.items()
        }
        for name, stamp, data in messages:
            writer.write(topics[name], stamp, data)


def _quality(latched: bool) -> Any:
    """Return a reliable quality of service; a latched topic also reaches late subscribers."""
    from rosbags import interfaces as qos

    forever, durability = qos.QosTime(9223372036, 854775807), qos.QosDurability
    return qos.Qos(
        qos.QosHistory.KEEP_LAST,
        1 if latched else 10,
        qos.QosReliability.RELIABLE,
        durability.TRANSIENT_LOCAL if latched else durability.VOLATILE,
        forever,
        forever,
        qos.QosLiveliness.AUTOMATIC,
        forever,
        False,
    )


class Messages:
    """Makes ROS messages without ROS."""

    @cached_property
    def store(self) -> Any:
        from rosbags.typesys import Stores, get_typestore

        return get_typestore(Stores.ROS2_JAZZY)

    def kind(self, name: str) -> Any:
        return self.store.types[name.replace("/", "/msg/")]

    def header(self, stamp: int, frame: str = "") -> Any:
        time = self.kind("builtin_interfaces/Time")(stamp // 10**9, stamp % 10**9)
        return self.kind("std_msgs/Header")(time, frame)

    def vector(self, of: np.ndarray) -> Any:
        return self.kind("geometry_msgs/Vector3")(*of.tolist())

    def point(self, of: np.ndarray) -> Any:
        return self.kind("geometry_msgs/Point")(*of.tolist())

    def pose(self, position: np.ndarray, quaternion: np.ndarray) -> Any:
        turn = self.kind("geometry_msgs/Quaternion")(*quaternion.tolist())
        return self.kind("geometry_msgs/Pose")(self.point(position), turn)

    def joint_state(self, stamp: int, names: Sequence[str], q: np.ndarray) -> Any:
        """Return a joint state with positions only: an encoder knows no velocity or effort."""
        kind, nothing = self.kind("sensor_msgs/JointState"), np.zeros(0)
        return kind(self.header(stamp), list(names), q, nothing, nothing)


class _Session(Messages):
    """Makes the ROS messages of a simulated session: (stamp in ns, topic, message)."""

    def streams(self, session: Simulation) -> list[Iterator[tuple[int, str, Any]]]:
        """Return the messages of each topic, in the order of their stamps."""
        recording, frames = session.recording, session.model.frames
        payload, temperature = (recording.conditions[name] for name in ("payload", "temperature"))
        joints = recording.joints
        return [
            self._payloads(payload, frames["platform"]),
            self._temperatures(temperature),
            (
                (time, "joint_states", self.joint_state(time, joints.names, q))
                for time, q in zip(_stamps(joints.time), joints.position, strict=True)
            ),
            self._poses(recording.pose),
            *(self._readings(name, stream) for name, stream in recording.distances.items()),
            *([] if recording.constraint is None else [self._contacts(recording.constraint)]),
        ]

    def _payloads(self, payload: ScalarStream, frame: str) -> Iterator[tuple[int, str, Any]]:
        stamped, kind = (self.kind(f"geometry_msgs/Inertia{end}") for end in ("Stamped", ""))
        for time, mass in zip(_stamps(payload.time), payload.value, strict=True):
            # A point mass at the platform's origin.
            inertia = kind(float(mass), self.vector(np.zeros(3)), *[0.0] * 6)
            yield time, "payload", stamped(self.header(time, frame), inertia)

    def _temperatures(self, temperature: ScalarStream) -> Iterator[tuple[int, str, Any]]:
        air = self.kind("sensor_msgs/Temperature")
        for time, warmth in zip(_stamps(temperature.time), temperature.value, strict=True):
            yield time, "temperature", air(self.header(time), float(warmth), 0.01)

    def _readings(self, channel: str, stream: ScalarStream) -> Iterator[tuple[int, str, Any]]:
        kind = self.kind("sensor_msgs/Range")
        for time, value in zip(_stamps(stream.time), stream.value, strict=True):
            header = self.header(time, channel)
            yield time, "distance", kind(header, 0, 0.0, -np.inf, np.inf, float(value), 0.0)

    def _contacts(self, contacts: TextStream) -> Iterator[tuple[int, str, Any]]:
        kind = self.kind("std_msgs/String")
        for time, name in zip(_stamps(contacts.time), contacts.value, strict=True):
            yield time, contacts.topic, kind(name)

    def _poses(self, pose: PoseStream) -> Iterator[tuple[int, str, Any]]:
        kind, stamped = (
            self.kind(f"geometry_msgs/PoseWithCovariance{end}") for end in ("", "Stamped")
        )
        for i, time in enumerate(_stamps(pose.time)):
            measured = kind(
                self.pose(pose.position[i], pose.quaternion[i]), pose.covariance[i].ravel()
            )
            yield time, "measured_pose", stamped(self.header(time, pose.frame), measured)


def _stamps(time: np.ndarray) -> list[int]:
    """Return seconds since the start as time stamps in ns, rounded to microseconds."""
    return [START + round(1e6 * t) * 1000 for t in time.tolist()]
