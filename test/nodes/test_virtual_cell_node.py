"""The virtual cell as a process: commands in, messages out, faults by parameters."""

# ruff: noqa: E402 - what needs ROS is imported after the check that it is there

import os
from contextlib import ExitStack
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy", reason="ROS 2 (rclpy) is not installed")
pytest.importorskip("parallel_cal_msgs", reason="the messages (msg_defs) are not installed")

from builtin_interfaces.msg import Duration
from geometry_msgs.msg import InertiaStamped, PoseWithCovarianceStamped
from parallel_cal_msgs.msg import ModelStatus
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from ros_helpers import NodeProcess
from sensor_msgs.msg import JointState
from test_launch_file import launched, started
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from parallel_cal.model.file.modelfile import read_model
from parallel_cal.nodes import virtual_cell_node
from parallel_cal.nodes.client import Client, use_private_domain
from parallel_cal.nodes.conversions import stop_message
from parallel_cal.virtual.machines import MACHINES

REPOSITORY = Path(__file__).parents[2]
HOME = np.array(MACHINES["delta"].make_nominal().home_joints)
SEED, FAST = 3, 5.0
NODE = "virtual_cell_node"


class Cell:
    """A running cell, its messages, and a publisher of trajectories."""

    def __init__(self, folder, namespace, **parameters):
        self.process = NodeProcess(NODE, folder, namespace, seed=SEED, **parameters)
        self.client = Client("tester", namespace, [self.process])
        self.node = self.client._node
        self.states, self.poses, self.loads = [], [], []
        for heard, type, topic in (
            (self.states, JointState, "joint_states"),
            (self.poses, PoseWithCovarianceStamped, "measured_pose"),
            (self.loads, InertiaStamped, "payload"),
        ):
            self.node.create_subscription(type, topic, heard.append, 5000)
        self.commands = self.node.create_publisher(JointTrajectory, "joint_trajectory", 10)
        self.client.wait(lambda: self.states and self.poses and self.loads, "its first messages")
        self.client.wait(lambda: self.commands.get_subscription_count(), "its ear")

    def send(self, *points, names=("joint1", "joint2", "joint3")):
        """Points are (s, joints)."""
        made = [
            JointTrajectoryPoint(
                positions=list(q),
                velocities=[0.0] * len(q),
                time_from_start=Duration(sec=int(s), nanosec=round(1e9 * (s % 1))),
            )
            for s, q in points
        ]
        self.commands.publish(JointTrajectory(joint_names=list(names), points=made))

    def joints(self):
        return np.array(self.states[-1].position)

    def arrive(self, there):
        near = 6 * MACHINES["delta"].noise.joint
        self.client.wait(lambda: np.abs(self.joints() - there).max() < near, "the arrival")

    def passed(self, seconds):
        """Wait until so much time has passed in the cell."""
        end = stamp(self.states[-1]) + seconds
        self.client.wait(lambda: stamp(self.states[-1]) > end, "the cell's time")

    def change(self, **parameters):
        """Whether the node took them, and what it said."""
        values = [
            Parameter(name, value=value).to_parameter_msg() for name, value in parameters.items()
        ]
        answer = self.client.call(SetParameters, f"{NODE}/set_parameters", parameters=values)
        return [(r.successful, r.reason) for r in answer.results]

    def close(self):
        self.client.close()
        return self.process.end()


def stamp(message):
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


def position(message):
    p = message.pose.pose.position
    return np.array([p.x, p.y, p.z])


@pytest.fixture(scope="module")
def fast(tmp_path_factory):
    with mock.patch.dict(os.environ):
        folder = tmp_path_factory.mktemp("cell")
        cell = Cell(folder, use_private_domain(), rate=FAST, model_file=str(folder / "robot.yaml"))
        cell.model_file = folder / "robot.yaml"
        yield cell
        assert cell.close() == 0


def test_a_trajectory_is_driven_and_the_tracker_sees_the_robot_where_its_rods_hold_it(fast):
    there = HOME + [0.1, -0.05, 0.02]
    fast.send((1.0, there[[2, 0, 1]]), names=("joint3", "joint1", "joint2"))
    fast.arrive(there)
    fast.passed(1.0)
    begin = len(fast.poses)
    fast.client.wait(lambda: len(fast.poses) > begin + 20, "poses")
    true, _ = MACHINES["delta"].make_built(SEED).forward(there)
    seen = np.mean([position(p) for p in fast.poses[begin:]], axis=0)
    np.testing.assert_allclose(seen, true, atol=5 * 10e-6)
    assert np.diff([stamp(s) for s in fast.states[-100:]]) == pytest.approx(0.01, abs=1e-6)


def test_what_joint_trajectory_controller_would_refuse_is_refused(fast):
    fast.send((0.5, HOME))
    fast.arrive(HOME)
    for points, names in (
        ([], ("joint1", "joint2", "joint3")),
        ([(1.0, HOME[:2])], ("joint1", "joint2")),
        ([(1.0, HOME + 1), (0.5, HOME + 1)], ("joint1", "joint2", "joint3")),
        ([(1.0, HOME[:2] + 1)], ("joint1", "joint2", "joint3")),
    ):
        fast.send(*points, names=names)
    fast.client.wait(lambda: fast.process.said.count("trajectory refused") == 4, "four refusals")
    fast.passed(1.0)
    fast.arrive(HOME)


def test_the_nominal_model_is_written_with_the_instruments_noise_and_the_drives_limits(fast):
    model = read_model(fast.model_file)
    assert model.mechanism.name == "delta54"
    assert model.noise.position == 10e-6
    assert model.mechanism.joint_rates == ((2.0, 40.0),) * 3
    assert model.table.mapping(model.values)["chain1.La_x"] == 0.119963


def test_faults_and_loads_are_parameters(fast):
    assert fast.change(payload=1.5, lost_target=True) == [(True, "")] * 2
    fast.client.wait(lambda: fast.loads[-1].inertia.m == 1.5, "the payload")
    fast.client.wait(lambda: stamp(fast.states[-1]) > stamp(fast.poses[-1]) + 3, "poses to end")
    fast.change(payload=0.0, lost_target=False)
    ((took, why),) = fast.change(obstacle="1 2 3")
    assert (took, why) == (False, "obstacle '1 2 3': expected x y z x y z in m")
    ((took, why),) = fast.change(payload=-1.0)
    assert not took


def test_a_stop_ends_the_motion_within_a_tenth_of_a_second(tmp_path):
    with mock.patch.dict(os.environ):
        cell = Cell(tmp_path, f"{use_private_domain()}/slow", joint_rate=200.0)
        try:
            cell.send((2.0, HOME + 0.8))
            cell.client.wait(lambda: cell.joints()[0] > HOME[0] + 0.4, "half of the way")
            told = cell.states[-1]
            stop = stop_message(told.name, cell.joints(), np.array(told.velocity))
            cell.commands.publish(stop)
            cell.passed(1.0)
        finally:
            ended = cell.close()
        times = np.array([stamp(s) for s in cell.states])
        speeds = np.array([np.abs(s.velocity).max() for s in cell.states])
        full = times[speeds > 0.95 * speeds.max()].max()
        assert times[speeds > 0.01 * speeds.max()].max() - full < 0.1
        assert HOME[0] + 0.4 < cell.joints()[0] < HOME[0] + 0.7
        assert ended == 0


def test_a_kind_that_no_robot_has_is_reported_in_one_line(tmp_path):
    with mock.patch.dict(os.environ):
        wrong = {"robot": "argos", "effects": "soft_rods"}
        process = NodeProcess(NODE, tmp_path, f"{use_private_domain()}/none", **wrong)
        assert process.ended() == 1
        assert process.said.startswith("error: effect soft_rods: a argos supports eccentricity")


def test_the_page_about_the_nodes_names_every_parameter():
    page = (REPOSITORY / "docs" / "ros.md").read_text()
    assert [name for name in virtual_cell_node.PARAMETERS if f"`{name}`" not in page] == []


@pytest.mark.wide
def test_the_launch_file_starts_the_cell_and_both_nodes_on_the_model_that_it_writes(tmp_path):
    file = tmp_path / "robot.yaml"
    with mock.patch.dict(os.environ):
        namespace = f"{use_private_domain()}/launched"
        given = {"model_file": str(file), "namespace": namespace}
        cell, wait = launched("cell.launch.py", **given)
        processes = [*started([cell], tmp_path)]
        client = Client("tester", namespace, processes)
        ended = []
        with ExitStack() as at_the_end:  # each ends, also where another does not end well
            at_the_end.callback(lambda: ended.append(processes[0].end()))
            at_the_end.callback(client.close)
            client.wait(file.exists, "the model file")
            [nodes] = wait.actions[0].function(None)
            of_nodes = launched("calibration.launch.py", **dict(nodes.launch_arguments))
            for process in started(of_nodes, tmp_path):
                processes.append(process)
                at_the_end.callback(lambda process=process: ended.append(process.end()))
            status = client.subscribe_latest(ModelStatus, "kinematics_node/model_status")
            client.wait(lambda: status and status[-1].mechanism == "delta54", "the model")
            client.wait(lambda: client.count_subscribers(["joint_states"]) == 2, "both listeners")
        assert ended == [0, 0, 0]
