"""Publishes where the links of the calibrated robot are, as TF."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.exporting.description import Description
from parallel_cal.nodes.parameters import Setting, overridable

LINK_TRANSFORMS = {
    "tf_rate": Setting(
        0.0,
        "largest rate of the transforms of all links on /tf, Hz; 0 = none: robot_state_publisher "
        "may publish the same frames",
        (0, 1000),
        fixed=True,
    ),
    "frame_prefix": Setting(
        "",
        "text before each frame on /tf, such as calibrated/; empty = none",
        fixed=True,
    ),
}


class LinkPublisher(Protocol):
    """Gets each configuration of the robot, of a description whose links are published."""

    def publish(
        self, description: Description, x: np.ndarray, at: Mapping[str, Any] | None, stamp: Time
    ) -> None: ...


class NoTransforms:
    """The choice of those who have another source of TF."""

    def publish(self, *ignored: Any) -> None:
        return


class LinkTransforms:
    """Publishes the transforms of all links, at most `rate` times a second."""

    def __init__(self, node: Node, rate: float, prefix: str):
        from tf2_msgs.msg import TFMessage  # on no Python index, and not everybody needs it

        self._message, self._prefix, self._period = TFMessage(), prefix, 1.0 / rate
        self._described: Description | None = None
        self._next = -np.inf
        self._publisher = node.create_publisher(
            TFMessage, "/tf", QoSProfile(depth=100), qos_overriding_options=overridable()
        )

    def publish(
        self, description: Description, x: np.ndarray, at: Mapping[str, Any] | None, stamp: Time
    ) -> None:
        now = time.monotonic()
        if now < self._next:
            return
        self._next = now + self._period
        if description is not self._described:
            self._described = description
            self._message.transforms = self._name_frames(description)
        rows = zip(*description.transforms(x, at), strict=True)
        for one, (r, q) in zip(self._message.transforms, rows, strict=False):
            to = one.transform
            to.translation.x, to.translation.y, to.translation.z = r.tolist()
            to.rotation.x, to.rotation.y, to.rotation.z, to.rotation.w = q.tolist()
        for one in self._message.transforms:
            one.header.stamp = stamp
        self._publisher.publish(self._message)

    def _name_frames(self, description: Description) -> list[TransformStamped]:
        """Make the transforms; with a prefix the last one joins its base to the model's base."""
        base = description.model.frames["base"]
        pairs = zip(description.parents, description.children, strict=True)
        frames = [(self._prefix + parent, self._prefix + child) for parent, child in pairs]
        if self._prefix:
            frames.append((base, self._prefix + base))
        made = []
        for parent, child in frames:
            one = TransformStamped(child_frame_id=child)
            one.header.frame_id = parent
            made.append(one)
        return made


def make_link_publisher(node: Node) -> LinkPublisher:
    """Make what the parameters ask for; ParallelCalError if tf2_msgs is needed and missing."""
    rate, prefix = (node.get_parameter(name).value for name in LINK_TRANSFORMS)
    if not rate:
        return NoTransforms()
    try:
        return LinkTransforms(node, rate, prefix)
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] != "tf2_msgs":
            raise
        raise ParallelCalError(
            f"parameter tf_rate {rate:g}: the package tf2_msgs is not installed here: install "
            "ros-jazzy-tf2-msgs and source ROS again, or set tf_rate to 0"
        ) from None
