"""The SROS2 policy in config/ is that of the nodes as they are."""

import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy")
pytest.importorskip("parallel_cal_msgs")

POLICY = Path(__file__).parents[1] / "config" / "sros2_policy.xml"


def test_the_policy_is_what_the_nodes_publish_hear_and_serve():
    command = [sys.executable, "-m", "parallel_cal.nodes.policy"]
    made = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    assert made.stdout == POLICY.read_text(), "python -m parallel_cal.nodes.policy > " + str(POLICY)


def test_nobody_but_the_kinematics_node_commands_and_no_right_is_a_pattern():
    root = ElementTree.parse(POLICY).getroot()
    names = [e.text for kind in ("topic", "service", "action") for e in root.iter(kind)]
    assert not any("*" in name for name in names)
    speaking = [
        profile.get("node")
        for profile in root.iter("profile")
        for topics in profile.iter("topics")
        if topics.get("publish") and "joint_command" in [t.text for t in topics]
    ]
    assert speaking == ["kinematics_node"]
