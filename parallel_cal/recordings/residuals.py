"""Residuals of every sample as standard messages, which ROS tools draw without plug-ins."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from parallel_cal.recordings.recording import Array
from parallel_cal.recordings.writer import Messages, write_messages

ROOT = "/calibration_node/residuals"  # the node publishes there, so one layout shows both
VECTOR, POSE = "geometry_msgs/msg/Vector3Stamped", "geometry_msgs/msg/PoseStamped"
# Topics below ROOT: first all arrows at once, then one message per sample.
TOPICS = {
    "": "visualization_msgs/msg/MarkerArray",
    "/measured": POSE,
    "/predicted": POSE,
    "/position": VECTOR,
    "/orientation": VECTOR,
    "/position_sigmas": VECTOR,
    "/orientation_sigmas": VECTOR,
    "/joints": "sensor_msgs/msg/JointState",
    "/sigmas": "std_msgs/msg/Float64",
}
ARROW_WIDTH_RATIO = 0.004  # width of an arrow per extent of the workspace


@dataclass(frozen=True)
class Residuals:
    """Residuals of N samples; NaN where not known.

    Numbers and stamps (ns) of the samples, joint residuals (N, nq) in rad or m, their rms in sigmas
    (N,), and, by topic, `vectors` (N, 3) and `poses` ((N, 3) in m, (N, 4) x y z w).
    """

    numbers: Array
    stamps: Array
    frame: str
    joint_names: tuple[str, ...]
    joints: Array
    sigmas: Array
    vectors: Mapping[str, Array]
    poses: Mapping[str, tuple[Array, Array]]


class Message(NamedTuple):
    """A topic below ROOT, a stamp (ns) and the serialized message."""

    topic: str
    stamp: int
    data: bytes


def residual_messages(of: Residuals, scale: float) -> Iterator[Message]:
    """Yield all residuals as messages: arrows, `scale` times as long, then sample by sample."""
    make = _Residuals()
    for topic, stamp, message in make.of(of, scale):
        yield Message(topic, stamp, bytes(make.store.serialize_cdr(message, TOPICS[topic])))


def write_residuals(of: Residuals, path: Path, scale: float) -> None:
    """Write all residuals as an MCAP file at the samples' times; BagError if that fails."""
    kinds = {ROOT + topic: kind for topic, kind in TOPICS.items()}
    stream = sorted(residual_messages(of, scale), key=lambda m: m.stamp)
    write_messages(path, kinds, ((ROOT + m.topic, m.stamp, m.data) for m in stream), {ROOT})


class _Residuals(Messages):
    """Makes the ROS messages of residuals."""

    def of(self, of: Residuals, scale: float) -> Iterator[tuple[str, int, Any]]:
        """Yield (topic, stamp, message); the arrows come first, at the first sample's time."""
        if len(of.stamps):
            yield "", int(of.stamps.min()), self._arrows(of, scale)
        for i, stamp in enumerate(of.stamps.tolist()):
            header = self.header(stamp, of.frame)
            for topic, (position, quaternion) in of.poses.items():
                if np.isfinite(position[i]).all():
                    pose = self.pose(position[i], quaternion[i])
                    yield topic, stamp, self.kind("geometry_msgs/PoseStamped")(header, pose)
            for topic, vectors in of.vectors.items():
                if np.isfinite(vectors[i]).all():
                    vector = self.vector(vectors[i])
                    yield topic, stamp, self.kind("geometry_msgs/Vector3Stamped")(header, vector)
            if np.isfinite(of.joints[i]).all():
                yield "/joints", stamp, self.joint_state(stamp, of.joint_names, of.joints[i])
            yield "/sigmas", stamp, self.kind("std_msgs/Float64")(float(of.sigmas[i]))

    def _arrows(self, of: Residuals, scale: float) -> Any:
        """Draw an arrow from each measured position along measured minus predicted."""
        start, error = of.poses["/measured"][0], of.vectors["/position"]
        known = np.flatnonzero(np.isfinite(start + error).all(axis=1))
        thickness = (
            ARROW_WIDTH_RATIO * float(np.ptp(start[known], axis=0).max()) if len(known) else 0.0
        )
        none = np.zeros((0, 3))
        # The first marker deletes all older arrows.
        markers = [self._arrow(of.frame, 0, 3, none, np.ones(3), 0.0)]
        for i in known:
            ends = np.stack([start[i], start[i] + scale * error[i]])
            # Red, green and blue are the direction's x, y and z; dark is negative.
            colour = 0.5 + 0.5 * error[i] / max(float(np.linalg.norm(error[i])), 1e-300)
            markers.append(self._arrow(of.frame, int(of.numbers[i]), 0, ends, colour, thickness))
        return self.kind("visualization_msgs/MarkerArray")(markers)

    def _arrow(
        self, frame: str, number: int, action: int, ends: Array, colour: Array, thickness: float
    ) -> Any:
        """Return a marker of type 0 (arrow) that adds an arrow (action 0) or deletes all (3)."""
        rgba = self.kind("std_msgs/ColorRGBA")
        forever = self.kind("builtin_interfaces/Duration")(0, 0)
        no_texture = self.kind("sensor_msgs/CompressedImage")(
            self.header(0), "", np.zeros(0, np.uint8)
        )
        no_mesh = self.kind("visualization_msgs/MeshFile")("", np.zeros(0, np.uint8))
        return self.kind("visualization_msgs/Marker")(
            self.header(0, frame),
            "residuals",
            number,
            0,
            action,
            self.pose(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])),
            self.vector(np.array([thickness, 2 * thickness, 0.0])),
            rgba(*colour.tolist(), 1.0),
            forever,
            False,
            [self.point(end) for end in ends],
            [],
            "",
            no_texture,
            [],
            "",
            "",
            no_mesh,
            False,
        )
