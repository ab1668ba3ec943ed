"""The nodes as commands: --help, and one line without ROS 2."""

import subprocess
import sys

import pytest

NODES = ("kinematics_node", "calibration_node", "replay_node", "virtual_cell_node")


def command(node, *arguments, before="pass"):
    code = f"import sys; {before}; from parallel_cal.nodes.start import {node}; sys.exit({node}())"
    return subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, timeout=60
    )


@pytest.mark.parametrize("node", NODES)
def test_without_ros_a_node_says_so_in_one_line(node):
    done = command(node, "--help", before="sys.modules['rclpy'] = None")
    assert done.returncode == 1
    assert done.stderr.startswith(f"error: {node} needs ROS 2, and rclpy is not installed")
    assert "pip install 'parallel_cal[ros]'" in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.ros
@pytest.mark.parametrize("node", NODES)
def test_help_names_every_parameter_with_default_and_range(node):
    pytest.importorskip("rclpy")
    done = command(node, "--help")
    assert done.returncode == 0, done.stderr
    assert f"usage: {node}" in done.stdout
    if node == "kinematics_node":
        assert "(a number from 0 to 3600; 0.1)" in done.stdout
    assert "  " in done.stdout
