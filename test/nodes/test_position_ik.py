"""kinematics_node answers GetPositionIK, the service type of MoveIt, from the model in use."""

# ruff: noqa: E402 - what needs ROS is imported after the check that it is there

import os
import subprocess
import sys
from unittest import mock

import arms
import numpy as np
import pytest

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy", reason="ROS 2 (rclpy) is not installed")
pytest.importorskip("parallel_cal_msgs", reason="the messages (msg_defs) are not installed")

from parallel_cal_msgs.msg import ModelStatus
from ros_helpers import NodeProcess

from parallel_cal import new_model
from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.base.worker import TimeBudgetExceeded
from parallel_cal.kinematics.kinematics import Kinematics, Status
from parallel_cal.kinematics.solvers import newton
from parallel_cal.model.file.modelfile import model_hash, model_text, write_model
from parallel_cal.nodes import computing, position_ik
from parallel_cal.nodes.client import Client, use_private_domain
from parallel_cal.nodes.conversions import pose_message
from parallel_cal.nodes.model_server import ServedModel

NODE = "kinematics_node"


class Here:
    """A worker that works in this process; `error` is raised instead."""

    def __init__(self, error=None):
        self.error, self.seconds = error, None

    def work(self, function, *given, seconds):
        if function is computing.warm:
            return None
        self.seconds = seconds
        if self.error:
            raise self.error
        return function(*given)


@pytest.fixture(scope="module")
def service():
    type = position_ik.find_service_type()
    return type or pytest.skip("moveit_msgs is not installed")


@pytest.fixture(scope="module")
def delta(tmp_path_factory):
    return served(new_model("delta24"), tmp_path_factory.mktemp("delta"))


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    return served(arms.nominal("ur5"), tmp_path_factory.mktemp("arm"))


def served(model, folder):
    write_model(model, folder / "robot.yaml")
    text = model_text(folder / "robot.yaml")
    return ServedModel(model, Kinematics(model), model_hash(text), "robot.yaml", text)


def pose_of(solution):
    return pose_message(solution.position, solution.quaternion)


def request_of(service, pose, seed=None, names=(), frame="", **fields):
    request = service.Request()
    asked = request.ik_request
    asked.pose_stamped.pose, asked.pose_stamped.header.frame_id = pose, frame
    if seed is not None:
        state = asked.robot_state.joint_state
        state.name, state.position = list(names), [float(value) for value in seed]
    for name, value in fields.items():
        setattr(asked, name, value)
    return request


def ask(service, robot, *given, worker=None, **fields):
    request = request_of(service, *given, **fields)
    worker = worker or Here()
    return position_ik.answer(worker, 5.0, robot, None, "none yet", request, service.Response())


def test_a_pose_is_answered_with_the_joints_by_name(service, delta):
    q = np.array(delta.model.mechanism.home.joints) + [0.05, 0.1, -0.1]
    at = delta.kinematics.direct(q)
    answer = ask(service, delta, pose_of(at), frame="base", ik_link_name="platform")
    assert answer.error_code.val == answer.error_code.SUCCESS
    assert answer.error_code.message == ""
    state = answer.solution.joint_state
    assert list(state.name) == list(delta.model.joints)
    np.testing.assert_allclose(state.position, q, atol=1e-9)
    checked = ask(service, delta, pose_of(at), avoid_collisions=True)
    assert checked.error_code.val == checked.error_code.SUCCESS
    assert checked.error_code.message == "collisions were not checked"


def test_the_seed_selects_the_branch(service, arm):
    at = arm.kinematics.direct(np.array(arm.model.mechanism.home.joints) + 0.1)
    every = newton.inverse_all(arm.model, at.position, at.rotation, None, starts=0)
    branches = every.joints[every.status == Status.CONVERGED]
    assert len(branches) > 2
    for branch in branches:
        seed = [7.0, *branch + 0.01][::-1]
        names = ["gripper", *arm.model.joints][::-1]
        answer = ask(service, arm, pose_of(at), seed=seed, names=names)
        assert answer.error_code.val == answer.error_code.SUCCESS, answer.error_code.message
        np.testing.assert_allclose(answer.solution.joint_state.position, branch, atol=1e-6)


def test_what_cannot_be_answered_gets_the_code_of_moveit_and_a_reason(service, delta):
    home = delta.model.mechanism.home
    at = delta.kinematics.direct(np.array(home.joints))
    pose, names = pose_of(at), delta.model.joints

    def code(*given, **fields):
        error = ask(service, delta, *given, **fields).error_code
        return next(k for k in dir(error) if k.isupper() and getattr(error, k) == error.val), error

    def moved(by, turn=(0.0, 0.0, 0.0)):
        turned = rotation_matrix(turn) @ at.rotation
        found = at.__class__(at.joints, at.position + by, turned, at.residual, at.status)
        return pose_of(found)

    for name, words, answer in (
        ("NO_IK_SOLUTION", "out of reach", code(moved([0, 0, 9.0]))),
        ("NO_IK_SOLUTION", "does not control", code(moved([0, 0, 0], [0, 0, 0.2]))),
        ("FRAME_TRANSFORM_FAILURE", "'world', expected 'base'", code(pose, frame="world")),
        ("INVALID_LINK_NAME", "expected platform", code(pose, ik_link_name="tool7")),
        ("INVALID_ROBOT_STATE", "joint2", code(pose, seed=[0.5], names=names[:1])),
        ("INVALID_ROBOT_STATE", "finite", code(pose, seed=[np.nan] * 3, names=names)),
        ("INVALID_ROBOT_STATE", "index", code(pose, seed=[0.5], names=names)),
        ("FAILURE", "not finite", code(moved([np.nan, 0, 0]))),
    ):
        assert answer[0] == name, answer
        assert words in answer[1].message, answer
        assert answer[1].source == "parallel_cal"
    constrained = request_of(service, pose)
    constrained.ik_request.constraints.joint_constraints = [
        pytest.importorskip("moveit_msgs.msg").JointConstraint(joint_name=names[0])
    ]
    answer = position_ik.answer(Here(), 5.0, delta, None, "", constrained, service.Response())
    error = answer.error_code
    assert error.val == error.INVALID_GOAL_CONSTRAINTS
    error = ask(service, None, pose).error_code
    assert error.val == error.FAILURE
    assert error.message == "no model in use: none yet"


def test_a_solution_outside_the_limits_is_none(service, delta):
    beyond = np.array(delta.model.mechanism.joint_limits)[:, 0] - 0.01
    error = ask(service, delta, pose_of(delta.kinematics.direct(beyond))).error_code
    assert error.val == error.NO_IK_SOLUTION
    assert "limits" in error.message


@pytest.mark.parametrize(("given", "allowed"), [(0.0, 5.0), (0.005, 0.1), (2.0, 2.0), (60.0, 5.0)])
def test_the_timeout_is_kept(service, delta, given, allowed):
    request = service.Request().ik_request.timeout
    request.sec, request.nanosec = divmod(round(given * 1e9), 10**9)
    pose = pose_of(delta.kinematics.direct(np.array(delta.model.mechanism.home.joints)))
    worker = Here(TimeBudgetExceeded("over budget"))
    error = ask(service, delta, pose, worker=worker, timeout=request).error_code
    assert worker.seconds == pytest.approx(allowed)
    assert error.val == error.TIMED_OUT
    assert error.message == f"no solution within {allowed:g} s"


def test_without_moveit_msgs_there_is_no_such_service():
    code = (
        "import sys; sys.modules['moveit_msgs'] = None\n"
        "from parallel_cal.nodes.position_ik import find_service_type\n"
        "print(find_service_type())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout == "None\n", done.stderr


@pytest.mark.wide
def test_a_client_gets_it_from_the_node(service, arm, tmp_path):
    write_model(arm.model, tmp_path / "robot.yaml")
    with mock.patch.dict(os.environ):
        use_private_domain()
        file = str(tmp_path / "robot.yaml")
        process = NodeProcess(NODE, tmp_path, "/position_ik", model_file=file)
        client = Client("tester", "/position_ik", [process])
        try:
            status = client.subscribe_latest(ModelStatus, f"{NODE}/model_status")
            client.wait(lambda: status and status[0].ok, "the model")
            joints = np.array(arm.model.mechanism.home.joints)
            for by in (0.05, -0.1, 0.15):
                q = joints + by
                pose = pose_of(arm.kinematics.direct(q))
                asked = request_of(service, pose, seed=q + 0.01, names=arm.model.joints)
                name = f"{NODE}/{position_ik.NAME}"
                answer = client.call(service, name, ik_request=asked.ik_request)
                assert answer.error_code.val == answer.error_code.SUCCESS
                np.testing.assert_allclose(answer.solution.joint_state.position, q, atol=1e-9)
            asked.ik_request.pose_stamped.header.frame_id = "world"
            answer = client.call(service, name, ik_request=asked.ik_request)
            assert answer.error_code.val == answer.error_code.FRAME_TRANSFORM_FAILURE
            assert not answer.solution.joint_state.position
        finally:
            client.close()
            status = process.end()
        assert status == 0
