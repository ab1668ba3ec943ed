"""Poses that are read from their bytes are those that the general decoder returns."""

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from parallel_cal.recordings.pose_bytes import VALUES, PoseReader
from parallel_cal.recordings.pose_messages import read_pose
from parallel_cal.recordings.standard_types import DEFINITIONS, collect_definitions

STORE = get_typestore(Stores.ROS2_JAZZY)
COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"


def serialized(type, frame="base", endian=True, seed=0):
    types, rng = STORE.types, np.random.default_rng(seed)
    stamp = types["builtin_interfaces/msg/Time"](2_000_000_000, 999_999_999)
    header = types["std_msgs/msg/Header"](stamp, frame)
    pose = types["geometry_msgs/msg/Pose"](
        types["geometry_msgs/msg/Point"](*rng.normal(size=3)),
        types["geometry_msgs/msg/Quaternion"](*rng.normal(size=4)),
    )
    if type == COVARIANCE:
        pose = types["geometry_msgs/msg/PoseWithCovariance"](pose, rng.normal(size=36))
    return bytes(STORE.serialize_cdr(types[type](header, pose), type, little_endian=endian))


@pytest.mark.parametrize("frame", ["", "b", "ba", "base", "a longer frame"])
@pytest.mark.parametrize("type", VALUES)
def test_a_second_pose_is_read_as_the_general_decoder_reads_it(frame, type):
    first, second = serialized(type, frame), serialized(type, frame, seed=1)
    reader = PoseReader(type)
    assert reader.read(second) is None
    reader.learn(first, frame)
    stamp, row = reader.read(second)
    expected_stamp, expected = read_pose(STORE.deserialize_cdr(second, type))
    assert stamp == expected_stamp
    assert row[:3] == expected[:3]
    assert (row[3] is None) == (expected[3] is None)
    if row[3] is not None:
        np.testing.assert_array_equal(row[3], expected[3])


@pytest.mark.parametrize("type", VALUES)
def test_poses_of_another_layout_are_left_to_the_general_decoder(type):
    usual = serialized(type)
    reader = PoseReader(type)
    reader.learn(usual, "base")
    assert reader.read(usual) is not None
    assert reader.read(serialized(type, "race")) is None
    assert reader.read(serialized(type, endian=False)) is None
    assert reader.read(usual + b"\0" * 8) is None
    for cut in range(len(usual)):
        assert reader.read(usual[:cut]) is None, cut


def test_a_type_without_a_fixed_number_of_values_teaches_the_reader_nothing():
    reader = PoseReader("geometry_msgs/msg/PoseArray")
    data = serialized(COVARIANCE)
    reader.learn(data, "base")
    assert reader.read(data) is None


def test_the_standard_types_are_those_of_jazzy_and_what_they_contain():
    from rosbags.typesys import get_types_from_msg

    for name, text in DEFINITIONS.items():
        ours = get_types_from_msg(text, name)[name]
        theirs = STORE.fielddefs[name]
        assert [(field, kind[1]) for field, kind in ours[1]] == [
            (field, kind[1]) for field, kind in theirs[1]
        ], name
    needed = collect_definitions([COVARIANCE])
    assert "geometry_msgs/msg/Quaternion" in needed
    assert "sensor_msgs/msg/JointState" not in needed
