"""Motions by the controller's action FollowJointTrajectory: targets, paths, campaigns."""

# ruff: noqa: E402 - what needs ROS is imported after the check that it is there

import math
import os
import subprocess
import sys
import time
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest

pytestmark = pytest.mark.ros
rclpy = pytest.importorskip("rclpy")
pytest.importorskip("parallel_cal_msgs")

NODES = ("kinematics_node", "calibration_node")


@pytest.mark.parametrize("node", NODES)
def test_without_the_package_of_the_action_the_parameter_is_refused(tmp_path, node):
    code = (
        "import sys; sys.modules['control_msgs'] = None\n"
        f"from parallel_cal.nodes.{node} import main; sys.exit(main())"
    )
    command = [sys.executable, "-c", code, "--ros-args", "-p", "trajectory_action:=/arm/follow"]
    folder = ["-p", f"journal_folder:={tmp_path}"]
    done = subprocess.run([*command, *folder], capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    line = done.stderr.strip().split("\n")[-1]
    assert line.startswith("error: parameter trajectory_action /arm/follow: the package")
    assert "ros-jazzy-control-msgs" in line


pytest.importorskip("control_msgs")

from action_msgs.srv import CancelGoal
from action_robot import HOME, NAME, ActionRobot, Result
from campaign_cells import model_of
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion
from nav_msgs.msg import Path
from parallel_cal_msgs.action import Calibrate
from parallel_cal_msgs.msg import CalibrationStatus, CommandStatus, MotionStatus
from rclpy.task import Future
from ros_helpers import NodeProcess
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.file.modelfile import write_model
from parallel_cal.nodes.client import Client, use_private_domain
from parallel_cal.nodes.trajectory_action import TrajectoryAction

PATIENCE_S = 150.0  # on a busy computer a node takes a minute to start
MADE = MotionStatus.SENT, MotionStatus.MOVING
ABORTED, CANCELED = 6, 5
ASIDE = (0.03, 0.02, 0.21)


def test_a_refusal_is_noticed_also_if_the_first_answer_is_lost():
    """rclpy ignores an answer that comes before the thread that asked has noted the request."""
    later, sent = [], []
    node = SimpleNamespace(
        executor=SimpleNamespace(create_task=lambda *call: later.append(call)),
        get_logger=lambda: SimpleNamespace(error=print),
    )
    action = object.__new__(TrajectoryAction)
    action._node, action._name, action._status, action._goals = node, "follow", None, []
    action._client = SimpleNamespace(
        server_is_ready=lambda: True,
        send_goal_async=lambda goal, feedback: sent.append(goal.trajectory) or Future(),
    )
    moving, halt = JointTrajectory(), JointTrajectory(joint_names=["halt"])
    action.send(moving)
    answers = [Future(), Future()]
    action._goals[-1].handle = SimpleNamespace(cancel_goal_async=iter(answers).__next__)
    action.stop(lambda: halt)
    (_, *_), (cancel, *goal) = later
    later.clear()
    cancel(*goal)
    answers[1].set_result(CancelGoal.Response(return_code=CancelGoal.Response.ERROR_REJECTED))
    ((begin, *goal),) = later
    begin(*goal)
    assert sent == [halt]


class Desk:
    """A Delta whose controller has the action, both nodes, and a client of all."""

    def __init__(self, folder):
        namespace, file = use_private_domain(), folder / "robot.yaml"
        model = model_of("delta")
        write_model(model, file)
        self.kinematics = Kinematics(model)
        self.robot = ActionRobot(namespace)
        given = {"model_file": str(file), "trajectory_action": f"{namespace}/{NAME}"}
        own = ({"time_from_start": 2.0}, {"journal_folder": str(folder)})
        self.processes = [
            NodeProcess(node, folder, namespace, **given, **parameters)
            for node, parameters in zip(NODES, own, strict=True)
        ]
        self.client = Client("tester", namespace, [])
        self.states = self.hear(JointState, "joint_states")
        self.motions = self.hear(MotionStatus, "kinematics_node/motion_status")
        self.commands = self.hear(CommandStatus, "kinematics_node/command_status")
        self.status = self.client.subscribe_latest(
            CalibrationStatus, "calibration_node/session_status"
        )
        node = self.client._node
        self.targets = node.create_publisher(PoseStamped, "target_pose", 10)
        self.paths = node.create_publisher(Path, "target_path", 10)
        for topic in ("target_pose", "target_path"):
            self.wait(lambda t=topic: self.client.count_subscribers([t]), topic)
        self.wait(lambda: self.states and self.motions == [], "the robot")

    def wait(self, ready, what):
        self.client.wait(ready, what, PATIENCE_S)

    def hear(self, type, topic):
        heard = []
        self.client._node.create_subscription(type, topic, heard.append, 1000)
        return heard

    def close(self):
        self.robot.close()
        self.client.close()
        assert [process.end() for process in self.processes] == [0, 0]

    def stop(self):
        return self.client.call(Trigger, "kinematics_node/stop")

    def go(self, place):
        """Send a target; return once the node has answered it."""
        known = len(self.commands)
        self.targets.publish(posed(place))
        self.wait(lambda: len(self.commands) > known, "the answer")
        return self.commands[-1]

    def until(self, *wanted):
        """Wait until the newest motion is in one of some states; return what was said of it."""
        self.wait(lambda: self.motions and self.motions[-1].state in wanted, str(wanted))
        return self.motions[-1]

    def arrive(self, place):
        assert self.go(place).status != CommandStatus.REFUSED, self.commands[-1].message
        self.wait(lambda: bool(self.motions), "the motion")
        return self.until(MotionStatus.ARRIVED)

    def here(self):
        """Where the robot rests, by the model that the nodes use."""

        def positions():
            return np.array([state.position for state in self.states[-20:]])

        self.states.clear()
        self.wait(
            lambda: len(self.states) > 20 and np.ptp(positions(), axis=0).max() < 1e-4, "rest"
        )
        return self.kinematics.direct(positions().mean(axis=0)).position


def posed(place):
    x, y, z = map(float, place)
    pose = Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(w=1.0))
    return PoseStamped(pose=pose)


@pytest.fixture(scope="module")
def running(tmp_path_factory):
    with mock.patch.dict(os.environ):
        one = Desk(tmp_path_factory.mktemp("desk"))
        try:
            yield one
        finally:
            one.close()


@pytest.fixture
def desk(running):
    """The desk with the robot at home and nothing said of its motions."""
    running.robot.repair()
    running.robot.rate = 2.0
    running.motions.clear()
    # Refused until the node knows from a joint state where the robot is.
    running.wait(lambda: running.go(HOME).status != CommandStatus.REFUSED, "the node")
    running.wait(lambda: bool(running.motions), "its motion")
    running.until(MotionStatus.ARRIVED)
    for heard in (running.motions, running.commands, running.robot.goals):
        heard.clear()
    return running


@pytest.mark.wide
def test_a_target_is_reached_and_all_of_its_motion_is_told(desk):
    end = desk.arrive(ASIDE)
    np.testing.assert_allclose(desk.here(), ASIDE, atol=1e-4)
    states = [motion.state for motion in desk.motions]
    assert states == sorted(states)
    assert {motion.source for motion in desk.motions} == {"target_pose"}
    told = [m for m in desk.motions if m.state == MotionStatus.MOVING and m.errors]
    assert len(told) > 5
    assert list(end.joint_names) == ["joint1", "joint2", "joint3"]
    assert max(abs(e) for motion in told for e in motion.errors) < 1e-9
    assert end.time_from_start == pytest.approx(2.0)
    assert (end.error_code, end.message) == (0, "")
    assert len(desk.robot.goals) == 1


@pytest.mark.wide
def test_a_path_is_one_goal(desk):
    desk.paths.publish(Path(poses=[posed((0.02, 0.0, 0.2)), posed(ASIDE)]))
    end = desk.until(MotionStatus.ARRIVED, MotionStatus.FAILED)
    assert end.state == MotionStatus.ARRIVED, end.message
    assert end.source == "target_path"
    assert len(desk.robot.goals) == 1
    assert len(desk.robot.goals[0].points) > 10
    np.testing.assert_allclose(desk.here(), ASIDE, atol=1e-4)


@pytest.mark.wide
def test_stop_cancels_the_motion_and_the_robot_rests_on_its_path(desk):
    desk.robot.rate = 0.1  # time enough for a busy computer
    desk.go(ASIDE)
    desk.wait(lambda: any(motion.errors for motion in desk.motions), "the motion")
    assert desk.stop().success
    assert desk.until(MotionStatus.STOPPED, MotionStatus.ARRIVED).state == MotionStatus.STOPPED
    gone = np.linalg.norm(desk.here() - HOME)
    assert 0 < gone < 0.9 * np.linalg.norm(np.subtract(ASIDE, HOME))


@pytest.mark.wide
def test_a_joint_that_leaves_its_path_ends_the_motion_and_is_named(desk):
    desk.robot.stuck = 2
    desk.go((0.05, 0.05, 0.2))
    end = desk.until(MotionStatus.FAILED, MotionStatus.ARRIVED)
    assert end.state == MotionStatus.FAILED
    assert end.error_code == Result.PATH_TOLERANCE_VIOLATED
    assert "path tolerance violated (joint2 is off by" in end.message
    assert "joint2 was furthest off its path" in end.message
    assert max(end.errors, key=abs) == end.errors[1]


@pytest.mark.wide
def test_a_rejected_motion_is_told_and_the_robot_stays(desk):
    desk.robot.accepts = False
    desk.go(ASIDE)
    end = desk.until(MotionStatus.FAILED, MotionStatus.ARRIVED)
    assert (end.state, end.error_code) == (MotionStatus.FAILED, Result.INVALID_GOAL)
    assert "rejected" in end.message
    np.testing.assert_allclose(desk.here(), HOME, atol=1e-4)


@pytest.mark.wide
def test_a_joint_that_stays_beside_its_goal_ends_the_motion(desk):
    desk.robot.lag = 0.015  # rad: more than the goal's tolerance, less than the path's
    desk.go(ASIDE)
    end = desk.until(MotionStatus.FAILED, MotionStatus.ARRIVED)
    assert (end.state, end.error_code) == (MotionStatus.FAILED, Result.GOAL_TOLERANCE_VIOLATED)
    assert "goal tolerance violated (joint" in end.message


@pytest.mark.wide
def test_a_goal_that_is_never_answered_is_given_up_and_a_late_answer_does_not_move_the_robot(desk):
    desk.robot.answers.clear()
    desk.go(ASIDE)
    end = desk.until(MotionStatus.FAILED, MotionStatus.ARRIVED)
    assert end.state == MotionStatus.FAILED
    assert "no answer to the goal for 10 s; the robot may still move" in end.message
    assert not desk.robot.goals
    desk.robot.rate = 0.01  # the cancel comes before the robot has moved far
    desk.robot.answers.set()
    desk.wait(lambda: bool(desk.robot.goals), "the late answer")
    time.sleep(1.0)
    desk.robot.rate = 2.0
    assert np.linalg.norm(desk.here() - HOME) < 0.1 * np.linalg.norm(np.subtract(ASIDE, HOME))
    assert desk.arrive(ASIDE).state == MotionStatus.ARRIVED


@pytest.mark.wide
def test_a_late_answer_within_the_time_is_no_fault(desk):
    desk.robot.answers.clear()
    desk.go(ASIDE)
    time.sleep(2.0)
    desk.robot.answers.set()
    assert desk.until(MotionStatus.FAILED, MotionStatus.ARRIVED).state == MotionStatus.ARRIVED


@pytest.mark.wide
def test_a_controller_that_falls_silent_in_the_middle_is_given_up_and_cancelled(desk):
    desk.robot.rate = 0.05
    desk.go(ASIDE)
    desk.wait(lambda: any(motion.errors for motion in desk.motions), "the motion")
    desk.robot.reports.clear()
    end = desk.until(MotionStatus.FAILED, MotionStatus.ARRIVED)
    assert end.state == MotionStatus.FAILED
    assert "no feedback for 10 s" in end.message
    desk.robot.repair()
    gone = np.linalg.norm(desk.here() - HOME)
    assert 0 < gone < 0.9 * np.linalg.norm(np.subtract(ASIDE, HOME))


@pytest.mark.wide
def test_a_controller_that_ends_in_the_middle_fails_the_motion(desk):
    desk.robot.rate = 0.1
    desk.go(ASIDE)
    desk.wait(lambda: any(motion.errors for motion in desk.motions), "the motion")
    desk.robot.server.destroy()
    end = desk.until(MotionStatus.FAILED, MotionStatus.ARRIVED)
    desk.robot.serve()
    assert end.state == MotionStatus.FAILED
    assert "no node provides the action any more" in end.message


@pytest.mark.wide
def test_a_refused_cancel_is_followed_by_a_trajectory_that_stops_the_robot(desk):
    desk.robot.rate, desk.robot.obeys = 0.1, False
    desk.go(ASIDE)
    desk.wait(lambda: any(motion.errors for motion in desk.motions), "the motion")
    assert desk.stop().success
    desk.wait(lambda: desk.motions[-1].source == "stop", "the trajectory that stops")
    desk.robot.rate = 2.0
    desk.until(MotionStatus.ARRIVED, MotionStatus.FAILED)
    states = [motion.state for motion in desk.motions if motion.state not in MADE]
    assert states == [MotionStatus.REPLACED, MotionStatus.ARRIVED]
    told = next(motion for motion in desk.motions if motion.state == MotionStatus.REPLACED)
    assert told.message == "the controller refused to cancel the motion"
    gone = np.linalg.norm(desk.here() - HOME)
    assert 0 < gone < 0.9 * np.linalg.norm(np.subtract(ASIDE, HOME))


@pytest.mark.wide
def test_a_later_target_replaces_the_motion(desk):
    desk.go(ASIDE)
    desk.wait(lambda: any(motion.errors for motion in desk.motions), "the motion")
    desk.go((-0.03, 0.0, 0.2))
    desk.until(MotionStatus.ARRIVED)
    ends = [motion.state for motion in desk.motions if motion.state not in MADE]
    assert ends == [MotionStatus.REPLACED, MotionStatus.ARRIVED]
    np.testing.assert_allclose(desk.here(), (-0.03, 0.0, 0.2), atol=1e-4)


def begin_campaign(desk, **goal):
    desk.wait(lambda: bool(desk.status), "session_status")
    handle = desk.client.send_goal(
        Calibrate, "calibration_node/calibrate", lambda feedback: None, enough=1e-9, **goal
    )
    assert handle.accepted
    return handle, handle.get_result_async()


@pytest.mark.wide
def test_a_campaign_moves_by_the_action_alone_and_its_cancel_stops_the_robot(desk):
    handle, result = begin_campaign(desk)
    desk.wait(
        lambda: (desk.status[0].poses >= 3 and desk.status[0].state == "moving") or result.done(),
        "three poses",
    )
    assert not result.done(), result.result().result.message
    known = len(desk.robot.goals)
    assert desk.client.count_publishers("joint_trajectory") == 0
    handle.cancel_goal_async()
    answer = desk.client.await_result(result, "the result", PATIENCE_S)
    assert answer.status == CANCELED
    here = desk.here()
    time.sleep(1.0)
    np.testing.assert_allclose(desk.here(), here, atol=1e-3)
    assert known >= 3
    assert len(desk.robot.goals) - known <= 1


@pytest.mark.wide
def test_a_campaign_sends_a_lost_goal_again(desk):
    handle, result = begin_campaign(desk, afresh=True)
    desk.wait(lambda: desk.status[0].poses >= 1 or result.done(), "a pose")
    desk.robot.lose(1)
    desk.wait(lambda: not desk.robot.losses or result.done(), "the loss")
    known = desk.status[0].poses
    desk.wait(lambda: desk.status[0].poses > known + 1 or result.done(), "the next poses")
    assert not result.done(), result.result().result.message
    handle.cancel_goal_async()
    assert desk.client.await_result(result, "the result", PATIENCE_S).status == CANCELED


@pytest.mark.wide
def test_a_campaign_ends_with_the_controllers_reason(desk):
    _, result = begin_campaign(desk, afresh=True)
    desk.wait(lambda: desk.status[0].poses >= 1 or result.done(), "a pose")
    desk.robot.stuck = 3
    answer = desk.client.await_result(result, "the result", PATIENCE_S)
    assert answer.status == ABORTED
    assert "path tolerance violated (joint3 is off by" in answer.result.message


@pytest.mark.wide
def test_without_the_controller_a_target_is_refused(desk):
    desk.robot.server.destroy()
    refused = "no node provides the action"
    desk.wait(lambda: refused in desk.go(ASIDE).message, "the refusal")
    assert desk.commands[-1].status == CommandStatus.REFUSED
    assert math.isnan(desk.commands[-1].time_from_start)
