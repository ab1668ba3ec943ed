"""Programs that run at once have a ROS domain each, whatever their process numbers."""

import subprocess
import sys
from contextlib import ExitStack

import pytest

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy", reason="ROS 2 (rclpy) is not installed")

CODE = """
import os
os.getpid = lambda: 7  # as in containers that share a network
from parallel_cal.nodes.client import use_private_domain
assert use_private_domain() == use_private_domain() == "/of_7"
print(os.environ["ROS_DOMAIN_ID"], flush=True)
input()
"""


def program():
    return subprocess.Popen(
        [sys.executable, "-c", CODE], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )


def ended(process):
    process.communicate("\n")
    return process.returncode


def test_programs_that_run_at_once_have_a_domain_each():
    with ExitStack() as stack:
        running = [stack.enter_context(program()) for _ in range(3)]
        domains = [int(process.stdout.readline()) for process in running]
        assert len(set(domains)) == 3
        assert all(1 <= domain <= 100 for domain in domains)
        assert [ended(process) for process in running] == [0, 0, 0]
