"""Numbers that were no floats in the driver are named with their cause, topic and sample."""

import struct

import bag_writing as bw
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from test_publishers import ALONE, ROBOT

import parallel_cal as pc
from parallel_cal.base.errors import BagError, DatasetError
from parallel_cal.nodes.collector import Collector


def as_float32(value):
    """What a float64 field holds if the 4 bytes of a float32 are written into it."""
    return struct.unpack("<d", struct.pack("<fI", value, 0))[0]


def as_int(value):
    """What a float64 field holds if the bytes of an int are written into it."""
    return struct.unpack("<d", struct.pack("<q", value))[0]


def changed_poses(change):
    poses = bw.poses(ROBOT)
    for k, (*_, message) in enumerate(poses):
        change(k, message.pose.pose)
    return [*bw.joint_states(ROBOT), *poses]


def test_the_bytes_of_other_types_are_what_the_issue_shows():
    assert as_int(1) == 5e-324
    assert np.isnan(as_int(-1))
    assert 5e-315 < as_float32(0.2) < 6e-315


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_float32_positions_are_named_with_topic_message_cause_and_cure(axis, tmp_path):
    def change(k, pose):
        setattr(pose.position, axis, as_float32(getattr(pose.position, axis)))

    path = bw.write_bag(tmp_path / "bag", changed_poses(change))
    with pytest.raises(BagError) as error:
        pc.load_dataset(path)
    words = str(error.value)
    assert "measured_pose" in words
    assert "message 0" in words
    assert "e-31" in words
    assert "numpy.float32 or an int" in words
    assert "float()" in words
    assert "ROS_PYTHON_CHECK_FIELDS=1" in words
    assert "deg" not in words
    collector = Collector()
    with AnyReader([path]) as reader:
        for connection, log, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            collector.receive(connection.topic, message, log)
    collector.refresh()
    assert any("numpy.float32 or an int" in warning for warning in collector.warnings())


def test_some_float32_quaternions_are_dropped_and_counted(tmp_path):
    def change(k, pose):
        if k < 5:
            pose.orientation.z = as_float32(0.6)

    found = pc.load_dataset(bw.write_bag(tmp_path / "bag", changed_poses(change)))
    (dropped,) = found.dropped
    assert dropped.count == 5
    assert "numpy.float32 or an int" in dropped.reason
    assert "message 0" in dropped.detail


def test_a_negative_int_beside_other_ints_is_named_as_the_cause_of_nan(tmp_path):
    def change(k, pose):
        pose.position.x = as_int(1 if k % 2 else -1)

    found = bw.write_bag(tmp_path / "bag", changed_poses(change))
    with pytest.raises(
        BagError, match=r"pose is not finite \(probably a negative int in a float64"
    ):
        pc.load_dataset(found)


def test_joint_readings_too(tmp_path):
    states = bw.joint_states(ROBOT)
    for *_, message in states:
        message.position[1] = as_float32(message.position[1])
    with pytest.raises(BagError, match=r"joint_states: none.* a numpy\.float32 or an int .*e-31"):
        pc.load_dataset(bw.write_bag(tmp_path / "bag", [*states, *bw.poses(ROBOT)]))


@pytest.mark.parametrize("make", [bw.temperature, bw.payload])
def test_a_condition_of_ints_is_ignored_with_the_cause(make, tmp_path):
    values = [make(float(t), as_int(20)) for t in range(9)]
    found = pc.load_dataset(bw.write_bag(tmp_path / "bag", [*ALONE, *values]))
    assert make.__name__ not in found.conditions
    (warning,) = (w for w in found.warnings if make.__name__ in w)
    assert "numpy.float32 or an int" in warning
    assert "9.88e-323" in warning


def test_tf_too(tmp_path):
    names = ("TransformStamped", "Transform", "Vector3", "Quaternion")
    stamped, transform, vector, turn = (bw.kind(f"geometry_msgs/msg/{name}") for name in names)
    tf = []
    for _, _, log, message in bw.poses(ROBOT):
        p = message.pose.pose.position
        moved = transform(vector(as_float32(p.x), p.y, p.z), turn(0.0, 0.0, 0.6, 0.8))
        body = bw.kind("tf2_msgs/msg/TFMessage")([stamped(message.header, "tool", moved)])
        tf.append(("tf", "tf2_msgs/msg/TFMessage", log, body))
    path = bw.write_bag(tmp_path / "bag", [*bw.joint_states(ROBOT), *tf])
    with pytest.raises(BagError, match=r"tf: none .* a numpy\.float32 or an int"):
        pc.load_dataset(path, topics={"measured_pose": "tf:base->tool"})


def test_tables_arrays_and_files_of_samples_too(tmp_path):
    table = tmp_path / "s.csv"
    header = "joint1 [rad],joint2 [rad],x [m],y [m],z [m]"
    table.write_text(f"{header}\n0.1,0.2,0.3,0.1,0.2\n0.3,0.1,5.3e-315,0.1,0.2\n")
    with pytest.raises(
        DatasetError, match=r"s.csv:3: column x \[m\] contains '5.3e-315': .*float32"
    ):
        pc.load_dataset(table, joints=("joint1", "joint2"))
    with pytest.raises(DatasetError, match=r"r\[1\] is .*float32"):
        pc.Dataset.from_arrays(["a"], [[0.1], [0.2]], [[0, 0, 1], [0, 0, 5e-324]])
    data = pc.Dataset.from_arrays(["a"], [[0.1], [0.2]], [[0, 0, 1], [0, 0, 0.987]])
    data.to_json(tmp_path / "d.json")
    text = (tmp_path / "d.json").read_text()
    (tmp_path / "d.json").write_text(text.replace("0.987", "5e-324"))
    with pytest.raises(DatasetError, match=r"r of sample 1 is 0 0 4.941e-324: .*float32"):
        pc.load_dataset(tmp_path / "d.json")


def test_exact_zeros_are_numbers(tmp_path):
    found = pc.load_dataset(
        bw.write_bag(
            tmp_path / "bag", changed_poses(lambda k, pose: setattr(pose.position, "x", 0.0))
        )
    )
    assert len(found) == 6
