"""The page about a real cell: its program follows a trajectory where a controller does not."""

# ruff: noqa: E402 - what needs ROS is imported after the check that it is there

import os
import re
import subprocess
import sys
from pathlib import Path
from unittest import mock

import pytest

pytestmark = [pytest.mark.ros, pytest.mark.wide]
pytest.importorskip("rclpy", reason="ROS 2 (rclpy) is not installed")
pytest.importorskip("parallel_cal_msgs", reason="the messages (msg_defs) are not installed")

from builtin_interfaces.msg import Duration
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from parallel_cal.nodes.client import Client, use_private_domain

PAGE = (Path(__file__).parents[2] / "docs" / "cell.md").read_text()


@mock.patch.dict(os.environ)
def test_the_pages_program_goes_straight_from_where_the_robot_is_to_every_point():
    (program,) = re.findall(r"^```python\n(.*?)^```$", PAGE, flags=re.M | re.S)
    namespace = use_private_domain()
    process = subprocess.Popen(
        [sys.executable, "-c", program, "--ros-args", "-r", f"__ns:={namespace}"],
        stderr=subprocess.DEVNULL,
    )
    client = Client("tester", namespace, [])
    try:
        node, heard = client._node, []
        node.create_subscription(
            Float64MultiArray, "/forward_position_controller/commands", heard.append, 5000
        )
        states = node.create_publisher(JointState, "joint_states", 10)
        trajectories = node.create_publisher(JointTrajectory, "joint_trajectory", 10)
        client.wait(lambda: trajectories.get_subscription_count(), "the program")
        client.wait(lambda: states.get_subscription_count(), "the program")
        here = JointState(name=["joint2", "joint1", "joint3"], position=[0.2, 0.1, 0.3])
        points = [
            JointTrajectoryPoint(positions=q, time_from_start=Duration(nanosec=ns))
            for q, ns in (([0.6, 0.2, 0.1], 10**8), ([0.7, 0.2, 0.1], 3 * 10**8))
        ]
        way = JointTrajectory(joint_names=["joint3", "joint2", "joint1"], points=points)

        def moves() -> bool:
            """Say both until commands come: a program counted as listening may not yet hear."""
            states.publish(here)
            trajectories.publish(way)
            return bool(heard)

        client.wait(moves, "the first command")
        client.wait(lambda: heard and heard[-1].data.tolist() == [0.1, 0.2, 0.7], "the end")
    finally:
        process.kill()
        process.wait()
        client.close()
    third = [message.data[2] for message in heard]
    assert third == sorted(third)
    assert third[0] >= 0.3
    assert all(list(message.data[:2]) == pytest.approx([0.1, 0.2]) for message in heard)
