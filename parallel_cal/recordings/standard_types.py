"""The standard message types that a recording is usually read from, as ROS 2 Jazzy defines them.

The library that reads bags has them too, but only together with 200 others, which take longer to
load than most recordings take to read.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

# A type and its fields. The types that it contains are standard types, too.
DEFINITIONS = {
    "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec",
    "std_msgs/msg/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "std_msgs/msg/String": "string data",
    "geometry_msgs/msg/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/msg/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/msg/Quaternion": "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1",
    "geometry_msgs/msg/Pose": (
        "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation"
    ),
    "geometry_msgs/msg/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance",
    "geometry_msgs/msg/PointStamped": "std_msgs/Header header\ngeometry_msgs/Point point",
    "geometry_msgs/msg/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose",
    "geometry_msgs/msg/PoseWithCovarianceStamped": (
        "std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose"
    ),
    "geometry_msgs/msg/Inertia": (
        "float64 m\ngeometry_msgs/Vector3 com\n"
        "float64 ixx\nfloat64 ixy\nfloat64 ixz\nfloat64 iyy\nfloat64 iyz\nfloat64 izz"
    ),
    "geometry_msgs/msg/InertiaStamped": "std_msgs/Header header\ngeometry_msgs/Inertia inertia",
    "sensor_msgs/msg/JointState": (
        "std_msgs/Header header\nstring[] name\n"
        "float64[] position\nfloat64[] velocity\nfloat64[] effort"
    ),
    "sensor_msgs/msg/Temperature": (
        "std_msgs/Header header\nfloat64 temperature\nfloat64 variance"
    ),
    "sensor_msgs/msg/Range": (
        "uint8 ULTRASOUND=0\nuint8 INFRARED=1\nstd_msgs/Header header\nuint8 radiation_type\n"
        "float32 field_of_view\nfloat32 min_range\nfloat32 max_range\nfloat32 range\n"
        "float32 variance"
    ),
}


def collect_definitions(types: Iterable[str]) -> dict[str, str]:
    """Return the fields of these types and of those that they contain."""
    needed = list(types)
    for name in needed:  # the list grows by the types that each one contains
        inside = re.findall(r"^(\w+)/(\w+)", DEFINITIONS[name], re.MULTILINE)
        needed += [f"{package}/msg/{type}" for package, type in inside]
    return {name: DEFINITIONS[name] for name in needed}
