"""A simulated session or messages -> a recording; the only file that writes a bag."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from parallel_cal.base.errors import BagError
from parallel_cal.recordings.channels import CHANNELS
from parallel_cal.recordings.recording import PoseStream

if TYPE_CHECKING:
    from parallel_cal.recordings.simulate import Simulation

START = 1_767_225_600_000_000_000  # 2026-01-01 00:00:00 UTC, in ns: equal seeds, equal files
STORAGES = ("mcap", "sqlite3")
WRITTEN_CHANNELS = ("payload", "temperature", "joint_states", "measured_pose")


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
    kinds = {name: CHANNELS[name].types[0] for name in WRITTEN_CHANNELS}
    stream = sorted(messages.of(session), key=lambda m: m[0])
    data = ((n, t, messages.store.serialize_cdr(m, kinds[n])) for t, n, m in stream)
    latched = {name for name in WRITTEN_CHANNELS if CHANNELS[name].latched}
    _write(Path(path), kinds, data, latched, storage, lambda folder: folder)


def write_messages(
    path: str | Path,
    kinds: Mapping[str, str],
    messages: Iterable[tuple[str, int, Any]],
    latched: Container[str],
) -> None:
    """Write (topic, stamp in ns, serialized) as one MCAP file; `kinds` are the topics' types."""
    _write(Path(path), kinds, messages, latched, "mcap", lambda folder: next(folder.glob("*.mcap")))


def _write(
    target: Path,
    kinds: Mapping[str, str],
    messages: Iterable[tuple[str, int, Any]],
    latched: Container[str],
    storage: str,
    wanted: Callable[[Path], Path],
) -> None:
    """Whole or not at all; `wanted` is the folder or what of it takes the target's name."""
    if target.exists():
        raise BagError(f"{target}: already exists; remove it or give another name")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=target.parent, prefix=".bag") as scratch:
            # A bag's data file carries its folder's name.
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
    if storage == "mcap":  # inside the file; sqlite3 can only be packed as a whole
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
    """Reliable; a latched topic also reaches whoever subscribes late."""
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
    """What messages are made of, without ROS."""

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
        """Position only: an encoder knows neither velocity nor effort."""
        kind, nothing = self.kind("sensor_msgs/JointState"), np.zeros(0)
        return kind(self.header(stamp), list(names), q, nothing, nothing)


class _Session(Messages):
    """A session's arrays as ROS messages."""

    def of(self, session: Simulation) -> Iterator[tuple[int, str, Any]]:
        """(stamp in ns, topic, message), topic by topic."""
        recording, platform = session.recording, session.model.frames["platform"]
        payload, temperature = (recording.conditions[name] for name in ("payload", "temperature"))
        for time, mass in zip(_stamps(payload.time), payload.value, strict=True):
            yield time, "payload", self._payload(time, platform, float(mass))
        for time, warmth in zip(_stamps(temperature.time), temperature.value, strict=True):
            air = self.kind("sensor_msgs/Temperature")
            yield time, "temperature", air(self.header(time), float(warmth), 0.01)
        joints, pose = recording.joints, recording.pose
        for time, q in zip(_stamps(joints.time), joints.position, strict=True):
            yield time, "joint_states", self.joint_state(time, joints.names, q)
        for i, time in enumerate(_stamps(pose.time)):
            yield time, "measured_pose", self._measured(time, pose, i)

    def _measured(self, stamp: int, poses: PoseStream, i: int) -> Any:
        pose, stated = self.pose(poses.position[i], poses.quaternion[i]), poses.covariance[i]
        inner = self.kind("geometry_msgs/PoseWithCovariance")(pose, stated.ravel())
        return self.kind("geometry_msgs/PoseWithCovarianceStamped")(
            self.header(stamp, poses.frame), inner
        )

    def _payload(self, stamp: int, frame: str, mass: float) -> Any:
        """A point mass on the platform."""
        inertia = self.kind("geometry_msgs/Inertia")(mass, self.vector(np.zeros(3)), *[0.0] * 6)
        return self.kind("geometry_msgs/InertiaStamped")(self.header(stamp, frame), inertia)


def _stamps(time: np.ndarray) -> list[int]:
    """Seconds since the start as time stamps, exact to the microsecond."""
    return [START + round(1e6 * t) * 1000 for t in time.tolist()]
