"""Find the pose of one body in a message of any type that a measuring device's driver publishes.

Drivers use many message types, but few forms: one pose, transform or point with a header, or a list
of named ones (motion capture, tags, tf). The form is recognised by its fields, so that a new
driver needs a topic and the name of its body, but no code.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from parallel_cal.base.errors import BagError

# Fields that name a body in a list.
NAMES = ("rigid_body_name", "name", "subject_name", "child_frame_id", "marker_id", "id")
# Packages whose message types are known: of these, only poses, transforms and points fit.
STANDARD_PACKAGES = (
    "actionlib_msgs",
    "action_msgs",
    "builtin_interfaces",
    "diagnostic_msgs",
    "geometry_msgs",
    "nav_msgs",
    "parallel_cal_msgs",
    "rcl_interfaces",
    "rosgraph_msgs",
    "sensor_msgs",
    "shape_msgs",
    "std_msgs",
    "std_srvs",
    "stereo_msgs",
    "tf2_msgs",
    "trajectory_msgs",
    "visualization_msgs",
)
# Standard types that hold poses, besides those of the channels.
OTHER_POSE_TYPES = (
    "geometry_msgs/msg/TransformStamped",
    "geometry_msgs/msg/PoseArray",
    "nav_msgs/msg/Odometry",
    "tf2_msgs/msg/TFMessage",
)


def may_hold_poses(type: str) -> bool:
    """Return whether messages of a type that no channel has may hold poses."""
    return type in OTHER_POSE_TYPES or type.split("/")[0] not in STANDARD_PACKAGES


def split_body(topic: str) -> tuple[str, str]:
    """Split `TOPIC:BODY` into both names; without a colon, the body is empty."""
    name, _, body = topic.partition(":")
    return name, body


def read_pose(message: Any, body: str = "") -> tuple[int, tuple] | None:
    """Return the stamp (ns) and the row of a body's pose; None if the message lacks the body.

    The row is (frame, position, quaternion or None, covariance or None), in m.

    Parameters
    ----------
    message
        A message of rclpy or rosbags.
    body : str
        Name of the body: of a rigid body, of a tag (its number), or of a frame (`child` or
        `parent->child`). May be empty if the message holds one body.

    Raises
    ------
    BagError
        If the message holds several bodies and none is named.
    """
    single = _row(message, message)
    if single is not None:
        return stamp_of(message), single
    items = _list_items(message)
    if not body and len(items) > 1:
        raise BagError(
            f"a message holds {len(items)} bodies ({', '.join(_list_names(items))}): name one of "
            "them, as TOPIC:BODY"
        )
    for names, item, row in items:
        if not body or body in names:
            return stamp_of(item) or stamp_of(message), row
    return None


def body_names(message: Any) -> list[str]:
    """Return the names of the bodies in a message; empty for a message of one pose."""
    return _list_names(_list_items(message))


def pose_row(message: Any) -> tuple:
    """Return (frame, position, quaternion, covariance) of a message of one pose."""
    row = _row(message, message)
    if row is None:
        raise BagError(f"{type(message).__name__}: no pose, transform or point in it")
    return row


def stamp_of(message: Any) -> int:
    """Return the time of a message's header in ns; 0 if it has none, or a negative one, which is no
    clock's."""
    if not hasattr(message, "header"):
        return 0
    stamp = message.header.stamp
    return max(0, int(stamp.sec * 1_000_000_000 + stamp.nanosec))


def frame_of(message: Any) -> str:
    """Return the frame_id of a message's header; empty if it has no header."""
    header = getattr(message, "header", None)
    return "" if header is None else str(header.frame_id)


def _row(item: Any, message: Any) -> tuple | None:
    """Return the row of an item in a message; None if the item is not one pose or point."""
    header = getattr(item, "header", None) or getattr(message, "header", None)
    frame = header.frame_id if header is not None else ""
    if hasattr(item, "point"):
        return frame, _xyz(item.point), None, None
    if hasattr(item, "transform"):
        t = item.transform
        return frame, _xyz(t.translation), _xyzw(t.rotation), None
    pose = getattr(item, "pose", item)
    covariance = getattr(pose, "covariance", None)
    pose = getattr(pose, "pose", pose)
    if hasattr(pose, "position") and hasattr(pose, "orientation"):
        return frame, _xyz(pose.position), _xyzw(pose.orientation), covariance
    return None


def _list_items(message: Any) -> list[tuple[tuple[str, ...], Any, tuple]]:
    """Return (names, item, row) for each item with a pose in the message's lists."""
    items = []
    fields = getattr(message, "get_fields_and_field_types", None)
    names = fields() if fields else getattr(message, "__dataclass_fields__", {})
    for name in names:
        values = getattr(message, name)
        if not isinstance(values, (list, tuple)):
            continue
        for k, item in enumerate(values):
            row = _row(item, message)
            if row is not None:
                items.append((_names_of(item) or (str(k),), item, row))
    return items


def _names_of(item: Any) -> tuple[str, ...]:
    """Return the names by which a body may be chosen, the longest first."""
    name = next((str(getattr(item, key)) for key in NAMES if hasattr(item, key)), "")
    if not name:
        return ()
    if hasattr(item, "transform") and hasattr(item, "header"):
        return f"{item.header.frame_id}->{name}", name
    return (name,)


def _list_names(items: Sequence[tuple[tuple[str, ...], Any, tuple]]) -> list[str]:
    return sorted({names[0] for names, _, _ in items})


def _xyz(point: Any) -> tuple[float, float, float]:
    return point.x, point.y, point.z


def _xyzw(rotation: Any) -> tuple[float, float, float, float]:
    return rotation.x, rotation.y, rotation.z, rotation.w
