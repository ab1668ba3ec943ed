"""The SROS2 policy in config/ is that of the nodes as they are."""

# ruff: noqa: E402 - what needs ROS is imported after the check that it is there

import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy")
pytest.importorskip("parallel_cal_msgs")

from parallel_cal.nodes.position_ik import find_service_type

POLICY = Path(__file__).parents[2] / "config" / "sros2_policy.xml"


def make(*arguments):
    command = [sys.executable, "-m", "parallel_cal.nodes.policy", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=120).stdout


def rights(root, group, right):
    """Return the names that each node has a right to."""
    return {
        profile.get("node"): {
            e.text for part in profile.iter(group) if part.get(right) for e in part
        }
        for profile in root.iter("profile")
    }


def test_the_policy_is_what_the_nodes_publish_hear_call_and_serve():
    pytest.importorskip("control_msgs")
    if find_service_type() is None:
        pytest.skip("moveit_msgs is not installed")
    assert make() == POLICY.read_text(), "python -m parallel_cal.nodes.policy > " + str(POLICY)


def test_nobody_but_the_kinematics_node_commands_and_no_right_is_a_pattern():
    root = ElementTree.parse(POLICY).getroot()
    names = [e.text for kind in ("topic", "service", "action") for e in root.iter(kind)]
    assert not any("*" in name for name in names)
    speaking = rights(root, "topics", "publish")
    assert [node for node, topics in speaking.items() if "joint_command" in topics] == [
        "kinematics_node"
    ]


def test_the_policy_allows_the_action_of_the_controller_and_the_topics_of_a_camera():
    root = ElementTree.parse(POLICY).getroot()
    action = {"joint_trajectory_controller/follow_joint_trajectory"}
    called = rights(root, "actions", "call")
    assert called == {"kinematics_node": action, "calibration_node": action}
    assert "~/motion_status" in rights(root, "topics", "publish")["kinematics_node"]
    heard = rights(root, "topics", "subscribe")["calibration_node"]
    assert {"camera/image_raw/compressed", "camera/camera_info"} <= heard
    assert "~/camera/board" in rights(root, "topics", "publish")["calibration_node"]


def test_names_of_ones_own_make_a_policy_of_ones_own():
    pytest.importorskip("control_msgs")
    given = ("-p", "trajectory_action:=/arm/follow", "-p", "images:=cell/image_raw")
    root = ElementTree.fromstring(make("--ros-args", *given, "-r", "joint_states:=arm/joints"))
    assert set.union(*rights(root, "actions", "call").values()) == {"arm/follow"}
    heard = rights(root, "topics", "subscribe")
    assert {"cell/image_raw", "cell/camera_info"} <= heard["calibration_node"]
    assert "arm/joints" in heard["kinematics_node"] & heard["calibration_node"]
    names = {e.text for e in root.iter("topic")}
    # Whoever moves the robot by an action needs no right to command it by a topic.
    assert not {"joint_states", "camera/camera_info", "joint_command"} & names
