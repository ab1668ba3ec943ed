"""The rules of the layout that no reader should have to check by hand."""

import ast
import subprocess
import sys
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "parallel_cal"
MAY_USE_ROSBAGS = {"bag.py", "bag_writer.py", "replay_node.py"}


def imports(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module or ""


def test_only_nodes_import_rclpy_and_only_the_bag_files_import_rosbags():
    for path in PACKAGE.rglob("*.py"):
        names = {name.split(".")[0] for name in imports(path)}
        if path.parent.name != "nodes":
            assert not names & {"rclpy", "parallel_cal_msgs"}, path
        if path.name not in MAY_USE_ROSBAGS:
            assert "rosbags" not in names, path


def test_the_mathematics_loads_without_scipy_rosbags_or_ros():
    code = (
        "import sys, parallel_cal.identification, parallel_cal.kinematics\n"
        "heavy = ('scipy', 'rosbags', 'rclpy', 'plotly', 'pydantic')\n"
        "print([m for m in heavy if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_virtual_robot_shares_nothing_with_the_package():
    for path in Path(__file__).parent.glob("virtual*.py"):
        assert not any(name.startswith("parallel_cal") for name in imports(path)), path
