"""Poses from the messages of drivers of others: lists of named bodies, tags and tf.

Each bag holds the same measurement twice: as PoseStamped, and as a driver's message.
"""

from pathlib import Path

import bag_writing as bw
import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from parallel_cal.base.errors import BagError
from parallel_cal.recordings.bag import read_bag
from parallel_cal.recordings.options import ReadOptions

# Message definitions of drivers, as in their packages' .msg files (comments and order of fields
# aside): motion_capture_tracking_interfaces, mocap4r2_msgs, aruco_opencv_msgs.
OTHERS = {
    "motion_capture_tracking_interfaces/msg/NamedPose": "string name\ngeometry_msgs/Pose pose\n",
    "motion_capture_tracking_interfaces/msg/NamedPoseArray": "std_msgs/Header header\n"
    "motion_capture_tracking_interfaces/NamedPose[] poses\n",
    "mocap4r2_msgs/msg/RigidBody": "string rigid_body_name\ngeometry_msgs/Pose pose\n",
    "mocap4r2_msgs/msg/RigidBodies": "std_msgs/Header header\nuint32 frame_number\n"
    "mocap4r2_msgs/RigidBody[] rigidbodies\n",
    "aruco_opencv_msgs/msg/MarkerPose": "uint16 marker_id\ngeometry_msgs/Pose pose\n",
    "aruco_opencv_msgs/msg/ArucoDetection": "std_msgs/Header header\n"
    "aruco_opencv_msgs/MarkerPose[] markers\n",
    "apriltag_msgs/msg/Point": "float64 x\nfloat64 y\n",
    "apriltag_msgs/msg/AprilTagDetection": "string family\nint32 id\nint32 hamming\n"
    "float32 goodness\nfloat32 decision_margin\napriltag_msgs/Point centre\n"
    "apriltag_msgs/Point[4] corners\nfloat64[9] homography\n",
    "apriltag_msgs/msg/AprilTagDetectionArray": "std_msgs/Header header\n"
    "apriltag_msgs/AprilTagDetection[] detections\n",
    "my_driver_msgs/msg/Strange": "std_msgs/Header header\nfloat64 x\n",
}
STORE = get_typestore(Stores.ROS2_JAZZY)
for name, text in OTHERS.items():
    STORE.register(get_types_from_msg(text, name))
ROBOT = bw.Session([[0.1, 0.2, 0.1], [0.4, 0.0, 0.2], [0.2, 0.3, 0.0]])


def kind(name):
    return STORE.types[name]


def other_pose():
    """Where another body is that nobody asks for."""
    return bw.pose(0.0, (9.0, 9.0, 9.0), type=bw.POSE)[3].pose


def named(package, array, item, field, name="platform", numbered=False):
    """Messages of a driver from PoseStamped ones: a list of two bodies, the wanted one second."""

    def driver(message):
        _, _, log, stamped = message
        one, two = (7, 3) if numbered else ("marker cup", name)
        bodies = [kind(f"{package}/msg/{item}")(one, other_pose())]
        bodies += [kind(f"{package}/msg/{item}")(two, stamped.pose)]
        more = [1] if field == "rigidbodies" else []
        type = f"{package}/msg/{array}"
        return "/bodies", type, log, kind(type)(stamped.header, *more, bodies)

    return driver


def transform(message):
    """A message of its own for each pose, as vicon_bridge publishes them."""
    _, _, log, stamped = message
    p = stamped.pose.position
    moved = kind("geometry_msgs/msg/Vector3")(p.x, p.y, p.z)
    body = kind("geometry_msgs/msg/TransformStamped")(
        stamped.header,
        "platform",
        kind("geometry_msgs/msg/Transform")(moved, stamped.pose.orientation),
    )
    return "/vicon/platform/platform", "geometry_msgs/msg/TransformStamped", log, body


def tf(message):
    """A tf message of the frame, between those of others, with its own stamp."""
    _, _, log, stamped = message
    make = kind("geometry_msgs/msg/TransformStamped")
    p = stamped.pose.position
    moved = kind("geometry_msgs/msg/Vector3")(p.x, p.y, p.z)
    transform = kind("geometry_msgs/msg/Transform")(moved, stamped.pose.orientation)
    away = kind("geometry_msgs/msg/Transform")(
        kind("geometry_msgs/msg/Vector3")(9.0, 9.0, 9.0), stamped.pose.orientation
    )
    body = kind("tf2_msgs/msg/TFMessage")(
        [make(stamped.header, "camera", away), make(stamped.header, "tag_3", transform)]
    )
    return "/tf", "tf2_msgs/msg/TFMessage", log, body


def write(path: Path, messages):
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {}
        for topic, type, log, message in sorted(messages, key=lambda m: m[2]):
            if (topic, type) not in connections:
                connections[topic, type] = writer.add_connection(topic, type, typestore=STORE)
            writer.write(connections[topic, type], log, STORE.serialize_cdr(message, type))
    return path


DRIVERS = {
    "/bodies:platform": named(
        "motion_capture_tracking_interfaces", "NamedPoseArray", "NamedPose", "poses"
    ),
    "bodies:platform": named("mocap4r2_msgs", "RigidBodies", "RigidBody", "rigidbodies"),
    "/bodies:3": named(
        "aruco_opencv_msgs", "ArucoDetection", "MarkerPose", "markers", numbered=True
    ),
    "/vicon/platform/platform": transform,
    "/tf:tag_3": tf,
    "/tf:base->tag_3": tf,
}


def recorded(tmp_path, driver):
    poses = bw.poses(ROBOT, type=bw.POSE)
    messages = bw.joint_states(ROBOT) + poses + [driver(one) for one in poses]
    return write(tmp_path / "bag", messages)


@pytest.mark.parametrize("topic", DRIVERS)
def test_a_body_in_a_drivers_messages_is_read_like_a_pose(tmp_path, topic):
    bag = recorded(tmp_path, DRIVERS[topic])
    plain = read_bag(bag).pose
    driver = read_bag(bag, ReadOptions(topics={"measured_pose": topic})).pose
    assert len(driver.time) == len(plain.time) > 50
    np.testing.assert_array_equal(driver.time, plain.time)
    np.testing.assert_array_equal(driver.position, plain.position)
    np.testing.assert_array_equal(driver.quaternion, plain.quaternion)
    assert driver.frame == plain.frame == "base"


def test_messages_of_other_frames_between_are_no_loss(tmp_path):
    poses = bw.poses(ROBOT, type=bw.POSE)
    lone = [tf(one) for one in poses]
    for _, _, _, message in lone[::2]:
        message.transforms = message.transforms[:1]
    bag = write(tmp_path / "bag", bw.joint_states(ROBOT) + lone)
    found = read_bag(bag, ReadOptions(topics={"measured_pose": "/tf:tag_3"}))
    assert len(found.pose.time) == len(poses) // 2
    assert [d for d in found.dropped if "decoded" in d.reason] == []


def test_without_the_name_of_a_body_the_message_lists_those_there_are(tmp_path):
    bag = recorded(tmp_path, DRIVERS["/bodies:platform"])
    with pytest.raises(BagError, match=r"/bodies: a message holds 2 bodies \(marker cup, platform"):
        read_bag(bag, ReadOptions(topics={"measured_pose": "/bodies"}))


def test_an_unknown_body_is_refused_with_those_there_are(tmp_path):
    bag = recorded(tmp_path, DRIVERS["/bodies:platform"])
    with pytest.raises(BagError, match="no body 'plattform' in its messages; they hold marker cup"):
        read_bag(bag, ReadOptions(topics={"measured_pose": "/bodies:plattform"}))


def test_a_driver_whose_messages_hold_no_pose_is_refused_with_a_cure(tmp_path):
    def strange(message):
        type = "my_driver_msgs/msg/Strange"
        return "/strange", type, message[2], kind(type)(message[3].header, 1.0)

    bag = recorded(tmp_path, strange)
    with pytest.raises(BagError, match=r"hold no pose, transform or point.*PARENT->CHILD"):
        read_bag(bag, ReadOptions(topics={"measured_pose": "/strange"}))


def test_tags_without_poses_are_refused_with_a_cure(tmp_path):
    """apriltag_ros publishes pixels of tags, and their poses as tf."""

    def pixels(message):
        corners = [kind("apriltag_msgs/msg/Point")(1.0, 2.0)] * 4
        tag = kind("apriltag_msgs/msg/AprilTagDetection")(
            "tag36h11", 3, 0, 1.0, 1.0, corners[0], corners, np.eye(3).ravel()
        )
        type = "apriltag_msgs/msg/AprilTagDetectionArray"
        return "/detections", type, message[2], kind(type)(message[3].header, [tag])

    bag = recorded(tmp_path, pixels)
    with pytest.raises(BagError, match=r"hold no pose, transform or point.*PARENT->CHILD"):
        read_bag(bag, ReadOptions(topics={"measured_pose": "/detections:3"}))


def test_a_topic_of_another_standard_type_is_still_refused_by_its_type(tmp_path):
    bag = recorded(tmp_path, tf)
    with pytest.raises(BagError, match=r"joint_states has type .*; expected .*TFMessage"):
        read_bag(bag, ReadOptions(topics={"measured_pose": "/joint_states"}))
