#!/bin/sh
# Versions: rclpy 7.1.6 and geometry_msgs 5.3.6 (ROS 2 Jazzy), Python 3.11
# Question: What does a subscriber read after `point.x = 1` in rclpy?
# Guess: "1.0, or an AssertionError that says the field must be of type float."
# True: About 5e-324. The generated code copies the bytes of the integer object as if they were those of a
#   float. No error is raised: the check of the type runs only with ROS_PYTHON_CHECK_FIELDS=1. np.float64 is
#   a float and is right.
# Matters: A driver that publishes a position in whole steps, or `z = 0 if flat else height`, publishes 0 mm
#   for every whole number. A calibration then sees a robot that did not move.
cd "$(dirname "$0")" && ./with_packages ros-jazzy-rclpy==7.1.6 ros-jazzy-geometry-msgs==5.3.6 \
  ros-jazzy-rmw-fastrtps-cpp==8.4.3 numpy==2.4.6 <<'END'
import os
import subprocess
import sys

import numpy as np
from geometry_msgs.msg import Point
from rclpy.serialization import deserialize_message, serialize_message

for value in (1.0, np.float64(1), 1, 1000):
    point = Point()
    point.x = value
    read = deserialize_message(serialize_message(point), Point).x
    print(f"x = {value!r}: read back as {read}")
    assert read == 1 if isinstance(value, float) else 0 < read < 1e-300

checked = subprocess.run(
    [sys.executable, "-c", "from geometry_msgs.msg import Point; Point().x = 1"],
    env={**os.environ, "ROS_PYTHON_CHECK_FIELDS": "1"}, capture_output=True, text=True,
)
print("ROS_PYTHON_CHECK_FIELDS=1:", checked.stderr.splitlines()[-1])
assert "must be of type 'float'" in checked.stderr
END
# Seen:
#   x = 1.0: read back as 1.0
#   x = np.float64(1.0): read back as 1.0
#   x = 1: read back as 5e-324
#   x = 1000: read back as 5e-324
#   ROS_PYTHON_CHECK_FIELDS=1: AssertionError: The 'x' field must be of type 'float'
