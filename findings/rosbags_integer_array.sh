#!/bin/sh
# Versions: rosbags 0.11.9, numpy 2.4.6
# Question: rosbags writes a JointState whose position is np.array([0, 1, 2]). What is in the bag?
# Guess: "0.0, 1.0, 2.0, or an error about the dtype: the field is float64[]."
# True: 0, 5e-324, 1e-323. The serializer copies the bytes of the array and does not look at its dtype. An
#   array of float32 is refused, because its size differs. An int64 has 8 bytes, as a float64 has. A scalar
#   integer in a float64 field is refused ("required argument is not a float").
# Matters: Encoder counts, or angles in whole degrees, are integers. A script that converts a controller's
#   log to a bag writes joints that stand at zero, and no reader can tell it from a robot that rests.
cd "$(dirname "$0")" && ./with_packages rosbags==0.11.9 numpy==2.4.6 <<'END'
import numpy as np
from rosbags.typesys import Stores, get_typestore

store = get_typestore(Stores.ROS2_JAZZY)
kind, none = "sensor_msgs/msg/JointState", np.array([])
stamp = store.types["builtin_interfaces/msg/Time"](sec=1, nanosec=0)
header = store.types["std_msgs/msg/Header"](stamp=stamp, frame_id="")


def write(position):
    message = store.types[kind](header, ["a", "b", "c"], position, none, none)
    return store.deserialize_cdr(store.serialize_cdr(message, kind), kind).position


for position in (np.array([0.0, 1.0, 2.0]), np.array([0, 1, 2])):
    print(position.dtype, position, "is read back as", write(position))
assert (write(np.array([0.0, 1.0, 2.0])) == [0, 1, 2]).all()
assert (write(np.array([0, 1, 2])) == [0, 5e-324, 1e-323]).all()
try:
    write(np.array([0, 1, 2], np.float32))
except ValueError as error:
    print("float32:", error)
else:
    raise SystemExit("float32 was accepted")
END
# Seen:
#   float64 [0. 1. 2.] is read back as [0. 1. 2.]
#   int64 [0 1 2] is read back as [0.e+000 5.e-324 1.e-323]
#   float32: memoryview assignment: lvalue and rvalue have different structures
