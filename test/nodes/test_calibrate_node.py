"""The robot calibrates itself through the real nodes: how it is stopped and continues.

What it finds is in test_demo.py.
"""

# ruff: noqa: E402 - what needs ROS is imported after the check that it is there

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy")
pytest.importorskip("parallel_cal_msgs")

from campaign_cells import calibrated
from parallel_cal_msgs.action import Calibrate
from parallel_cal_msgs.msg import CalibrationStatus
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from ros_helpers import LONG, NodeProcess
from std_srvs.srv import Trigger
from waits import children, wait_until

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.campaign.journal import FILE
from parallel_cal.cli.calibrating import calibrate
from parallel_cal.nodes.calibrate import Calibration
from parallel_cal.nodes.client import Client, NodeError, use_private_domain

ABORTED, CANCELED = 6, 5


class Desk:
    """A virtual cell and calibration_node, and a client of both."""

    def __init__(self, folder, **cell):
        self.folder, self.namespace = folder, use_private_domain()
        self.file = folder / "robot.yaml"
        # Half as many joint states as usual: each of them is sent, received and kept.
        usual = {"robot": "delta", "seed": 2, "rate": 4.0, "joint_rate": 50.0}
        self.given = usual | {"model_file": str(self.file)} | cell
        self.cell = self.robot()
        self.client = Client("tester", self.namespace, [])
        self.client.wait(self.file.exists, "the nominal model")
        self.node = self.start()
        self.status = self.client.subscribe_latest(
            CalibrationStatus, "calibration_node/session_status"
        )

    def robot(self):
        return NodeProcess("virtual_cell_node", self.folder, self.namespace, **self.given)

    def start(self):
        return NodeProcess(
            "calibration_node",
            self.folder,
            self.namespace,
            model_file=str(self.file),
            journal_folder=str(self.folder),
        )

    def close(self):
        self.client.close()
        assert self.node.end() == 0
        assert self.cell.end() == 0

    def change(self, **parameters):
        changes = [Parameter(k, value=v).to_parameter_msg() for k, v in parameters.items()]
        self.client.call(SetParameters, "virtual_cell_node/set_parameters", parameters=changes)

    def goal(self, **fields):
        self.client.wait(lambda: bool(self.status), "session_status")
        handle = self.client.send_goal(
            Calibrate, "calibration_node/calibrate", lambda feedback: None, **fields
        )
        assert handle.accepted
        return handle, handle.get_result_async()

    def wait_for(self, poses):
        self.client.wait(
            lambda: bool(self.status) and self.status[0].poses >= poses, f"{poses} poses", 120
        )

    def lines(self):
        """What the campaign has written so far."""
        (file,) = self.folder.glob(f"campaigns/*/{FILE}")
        return [json.loads(line) for line in file.read_text().splitlines()]

    def measured(self):
        return [line["target"] for line in self.lines() if "sample" in line]


@pytest.fixture
def desk(tmp_path):
    one = Desk(tmp_path)
    yield one
    one.close()


@pytest.mark.slow
def test_an_update_ends_as_soon_as_it_is_decided_that_nothing_has_changed(tmp_path):
    file = tmp_path / "robot.yaml"
    file.write_text(calibrated(2))
    heard = []
    with Calibration(file, simulated={"robot": "delta", "seed": 2, "rate": 4.0}) as calibration:
        result = calibration.run(heard.append, 10.0, update=True, certainty=0.9)
    assert (result.success, result.verdict, result.hash) == (True, "unchanged", "")
    document = json.loads(result.json)
    assert document["drift"]["certainty"] == 0.9
    assert document["poses"] < 24
    assert file.read_text() == calibrated(2)
    assert any(status.reason.startswith("pose 1 of 24") for status in heard)


@pytest.fixture
def command(tmp_path):
    """`calibrate` of a virtual robot as a terminal runs it, which has begun to move."""
    words = ["parallel_cal.cli", "calibrate", "robot.yaml", "--simulated", "delta:hidden"]
    process = subprocess.Popen(
        [sys.executable, "-m", *words],
        cwd=tmp_path,
        start_new_session=True,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    for line in process.stderr:
        if line.startswith("moving: pose 3"):
            break
    yield process
    if process.poll() is None:
        process.kill()
    process.wait()


@pytest.mark.wide
def test_ctrl_c_in_a_terminal_stops_the_robot_and_nothing_is_waited_for_in_vain(command):
    """It signals all of the terminal's processes; the nodes end when the robot has stopped."""
    os.killpg(command.pid, signal.SIGINT)
    out, err = command.communicate(timeout=LONG)
    assert command.returncode == 1
    assert out.startswith("ended: aborted on request; repeat the calibrate command to continue")
    assert "hidden effects: " not in out  # the campaign can be resumed
    assert "without success" not in err


@pytest.mark.wide
def test_nodes_do_not_outlive_a_command_that_is_killed(command):
    nodes = children(command.pid)
    assert len(nodes) == 3
    command.kill()
    wait_until(lambda: not any(Path(f"/proc/{p}").exists() for p in nodes), "the nodes' end")


def test_an_invalid_command_is_reported_before_anything_starts(tmp_path):
    told = {
        ("robot.yaml",): "no such file",
        ("robot.yaml", "--keep-out", "nonsense"): "six numbers 'x y z x y z' .m",
        ("robot.yaml", "--keep-out", "1 2 3 4 5"): "six numbers 'x y z x y z' .m",
    }
    for given, words in told.items():
        with pytest.raises(ParallelCalError, match=words):
            calibrate(tmp_path / given[0], keep_out=[*given[2:]])


def test_the_hidden_effects_of_a_simulated_robot_are_listed(tmp_path):
    cell = {"robot": "delta", "effects": "backlash, wind_up"}
    assert Calibration(tmp_path / "a.yaml", simulated=cell).hidden == ["backlash", "hysteresis"]
    assert Calibration(tmp_path / "a.yaml").hidden == []


@pytest.mark.wide
def test_pause_holds_the_robot_resume_goes_on_and_cancel_stops_it(desk):
    handle, result = desk.goal()
    desk.wait_for(2)
    desk.client.call(Trigger, "calibration_node/pause")
    desk.client.wait(lambda: desk.status[0].state == "paused", "the pause")
    held = desk.status[0].poses
    end = time.monotonic() + 1.0
    desk.client.wait(lambda: time.monotonic() > end, "news for a second")
    assert (desk.status[0].state, desk.status[0].poses) == ("paused", held)
    desk.client.call(Trigger, "calibration_node/resume")
    desk.wait_for(held + 1)
    desk.client.await_result(handle.cancel_goal_async(), "the cancelling")
    answer = desk.client.await_result(result, "the result")
    assert answer.status == CANCELED
    assert "aborted on request" in answer.result.message
    desk.client.wait(lambda: desk.status[0].state == "stopped", "the state after the goal")


@pytest.mark.slow
def test_a_robot_that_does_not_move_ends_the_goal_with_the_reason(desk):
    _, result = desk.goal()
    desk.wait_for(1)
    desk.change(drives_off=True)
    answer = desk.client.await_result(result, "the result")
    assert answer.status == ABORTED
    assert "does not move" in answer.result.message


@pytest.mark.wide
def test_a_killed_node_is_reported_by_its_client_and_continues_with_its_saved_samples(desk):
    def hear(status):
        if status.poses >= 4 and status.state == "moving" and desk.node._process.poll() is None:
            desk.node.end(signal.SIGKILL)

    ended = pytest.raises(NodeError, match="has ended; the samples are saved")
    with Calibration(desk.file, desk.namespace) as asked, ended:
        asked.run(hear, 5.0)
    before = desk.measured()
    assert len(before) >= 4
    desk.client.close()
    desk.client = Client("again", desk.namespace, [])
    desk.node = desk.start()
    desk.status = desk.client.subscribe_latest(CalibrationStatus, "calibration_node/session_status")
    assert not desk.client.call(Trigger, "calibration_node/pause").success  # it is up again
    handle, result = desk.goal()
    desk.wait_for(len(before) + 2)
    desk.client.await_result(handle.cancel_goal_async(), "the cancelling")
    desk.client.await_result(result, "the result")
    after = desk.measured()
    assert after[: len(before)] == before
    assert len(set(after)) == len(after)


@pytest.mark.wide
def test_nothing_is_calibrated_where_no_robot_is(desk):
    desk.client.wait(lambda: bool(desk.status), "session_status")
    desk.cell.end()
    time.sleep(2.0)  # longer than a robot may be silent
    _, result = desk.goal()
    answer = desk.client.await_result(result, "the result")
    assert "no joint states" in answer.result.message
