"""calibration_node takes the poses of one body from the messages of somebody else's driver."""

# ruff: noqa: E402 - what needs ROS is imported after the check that it is there

import bag_writing as bw
import numpy as np
import pytest

pytestmark = [pytest.mark.ros, pytest.mark.wide]
pytest.importorskip("rclpy")

from parallel_cal_msgs.srv import SaveSamples
from ros_helpers import NodeProcess

from parallel_cal.nodes.client import Client, use_private_domain
from parallel_cal.recordings.loading import load_dataset
from parallel_cal.recordings.options import ReadOptions

ARRAY = "geometry_msgs/msg/PoseArray"
ROBOT = bw.Session([[0.1, 0.2, 0.1], [0.4, 0.0, 0.2], [0.2, 0.3, 0.0], [0.0, 0.1, 0.2]])


def array(message):
    """A driver's message: the wanted body is the second of two."""
    _, _, log, stamped = message
    other = bw.pose(0.0, (9.0, 9.0, 9.0), type=bw.POSE)[3].pose
    body = bw.kind(ARRAY)(stamped.header, [other, stamped.pose])
    return "bodies", ARRAY, log, body


def test_the_node_takes_the_samples_that_the_recording_of_the_driver_holds(tmp_path):
    messages = bw.joint_states(ROBOT) + [array(p) for p in bw.poses(ROBOT, type=bw.POSE)]
    bag = bw.write_bag(tmp_path / "bag", messages)
    namespace = use_private_domain()
    node = NodeProcess(
        "calibration_node",
        tmp_path,
        namespace,
        ros=["-r", "measured_pose:=bodies"],
        driver_type=ARRAY,
        body="1",
        journal_folder=str(tmp_path),
        allowed_folders=str(tmp_path),
    )
    client = Client("tester", namespace, [node])
    try:
        client.wait(lambda: "collecting" in node.said, "the node")
        replay = NodeProcess("replay_node", tmp_path, namespace, bag=str(bag), rate=4.0)
        assert replay.ended() == 0
        path, taken = tmp_path / "samples.json", []

        def is_taken():
            service = "calibration_node/save_samples"
            taken.append(client.call(SaveSamples, service, path=str(path)))
            return taken[-1].samples == len(ROBOT.stops)

        client.wait(is_taken, "the samples")
    finally:
        client.close()
        assert node.end() == 0
    live = load_dataset(path)
    recorded = load_dataset(bag, ReadOptions(topics={"measured_pose": "bodies:1"}))
    np.testing.assert_allclose(live.r, recorded.r, atol=1e-9)
    assert np.abs(live.r).max() < 1.0  # not the other body


def test_a_driver_type_that_is_not_installed_is_one_clear_line(tmp_path):
    node = NodeProcess(
        "calibration_node", tmp_path, use_private_domain(), driver_type="their_msgs/msg/Poses"
    )
    assert node.ended() == 1
    assert "error: driver_type their_msgs/msg/Poses: not found" in node.said
