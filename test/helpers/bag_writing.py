"""Writes small recordings with any content into a folder, with rosbags alone.

    moves = Session([[0.1, 0.2], [0.4, 0.0]], r=[[0, 0, 0.2], [0.1, 0, 0.2]])
    path = write_bag(tmp_path / "bag", joint_states(moves) + poses(moves))

A message is (topic, type, log time in ns, message); change, drop or add any before writing.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

ROS = get_typestore(Stores.ROS2_JAZZY)
START = 1_700_000_000_000_000_000
Message = tuple[str, str, int, Any]

POSE = "geometry_msgs/msg/PoseStamped"
COVARIANT = "geometry_msgs/msg/PoseWithCovarianceStamped"
POINT = "geometry_msgs/msg/PointStamped"
NONE = np.zeros(0)


@dataclass
class Session:
    """A robot that stands `dwell` s at each of its joint readings and moves smoothly between."""

    stops: Sequence[Sequence[float]]
    r: Any = None  # (n, 3) position at each stop; default: the first three joints
    names: tuple[str, ...] = ()
    dwell: float = 1.0
    move: float = 0.6
    jitter: float = 2e-5
    seed: int = 0
    rate: float = 100.0
    pose_rate: float = 20.0
    start: float = 0.0
    q: np.ndarray = field(init=False)
    time: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self.names = self.names or tuple(f"joint{j + 1}" for j in range(len(self.stops[0])))
        length = len(self.stops) * (self.dwell + self.move) - self.move
        self.time = np.arange(0.0, length, 1.0 / self.rate)
        noise = np.random.default_rng(self.seed).normal(0.0, self.jitter, (len(self.time), 1))
        self.q = self.path(self.stops, self.time) + noise

    def path(self, stops: Any, time: np.ndarray) -> np.ndarray:
        """Positions (n, k) at times (n,) of the smooth motion through `stops`."""
        stops = np.asarray(stops, float)
        slot = np.minimum(time // (self.dwell + self.move), len(stops) - 1).astype(int)
        s = np.clip((time - slot * (self.dwell + self.move) - self.dwell) / self.move, 0, 1)
        blend = (s**3 * (10 - 15 * s + 6 * s**2))[:, None]
        after = np.minimum(slot + 1, len(stops) - 1)
        return stops[slot] * (1 - blend) + stops[after] * blend

    def position(self, time: np.ndarray) -> np.ndarray:
        """Platform position (n, 3) at times (n,)."""
        stops = np.asarray(self.stops, float)
        r = np.zeros((len(stops), 3))
        r[:, : min(3, stops.shape[1])] = stops[:, :3]
        return self.path(r if self.r is None else self.r, time)


def ns(seconds: float) -> int:
    """Seconds after the start as a time stamp."""
    return START + round(seconds * 1e9)


def kind(name: str) -> Any:
    """A message class by its full name."""
    return ROS.types[name]


def header(stamp: int, frame: str = "base") -> Any:
    """A header at `stamp` ns."""
    time = kind("builtin_interfaces/msg/Time")(stamp // 10**9, stamp % 10**9)
    return kind("std_msgs/msg/Header")(time, frame)


def joint_state(
    t: float,
    names: Sequence[str],
    q: Any,
    *,
    velocity: Any = NONE,
    stamp: int | None = None,
    topic: str = "joint_states",
) -> Message:
    """One joint_states message at `t` s; `stamp` overrides the header's time in ns."""
    at = header(ns(t) if stamp is None else stamp, "")
    body = kind("sensor_msgs/msg/JointState")(
        at, list(names), np.asarray(q, float), np.asarray(velocity, float), NONE
    )
    return topic, "sensor_msgs/msg/JointState", ns(t), body


def joint_states(session: Session, *, order: Sequence[int] | None = None) -> list[Message]:
    """All joint_states of a session, its joints published in another order if wanted."""
    order = list(order or range(len(session.names)))
    names = [session.names[j] for j in order]
    rows = zip(session.time.tolist(), session.q, strict=True)
    return [joint_state(session.start + t, names, q[order]) for t, q in rows]


def pose(
    t: float,
    r: Any,
    quaternion: Any = (0.0, 0.0, 0.6, 0.8),
    *,
    variances: Any = None,
    type: str = COVARIANT,
    topic: str = "measured_pose",
    frame: str = "base",
    stamp: int | None = None,
) -> Message:
    """One measured pose or point at `t` s; `variances` (6,) fill the covariance's diagonal."""
    point = kind("geometry_msgs/msg/Point")(*map(float, r))
    at = header(ns(t) if stamp is None else stamp, frame)
    if type == POINT:
        return topic, type, ns(t), kind(POINT)(at, point)
    turn = kind("geometry_msgs/msg/Quaternion")(*map(float, quaternion))
    inner = kind("geometry_msgs/msg/Pose")(point, turn)
    if type == COVARIANT:
        covariance = np.diag(np.zeros(6) if variances is None else variances).ravel()
        inner = kind("geometry_msgs/msg/PoseWithCovariance")(inner, covariance.astype(float))
    return topic, type, ns(t), kind(type)(at, inner)


def poses(session: Session, *, jitter: float = 2e-6, **options: Any) -> list[Message]:
    """All measured poses of a session, also while moving; options as in `pose`."""
    time = np.arange(0.004, session.time[-1], 1.0 / session.pose_rate)
    rng = np.random.default_rng(session.seed + 1)
    r = session.position(time) + rng.normal(0.0, jitter, (len(time), 3))
    return [pose(session.start + t, p, **options) for t, p in zip(time.tolist(), r, strict=True)]


def temperature(t: float, degrees: float, topic: str = "temperature") -> Message:
    """One temperature in degC."""
    body = kind("sensor_msgs/msg/Temperature")(header(ns(t)), float(degrees), 0.0)
    return topic, "sensor_msgs/msg/Temperature", ns(t), body


def payload(t: float, mass: float, topic: str = "payload") -> Message:
    """One payload in kg."""
    centre = kind("geometry_msgs/msg/Vector3")(0.0, 0.0, 0.0)
    inertia = kind("geometry_msgs/msg/Inertia")(float(mass), centre, *[0.0] * 6)
    body = kind("geometry_msgs/msg/InertiaStamped")(header(ns(t)), inertia)
    return topic, "geometry_msgs/msg/InertiaStamped", ns(t), body


def text(t: float, words: str, topic: str) -> Message:
    """One std_msgs/String."""
    return topic, "std_msgs/msg/String", ns(t), kind("std_msgs/msg/String")(words)


def tie(t: float, name: str) -> Message:
    """From `t` s on, the plane or sphere of this name holds the tip; empty: nothing does."""
    return text(t, name, "constraint")


def distance(t: float, metres: float, channel: str, topic: str = "distance") -> Message:
    """One reading of a ball-bar or probe in m (single precision, as the message has it)."""
    range_ = kind("sensor_msgs/msg/Range")
    body = range_(header(ns(t), channel), range_.INFRARED, 0.0, 0.0, 1.0, float(metres), 0.0)
    return topic, "sensor_msgs/msg/Range", ns(t), body


def write_bag(path: Path, messages: Iterable[Message], *, sqlite: bool = False) -> Path:
    """Write messages in the order of their log times; returns the bag's directory."""
    plugin = StoragePlugin.SQLITE3 if sqlite else StoragePlugin.MCAP
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        connections: dict[tuple[str, str], Any] = {}
        for topic, type_, log, message in sorted(messages, key=lambda m: m[2]):
            if (topic, type_) not in connections:
                added = writer.add_connection(topic, type_, typestore=ROS)
                connections[topic, type_] = added
            writer.write(connections[topic, type_], log, ROS.serialize_cdr(message, type_))
    return path


def split(path: Path, *parts: Iterable[Message]) -> Path:
    """A recording in several files, as `ros2 bag record --max-bag-size` leaves it."""
    bags = [write_bag(path / f"part{k}", part) for k, part in enumerate(parts)]
    pages = [yaml.safe_load((bag / "metadata.yaml").read_text()) for bag in bags]
    whole, *rest = (page["rosbag2_bagfile_information"] for page in pages)
    for other in rest:
        whole["message_count"] += other["message_count"]
        whole["files"] += other["files"]
        known = {one["topic_metadata"]["name"]: one for one in whole["topics_with_message_count"]}
        for more in other["topics_with_message_count"]:
            known[more["topic_metadata"]["name"]]["message_count"] += more["message_count"]
    whole["relative_file_paths"] = [file["path"] for file in whole["files"]]
    for bag in bags:
        data_file(bag).rename(path / data_file(bag).name)
    (path / "metadata.yaml").write_text(yaml.safe_dump(pages[0]))
    return path


def data_file(path: Path) -> Path:
    """The one data file of a bag directory."""
    return next(file for file in path.iterdir() if file.suffix in (".mcap", ".db3"))
