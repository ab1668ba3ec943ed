"""A bag of ROS 1 gives the samples that the same messages give in a recording of ROS 2."""

import bag_writing as bw
import numpy as np
import pytest
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from test_tf_chain import messages as chain_messages

import parallel_cal as pc
from parallel_cal.base.errors import BagError
from parallel_cal.recordings.bag import read_bag
from parallel_cal.recordings.options import ReadOptions

ROS_1 = get_typestore(Stores.ROS1_NOETIC)
ROBOT = bw.Session([[0.1, 0.2], [0.4, 0.0], [0.2, 0.5]])
MESSAGES = [*bw.joint_states(ROBOT), *bw.poses(ROBOT)]


def as_ros1(message):
    """The message with the types of ROS 1, whose header counts messages (seq)."""
    if isinstance(message, list):
        return [as_ros1(one) for one in message]
    if not hasattr(message, "__msgtype__"):
        return message
    fields = {name: as_ros1(getattr(message, name)) for name in message.__dataclass_fields__}
    count = {"seq": 7} if message.__msgtype__ == "std_msgs/msg/Header" else {}
    return ROS_1.types[message.__msgtype__](**(count | fields))


def write_ros1(path, messages, compression=None):
    """Write messages with the ROS 1 writer of the library."""
    writer = Writer(path)
    if compression:
        writer.set_compression(compression)
    with writer:
        opened = {}
        for topic, kind, log, message in sorted(messages, key=lambda m: m[2]):
            if topic not in opened:
                opened[topic] = writer.add_connection(f"/{topic}", kind, typestore=ROS_1)
            writer.write(opened[topic], log, ROS_1.serialize_ros1(as_ros1(message), kind))
    return path


@pytest.mark.parametrize("compression", [None, *Writer.CompressionFormat])
def test_a_bag_of_ros_1_gives_the_samples_of_the_same_messages_in_ros_2(tmp_path, compression):
    first = pc.load_dataset(write_ros1(tmp_path / "a.bag", MESSAGES, compression))
    second = pc.load_dataset(bw.write_bag(tmp_path / "bag", MESSAGES))
    assert len(first) == 3
    for name in ("q", "r", "R", "pose_cov"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_a_type_of_ones_own_is_read_by_the_definition_in_the_bag(tmp_path):
    text = "std_msgs/Header header\nstring name\ngeometry_msgs/Pose pose\n"
    ROS_1.register(get_types_from_msg(text, "lab_msgs/msg/Body"))
    body = ROS_1.types["lab_msgs/msg/Body"]
    own = [
        ("body", "lab_msgs/msg/Body", log, body(as_ros1(m.header), "tool", as_ros1(m.pose.pose)))
        for _, _, log, m in bw.poses(ROBOT)
    ]
    path = write_ros1(tmp_path / "a.bag", [*bw.joint_states(ROBOT), *own])
    found = pc.load_dataset(path, topics={"measured_pose": "/body"})
    np.testing.assert_allclose(found.r, pc.load_dataset(bw.write_bag(tmp_path / "c", MESSAGES)).r)


def test_a_cut_bag_of_ros_1_is_called_damaged_with_the_cure(tmp_path):
    path = write_ros1(tmp_path / "a.bag", MESSAGES)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(BagError, match=r"a\.bag: damaged or truncated.*rosbag reindex"):
        read_bag(path)


def test_tf_of_ros_1_is_that_of_ros_2(tmp_path):
    # Old recordings hold tf/tfMessage; ROS 2 has tf2_msgs/TFMessage with the same fields.
    text = "geometry_msgs/TransformStamped[] transforms\n"
    ROS_1.register(get_types_from_msg(text, "tf/msg/tfMessage"))
    moving = [m for m in chain_messages() if m[0] in ("tf", "tf_static")]
    old = [
        (topic, "tf/msg/tfMessage", log, ROS_1.types["tf/msg/tfMessage"](as_ros1(m.transforms)))
        for topic, _, log, m in moving
    ]
    path = write_ros1(tmp_path / "a.bag", [*bw.joint_states(ROBOT), *old])
    topics = {"measured_pose": "/tf:world->tool"}
    new = bw.write_bag(tmp_path / "b", [*bw.joint_states(ROBOT), *moving])
    first, second = (read_bag(p, ReadOptions(topics=topics)).pose for p in (path, new))
    np.testing.assert_array_equal(first.position, second.position)
