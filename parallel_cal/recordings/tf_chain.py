"""Compose the pose of a frame in another one from transforms over several hops.

Transforms of `/tf` change and those of `/tf_static` do not. Each of the frames between may be the
parent or the child of the next one, as in tf2.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from parallel_cal.base.errors import BagError
from parallel_cal.base.rotation import matrix_to_quaternion, quaternion_to_matrix
from parallel_cal.recordings.pose_messages import stamp_of
from parallel_cal.recordings.recording import Array, Raw

TF_TYPE = "tf2_msgs/msg/TFMessage"
STATIC_TOPIC = "tf_static"


class Stamped(NamedTuple):
    """A transform with its times of reception and of its header (ns)."""

    log: int
    stamp: int
    r: Array
    quaternion: Array


class Series(NamedTuple):
    """A transform over time: t (n,) [s], r (n, 3) [m], R (n, 3, 3)."""

    t: Array
    r: Array
    R: Array


@dataclass
class Transforms:
    """All transforms of a recording by (parent, child)."""

    moving: dict[tuple[str, str], list[Stamped]] = field(default_factory=dict)
    static: dict[tuple[str, str], Stamped] = field(default_factory=dict)

    def take(self, message: Any, log: int, topic: str) -> None:
        """Add the transforms of a message."""
        for one in message.transforms:
            names = one.header.frame_id.strip("/"), one.child_frame_id.strip("/")
            v, q = one.transform.translation, one.transform.rotation
            found = Stamped(
                log, stamp_of(one), np.array([v.x, v.y, v.z]), np.array([q.x, q.y, q.z, q.w])
            )
            if topic.strip("/").endswith(STATIC_TOPIC):
                self.static[names] = found
            else:
                self.moving.setdefault(names, []).append(found)

    def find_path(self, parent: str, child: str) -> list[str]:
        """Return the frames from the parent to the child; BagError if they are not connected."""
        near: dict[str, list[str]] = {}
        for a, b in (*self.moving, *self.static):
            near.setdefault(a, []).append(b)
            near.setdefault(b, []).append(a)
        before, queue = {parent: ""}, deque([parent])
        while queue and child not in before:
            for frame in near.get(here := queue.popleft(), []):
                if frame not in before:
                    before[frame] = here
                    queue.append(frame)
        if child not in before or parent not in near:
            edges = ", ".join(sorted(f"{a}->{b}" for a, b in {*self.moving, *self.static}))
            raise BagError(
                f"no chain of transforms from '{parent}' to '{child}'; /tf and /tf_static hold "
                f"{edges or 'nothing'}. Name two frames that these connect, as "
                "measured_pose=/tf:PARENT->CHILD"
            )
        path = [child]
        while path[-1] != parent:
            path.append(before[path[-1]])
        return path[::-1]

    def compose(self, parent: str, child: str, raw: Raw) -> str:
        """Append the pose of the child in the parent to `raw`, and return a sentence about it.

        The times are those of the transform on the path with the fewest messages. The others are
        interpolated to them; outside their times there is no pose.
        """
        path = self.find_path(parent, child)
        hops = [(a, b) for a, b in pairwise(path)]
        moving = [self.moving[e] for hop in hops for e in (hop, hop[::-1]) if e in self.moving]
        if not moving:
            raise BagError(
                f"the chain {'->'.join(path)} has no transform of /tf: nothing on it was measured"
            )
        clock = min(moving, key=len)
        stamped = all(one.stamp > 0 for series in moving for one in series)
        origin = clock[0].stamp if stamped else clock[0].log
        times = _seconds(clock, stamped, origin)
        r, R = np.zeros((len(times), 3)), np.tile(np.eye(3), (len(times), 1, 1))
        known = np.ones(len(times), bool)
        for a, b in hops:
            turned = (a, b) not in self.moving and (a, b) not in self.static
            name = (b, a) if turned else (a, b)
            series = self.moving.get(name) or [self.static[name]]
            own = _make_series(series, stamped, origin)
            if len(own.t) > 1:
                known &= (times >= own.t[0]) & (times <= own.t[-1])
            hop_r, hop_R = _interpolate(own, times)
            if turned:
                hop_R = np.swapaxes(hop_R, 1, 2)
                hop_r = -np.einsum("nij,nj->ni", hop_R, hop_r)
            r, R = r + np.einsum("nij,nj->ni", R, hop_r), R @ hop_R
        quaternion = matrix_to_quaternion(R)
        for i in np.flatnonzero(known):
            row = (parent, tuple(r[i]), tuple(quaternion[i]), None)
            raw.append(clock[i].log, clock[i].stamp, row)
        return f"{raw.topic}: poses of '{child}' in '{parent}' over {' -> '.join(path)}"


def _seconds(series: list[Stamped], stamped: bool, origin: int) -> Array:
    return np.array([((one.stamp if stamped else one.log) - origin) * 1e-9 for one in series])


def _make_series(series: list[Stamped], stamped: bool, origin: int) -> Series:
    """Return a transform in the order of its times, each time once."""
    t, first = np.unique(_seconds(series, stamped, origin), return_index=True)
    r = np.array([series[i].r for i in first])
    return Series(t, r, quaternion_to_matrix(np.array([series[i].quaternion for i in first])))


def _interpolate(series: Series, times: Array) -> tuple[Array, Array]:
    """Return the transform (n, 3), (n, 3, 3) at these times; outside its times, the nearest one."""
    if len(series.t) == 1:
        n = len(times)
        return np.tile(series.r, (n, 1)), np.tile(series.R, (n, 1, 1))
    from scipy.spatial.transform import Rotation, Slerp

    inside = np.clip(times, series.t[0], series.t[-1])
    r = np.stack([np.interp(inside, series.t, column) for column in series.r.T], axis=1)
    return r, Slerp(series.t, Rotation.from_matrix(series.R))(inside).as_matrix()
