"""A recording as plain arrays on one clock; it knows neither bags nor ROS."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parallel_cal.base.rotation import quaternion_to_matrix

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

# m or rad: no robot has such readings, and the sums of their squares would overflow
MAX_PLAUSIBLE_READING = 1e9
COORDINATES = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True)
class Dropped:
    """A recorded message that is not used: time in s since the start, reason, detail, count."""

    time: float
    reason: str
    detail: str = ""
    count: int = 1


@dataclass(frozen=True)
class TopicInfo:
    """A topic in the bag: name, message type, number of messages, and their encoding; only `cdr`,
    that of ROS 2, is read."""

    name: str
    type: str
    count: int
    encoding: str = "cdr"


MESSAGE_COLUMNS = ("log", "stamp", "rows", "origins")  # lists of a Raw, one item per message


@dataclass
class Raw:
    """Messages of one topic as received: log and header times in ns, rows of content, and what is
    known of each one's origin: its frame, and of a live message its publisher."""

    topic: str
    type: str
    log: list[int] = field(default_factory=list)
    stamp: list[int] = field(default_factory=list)
    rows: list[tuple] = field(default_factory=list)
    origins: list[str] = field(default_factory=list)
    undecodable: int = 0

    def append(self, log: int, stamp: int, row: tuple, origin: str = "") -> None:
        self.log.append(log)
        self.stamp.append(stamp)
        self.rows.append(row)
        self.origins.append(origin)

    def select(self, at: Sequence[int]) -> Raw:
        """Return the messages with these numbers, from 0."""
        columns: Any = {name: [getattr(self, name)[i] for i in at] for name in MESSAGE_COLUMNS}
        return replace(self, **columns)


@dataclass(frozen=True)
class JointStream:
    """Joint readings: time (n,) in s, position (n, nq) in rad or m, effort (n, nq), NaN if none."""

    topic: str
    names: tuple[str, ...]
    time: Array
    position: Array
    effort: Array

    def select(self, which: Bools) -> JointStream:
        """Return the readings marked in `which` (n,)."""
        columns = (column[which] for column in (self.time, self.position, self.effort))
        return JointStream(self.topic, self.names, *columns)

    @property
    def period(self) -> float:
        """Usual time in s between two readings; 0 for a single one."""
        return float(np.median(np.diff(self.time))) if len(self.time) > 1 else 0.0


@dataclass(frozen=True)
class PoseStream:
    """Measured poses: time (m,), position (m, 3) in m, unit quaternion (m, 4) x y z w.

    `measured` (m, 6) marks x y z rx ry rz; `covariance` (m, 6, 6) in m and rad is NaN if the
    message has none. Empty (m = 0, no topic) for a set-up without a pose device.
    """

    topic: str
    frame: str
    time: Array
    position: Array
    quaternion: Array
    measured: Bools
    covariance: Array

    @cached_property
    def rotation(self) -> Array:
        """(m, 3, 3)."""
        return quaternion_to_matrix(self.quaternion)


NO_POSES = PoseStream(
    "",
    "",
    np.zeros(0),
    np.zeros((0, 3)),
    np.zeros((0, 4)),
    np.zeros((0, 6), bool),
    np.zeros((0, 6, 6)),
)


@dataclass(frozen=True)
class ScalarStream:
    """One number over time: time (k,) in s, value (k,)."""

    topic: str
    time: Array
    value: Array


@dataclass(frozen=True)
class TextStream:
    """Texts that are valid until the next one: time (k,) in s, value of length k."""

    topic: str
    time: Array
    value: tuple[str, ...]


@dataclass(frozen=True)
class Recording:
    """All channels of a recording on one clock: seconds since `start_ns`.

    `conditions` are numbers over time by channel (temperature, payload, ...). `constraint` names
    the plane or sphere that constrains the tip; it is empty if there is none. `distances` are the
    readings (m) of ball-bars and probes by channel. `passive` are the joint states' readings of
    passive joints (rad or m) by name.
    """

    source: str
    start_ns: int
    joints: JointStream
    pose: PoseStream
    conditions: Mapping[str, ScalarStream] = field(default_factory=dict)
    constraint: TextStream | None = None
    distances: Mapping[str, ScalarStream] = field(default_factory=dict)
    passive: Mapping[str, ScalarStream] = field(default_factory=dict)
    dropped: tuple[Dropped, ...] = ()
    notes: tuple[str, ...] = ()
    topics: tuple[TopicInfo, ...] = ()
    sha256: str = ""

    def __repr__(self) -> str:
        return f"Recording({self.source}, {len(self.joints.time)} joint states)"
