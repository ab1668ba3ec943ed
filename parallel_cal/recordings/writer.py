"""A simulated session -> a rosbag2 folder; the only file that writes a bag."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Sequence
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
WRITTEN = ("payload", "temperature", "joint_states", "measured_pose")


def write_bag(session: Simulation, path: str | Path, storage: str = "mcap") -> None:
    """Write a session as a rosbag2 folder, whole or not at all; BagError where one stands."""
    target = Path(path)
    if storage not in STORAGES:
        raise BagError(f"storage '{storage}' unknown; expected {' or '.join(STORAGES)}")
    if target.exists():
        raise BagError(f"{target}: exists already; remove it or give another name")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=target.parent, prefix=".bag") as scratch:
            # A bag's data file carries its folder's name.
            _write(session, Path(scratch) / target.name, storage)
            shutil.move(Path(scratch) / target.name, target)
    except OSError as error:
        raise BagError(f"{target}: cannot be written: {error.strerror or error}") from None


def _write(session: Simulation, folder: Path, storage: str) -> None:
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    messages = _Messages()
    writer = Writer(folder, version=9, storage_plugin=StoragePlugin[storage.upper()])
    if storage == "mcap":  # inside the file; sqlite3 can only be packed as a whole
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        topics = {
            name: writer.add_connection(
                name,
                CHANNELS[name].types[0],
                typestore=messages.store,
                offered_qos_profiles=[_quality(name)],
            )
            for name in WRITTEN
        }
        stream = sorted(messages.of(session), key=lambda m: m[0])
        for stamp, name, message in stream:
            data = messages.store.serialize_cdr(message, CHANNELS[name].types[0])
            writer.write(topics[name], stamp, data)


def _quality(topic: str) -> Any:
    """Reliable; a latched topic also reaches whoever subscribes late."""
    from rosbags import interfaces as qos

    latched, forever = CHANNELS[topic].latched, qos.QosTime(9223372036, 854775807)
    durability = qos.QosDurability
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


class _Messages:
    """A session's arrays as ROS messages."""

    @cached_property
    def store(self) -> Any:
        from rosbags.typesys import Stores, get_typestore

        return get_typestore(Stores.ROS2_JAZZY)

    def of(self, session: Simulation) -> Iterator[tuple[int, str, Any]]:
        """(stamp in ns, topic, message), topic by topic."""
        recording, platform = session.recording, session.model.frames["platform"]
        payload, temperature = (recording.conditions[name] for name in ("payload", "temperature"))
        for time, mass in zip(_stamps(payload.time), payload.value, strict=True):
            yield time, "payload", self._payload(time, platform, float(mass))
        for time, warmth in zip(_stamps(temperature.time), temperature.value, strict=True):
            air = self._kind("sensor_msgs/Temperature")
            yield time, "temperature", air(self._header(time), float(warmth), 0.01)
        joints, pose = recording.joints, recording.pose
        for time, q in zip(_stamps(joints.time), joints.position, strict=True):
            yield time, "joint_states", self._joint_state(time, joints.names, q)
        for i, time in enumerate(_stamps(pose.time)):
            yield time, "measured_pose", self._pose(time, pose, i)

    def _kind(self, name: str) -> Any:
        return self.store.types[name.replace("/", "/msg/")]

    def _header(self, stamp: int, frame: str = "") -> Any:
        time = self._kind("builtin_interfaces/Time")(stamp // 10**9, stamp % 10**9)
        return self._kind("std_msgs/Header")(time, frame)

    def _joint_state(self, stamp: int, names: Sequence[str], q: np.ndarray) -> Any:
        """Position only: an encoder knows neither velocity nor effort."""
        kind, nothing = self._kind("sensor_msgs/JointState"), np.zeros(0)
        return kind(self._header(stamp), list(names), q, nothing, nothing)

    def _pose(self, stamp: int, poses: PoseStream, i: int) -> Any:
        point = self._kind("geometry_msgs/Point")(*poses.position[i].tolist())
        turn = self._kind("geometry_msgs/Quaternion")(*poses.quaternion[i].tolist())
        pose = self._kind("geometry_msgs/Pose")(point, turn)
        stated = poses.covariance[i].ravel()
        inner = self._kind("geometry_msgs/PoseWithCovariance")(pose, stated)
        return self._kind("geometry_msgs/PoseWithCovarianceStamped")(
            self._header(stamp, poses.frame), inner
        )

    def _payload(self, stamp: int, frame: str, mass: float) -> Any:
        """A point mass on the platform."""
        centre = self._kind("geometry_msgs/Vector3")(0.0, 0.0, 0.0)
        inertia = self._kind("geometry_msgs/Inertia")(mass, centre, *[0.0] * 6)
        return self._kind("geometry_msgs/InertiaStamped")(self._header(stamp, frame), inertia)


def _stamps(time: np.ndarray) -> list[int]:
    """Seconds since the start as time stamps, exact to the microsecond."""
    return [START + round(1e6 * t) * 1000 for t in time.tolist()]
