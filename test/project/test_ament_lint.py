"""The linters of ROS accept the package: XML against its schemas, CMake, and licence headers.

They come with ROS, and with Debian and Ubuntu as python3-ament-xmllint and so on; without them
these tests are skipped.
"""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOR_TESTS = ["test/control_msgs", "test/moveit_msgs", "test/tf2_msgs"]
XML = ["package.xml", "msg_defs", "config", *FOR_TESTS]
CMAKE = ["msg_defs", "parallel_cal/exporting", *FOR_TESTS]
# What ROS reads by itself has the header; LICENSE is the licence of everything.
LICENSED = ["LICENSE", "launch", "msg_defs"]


@pytest.mark.parametrize(
    ("linter", "paths"),
    [("ament_xmllint", XML), ("ament_lint_cmake", CMAKE), ("ament_copyright", LICENSED)],
)
def test_the_linter_finds_no_problem(linter, paths):
    command = shutil.which(linter)
    if command is None:
        pytest.skip(f"{linter} is not installed")
    # The linters belong to the Python of the system, not to the one that runs the tests.
    foreign = ("PYTHON", "VIRTUAL_ENV", "LD_LIBRARY_PATH")
    own = {name: value for name, value in os.environ.items() if not name.startswith(foreign)}
    if "ros" in Path(command).parts:  # of a ROS installation, which needs its paths
        own = dict(os.environ)
    done = subprocess.run(
        [command, *paths], cwd=ROOT, env=own, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stdout + done.stderr
