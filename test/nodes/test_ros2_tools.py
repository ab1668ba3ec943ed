"""The commands of docs/ros.md, by the real `ros2` where it is at hand.

It is no package of any registry: the wheels stand in the folder that ROS2_TOOLS names, or in
../shared/ros2_tools.
"""

# ruff: noqa: E402 - what needs ROS is imported after the check that it is there

import os
import shlex
import shutil
import signal
import subprocess
import sys
import venv
from pathlib import Path
from unittest import mock

import pytest

pytestmark = [pytest.mark.ros, pytest.mark.wide]
pytest.importorskip("rclpy")
pytest.importorskip("parallel_cal_msgs")

from parallel_cal.nodes.client import Client, use_private_domain
from parallel_cal.recordings.loading import load_dataset

ROOT = Path(__file__).parents[2]
TOOLS = Path(os.environ.get("ROS2_TOOLS") or ROOT.parent / "shared" / "ros2_tools")
LINES = (ROOT / "docs" / "ros.md").read_text().splitlines()
COMMANDS = [line.strip() for line in LINES if line.startswith("    ros2 ")]
# Commands that start programs or ask one of another package; the first of the page starts ours.
OTHERS = ("cell.launch.py", "rviz:=true", "ros2 run", "/robot_state_publisher")
STARTER = """#!{python}
import sys
from parallel_cal.nodes.start import {node}
sys.exit({node}())
"""
# What each command must print, besides ending well.
EXPECTED = {
    "--show-args": "'measured_pose':",
    "node list": "/calibration_node",
    "param describe": "Min value: 0.01",
    "param set": "Set parameter successful",
    "param dump": "",
    "param load": "Trying to set a read-only parameter",
    "robot_description": "<robot",
    "model_status": "ok: true",
    "compute_fk": "status=0",
    "load_samples": "samples=94",
    "send_goal": "Goal finished with status: SUCCEEDED",
    "undo": "success=True",
    "change_state": "success=True",
    "get_state": "label='inactive'",
}


@pytest.fixture(scope="module")
def prefix(tmp_path_factory):
    """An environment with the tools, and the package installed where they look for it."""
    if not (TOOLS / "install").exists():
        pytest.skip(f"the ros2 tools are not in {TOOLS}; set ROS2_TOOLS")
    prefix = tmp_path_factory.mktemp("ros2") / "venv"
    venv.create(prefix, with_pip=True)
    (site,) = prefix.glob("lib/python3*/site-packages")
    (site / "with_ours.pth").write_text("\n".join(p for p in sys.path if "site-packages" in p))
    command = ["bash", str(TOOLS / "install"), str(prefix)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment(prefix))
    if done.returncode:
        pytest.skip(f"the ros2 tools cannot be installed: {done.stderr.splitlines()[-1:]}")
    share = prefix / "share" / "parallel_cal"
    shutil.copytree(ROOT / "launch", share / "launch")
    shutil.copy(ROOT / "package.xml", share)
    index = prefix / "share" / "ament_index" / "resource_index" / "packages"
    index.mkdir(parents=True, exist_ok=True)
    (index / "parallel_cal").touch()
    folder = prefix / "lib" / "parallel_cal"
    folder.mkdir(exist_ok=True)
    for node in ("kinematics_node", "calibration_node"):
        (folder / node).write_text(STARTER.format(python=prefix / "bin" / "python", node=node))
        (folder / node).chmod(0o755)
    return prefix


def environment(prefix):
    path = f"{prefix / 'bin'}{os.pathsep}{os.environ['PATH']}"
    prefixes = os.pathsep.join(filter(None, [str(prefix), os.environ.get("AMENT_PREFIX_PATH")]))
    ours = {"PATH": path, "PYTHONPATH": str(ROOT), "AMENT_PREFIX_PATH": prefixes}
    return os.environ | ours | {"ROS_HOME": str(prefix), "PYTHONUNBUFFERED": "1"}


def said(command, prefix, folder):
    """What a command of the page prints; no daemon is left behind by those that would start one."""
    words = shlex.split(command)
    if words[1] in ("node", "param", "topic"):
        words[3:3] = ["--no-daemon", "--spin-time", "5"]
    command = " ".join(w if w == ">" else shlex.quote(w) for w in words)
    done = subprocess.run(
        command,
        shell=True,
        capture_output=True,
        text=True,
        timeout=90,
        cwd=folder,
        env=environment(prefix),
    )
    assert done.returncode == 0, f"{command}: {done.stdout}{done.stderr}"
    return done.stdout + done.stderr


@mock.patch.dict(os.environ)
def test_the_commands_of_the_page_do_what_it_says(prefix, tmp_path):
    use_private_domain()
    shutil.copy(ROOT / "config" / "delta_mockup_nominal.yaml", tmp_path / "robot.yaml")
    load_dataset(ROOT / "bags" / "delta_clean").to_json(tmp_path / "samples.json")
    start, *others = [line for line in COMMANDS if not any(part in line for part in OTHERS)]
    with (tmp_path / "log").open("w") as log:
        launch = subprocess.Popen(
            shlex.split(start), stdout=log, stderr=log, cwd=tmp_path, env=environment(prefix)
        )
    client = Client("watcher", "/", [])
    try:
        client.wait(
            lambda: {"kinematics_node", "calibration_node"} <= set(client._node.get_node_names()),
            "both nodes",
            60,
        )
        for command in others:
            expected = next(text for part, text in EXPECTED.items() if part in command)
            assert expected in said(command, prefix, tmp_path), command
    finally:
        client.close()
        launch.send_signal(signal.SIGINT)
        launch.wait(30)
    told = (tmp_path / "log").read_text()
    assert launch.returncode == 0, told
    assert told.count("process has finished cleanly") == 2, told
    assert "Traceback" not in told


def test_a_node_of_the_package_is_run_by_name(prefix, tmp_path):
    told = said("ros2 run parallel_cal kinematics_node --help", prefix, tmp_path)
    assert "singularity_margin" in told
