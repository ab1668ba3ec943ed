"""The client that calls the nodes leaves nothing of ROS behind."""

# ruff: noqa: E402 - what needs ROS is imported after the check that it is there

import os
from unittest import mock

import pytest

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy", reason="ROS 2 (rclpy) is not installed")
pytest.importorskip("parallel_cal_msgs", reason="the messages (msg_defs) are not installed")

from parallel_cal_msgs.action import Calibrate
from rclpy.action import ActionClient
from rclpy.exceptions import InvalidHandle

from parallel_cal.nodes.client import Client, use_private_domain


@mock.patch.dict(os.environ)
def test_no_action_client_outlives_its_context():
    """It was left to the garbage collection, which may run in any thread, and crashed a process."""
    client = Client("closing", use_private_domain(), [])
    action = ActionClient(client._node, Calibrate, "calibrate")
    client._clients["calibrate"] = action
    usable = []
    client._context.on_shutdown(lambda: usable.append(is_usable(action)))
    assert is_usable(action)
    client.close()
    assert usable == [False]


def is_usable(action):
    try:
        with action._client_handle:
            return True
    except InvalidHandle:
        return False
