"""The kinematics node as others see it: a process with services, streams and parameters."""

# ruff: noqa: E402 - what needs ROS is imported after the check that it is there

import itertools
import os
import shutil
import signal
import time
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy", reason="ROS 2 (rclpy) is not installed")
pytest.importorskip("parallel_cal_msgs", reason="the messages (msg_defs) are not installed")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import (
    Point,
    Pose,
    PoseStamped,
    PoseWithCovarianceStamped,
    Quaternion,
)
from nav_msgs.msg import Path as PosePath
from parallel_cal_msgs.msg import (
    CommandStatus,
    Condition,
    JointConfiguration,
    ModelStatus,
    Solution,
)
from parallel_cal_msgs.srv import ComputeFK, ComputeIK, LoadModel
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParameters, SetParametersAtomically
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_helpers import Hammer, NodeProcess
from sensor_msgs.msg import JointState, Temperature
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from parallel_cal.exporting.tree import tree_of
from parallel_cal.kinematics.all_solutions import direct_all
from parallel_cal.kinematics.kinematics import Kinematics, Status
from parallel_cal.model.file.modelfile import model_hash, read_model, write_model
from parallel_cal.nodes.client import Client, use_private_domain
from parallel_cal.nodes.conversions import STOPPING_TIME_S
from parallel_cal.nodes.streams import MAX_HALT_AGE_S

CONFIG = Path(__file__).parents[2] / "config"
NOMINAL, IDENTIFIED = CONFIG / "delta_mockup_nominal.yaml", CONFIG / "delta_mockup_identified.yaml"
NODE, NAMES = "kinematics_node", ["joint1", "joint2", "joint3"]
RANDOM = np.random.default_rng(5)
STAMPS = itertools.count(42)


def configurations(q):
    return [JointConfiguration(positions=row.tolist()) for row in np.atleast_2d(q)]


def pose(position, quaternion=(0.0, 0.0, 0.0, 1.0)):
    x, y, z, w = map(float, quaternion)
    point = Point(**dict(zip("xyz", map(float, position), strict=True)))
    return Pose(position=point, orientation=Quaternion(x=x, y=y, z=z, w=w))


def numbers(pose):
    p, o = pose.position, pose.orientation
    return [p.x, p.y, p.z, o.x, o.y, o.z, o.w]


def as_parameter(name, value):
    if isinstance(value, float):
        double = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value)
        return Parameter(name=name, value=double)
    text = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=str(value))
    return Parameter(name=name, value=text)


class Robot:
    """The node on a file of its own, and a client of it."""

    def __init__(self, folder):
        self.folder, self.namespace = folder, use_private_domain()
        self.file = folder / "robot.yaml"
        self.known = {}
        shutil.copy(NOMINAL, self.file)
        self.learn(NOMINAL), self.learn(IDENTIFIED)
        files = {"model_file": str(self.file), "allowed_folders": f"{folder}:{CONFIG}"}
        self.process = NodeProcess(NODE, folder, self.namespace, **files)
        self.client = Client("tester", self.namespace, [self.process])
        self.status = self.client.subscribe_latest(ModelStatus, f"{NODE}/model_status")
        self.diagnostics = {}
        self.client._node.create_subscription(DiagnosticArray, "/diagnostics", self._diagnosed, 10)
        self.client.wait(lambda: bool(self.status), "a model status")

    def _diagnosed(self, message):
        self.diagnostics |= {s.name.split(": ")[1]: s for s in message.status}

    def learn(self, file):
        self.known[model_hash(Path(file).read_text())] = Kinematics(read_model(file))

    def call(self, type, name, **fields):
        return self.client.call(type, f"{NODE}/{name}", **fields)

    def fk(self, q, **fields):
        return self.call(ComputeFK, "compute_fk", configurations=configurations(q), **fields)

    def ik(self, poses, **fields):
        return self.call(ComputeIK, "compute_ik", targets=poses, **fields)

    @property
    def kinematics(self):
        return self.known[self.status[0].hash]

    def set(self, **parameters):
        values = [as_parameter(name, value) for name, value in parameters.items()]
        return self.call(SetParameters, "set_parameters", parameters=values).results[0]

    def set_together(self, **parameters):
        values = [as_parameter(name, value) for name, value in parameters.items()]
        service = "set_parameters_atomically"
        return self.call(SetParametersAtomically, service, parameters=values).result

    def model_file(self):
        answer = self.call(GetParameters, "get_parameters", names=["model_file"])
        return answer.values[0].string_value

    def wait_for_status(self, source, ok, hash=None):
        def there():
            now = self.status[0]
            return (now.source, now.ok) == (source, ok) and hash in (None, now.hash)

        self.client.wait(there, f"status {source} ok={ok}")
        return self.status[0]

    def wait_for_diagnosis(self, name, ready):
        self.client.wait(
            lambda: name in self.diagnostics and ready(self.diagnostics[name]), f"diagnosis {name}"
        )
        return {item.key: item.value for item in self.diagnostics[name].values}

    def back_to(self, file):
        shutil.copy(file, self.file)
        assert self.call(LoadModel, "load_model", path=str(self.file)).success


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    with mock.patch.dict(os.environ):
        robot = Robot(tmp_path_factory.mktemp("robot"))
        yield robot
        robot.client.close()
        assert robot.process.end(signal.SIGINT) == 0


# ------------------------------------------------------------------ requests


def test_many_configurations_are_answered_in_order_by_the_model_named(robot):
    q = RANDOM.uniform(0.2, 0.9, (40, 3))
    answer = robot.fk(q)
    assert answer.message == ""
    expected = robot.known[answer.model_hash].direct(q)
    for row, solution in zip(answer.results, expected, strict=True):
        (one,) = row.solutions
        assert one.status == Solution.CONVERGED
        assert numbers(one.pose) == [*solution.position, *solution.quaternion]
        assert one.residual == solution.residual
        assert row.count_complex == -1


def test_what_is_wrong_with_one_configuration_leaves_the_others_answered(robot):
    rows = configurations([[0.5] * 3, [np.nan] * 3, [9.0] * 3])
    rows.insert(1, JointConfiguration(positions=[0.5]))
    answer = robot.call(ComputeFK, "compute_fk", configurations=rows)
    one = [row.solutions[0] for row in answer.results]
    assert [s.status for s in one[:3]] == [0, Solution.INVALID_INPUT, Solution.INVALID_INPUT]
    assert one[3].status != Solution.CONVERGED
    assert all(s.message for s in one[1:])


def test_joints_are_matched_by_name(robot):
    q = np.array([0.5, 0.6, 0.7])
    answer = robot.fk(q[::-1], joint_names=NAMES[::-1])
    assert list(answer.results[0].solutions[0].joints) == q.tolist()
    for names in (["joint1", "joint2", "elbow"], ["joint1", "joint2"], [*NAMES, "joint4"]):
        refused = robot.fk(q, joint_names=names)
        assert refused.results == []
        assert "joint" in refused.message


def test_targets_give_joints_that_lead_back(robot):
    q = RANDOM.uniform(0.3, 0.8, (20, 3))
    there = robot.kinematics.direct(q)
    poses = [pose(r, o) for r, o in zip(there.position, there.quaternion, strict=True)]
    answer = robot.ik(poses)
    assert answer.joint_names == NAMES
    found = np.array([row.solutions[0].joints for row in answer.results])
    assert np.abs(found - q).max() < 1e-9


def test_what_the_robot_does_not_control_is_ignored_in_a_target(robot):
    upside_down = robot.ik([pose((0, 0, 0.2)), pose((0, 0, 0.2), (1, 0, 0, 0))])
    first, second = (row.solutions[0] for row in upside_down.results)
    assert first.joints == second.joints


def test_bad_targets_are_statuses(robot):
    bad = [
        pose((0, 0, np.inf)),
        pose((0, 0, 0.2), (0, 0, 0, 0)),
        pose((0, 0, 0.2), (0, 0, 0, 2)),
        pose((0, 0, 0.9)),
    ]
    found = [row.solutions[0] for row in robot.ik(bad).results]
    assert [s.status for s in found] == [5, 5, 5, Solution.UNREACHABLE]
    assert "length 2" in found[2].message
    assert robot.ik([]).results == []


def test_all_solutions_are_given_when_asked_for(robot):
    q = np.array([0.5, 0.6, 0.7])
    poses = robot.fk(q, all_solutions=True).results[0].solutions
    assert len(poses) == len(direct_all(robot.kinematics.model, q)) > 1
    there = [poses[0].pose]
    joints = robot.ik(there, all_solutions=True).results[0].solutions
    assert len(joints) > 1


def test_each_result_says_whether_others_may_exist(robot):
    """Six rods have a complete method for their poses; for the joints there is a search."""
    q = np.array([0.5, 0.6, 0.7])
    poses = robot.fk(q, all_solutions=True).results[0]
    joints = robot.ik([poses.solutions[0].pose], all_solutions=True).results[0]
    assert (poses.complete, joints.complete) == (True, False)
    assert not robot.fk(q).results[0].complete


def test_a_solver_by_name_answers_and_an_unknown_one_is_a_message(robot):
    q = [0.5, 0.6, 0.7]
    named, usual = robot.fk(q, solver="newton"), robot.fk(q)
    assert named.results[0].solutions[0].pose == usual.results[0].solutions[0].pose
    assert "no solver 'magic'" in robot.fk(q, solver="magic").message


def test_covariance_is_empty_while_unknown_and_the_model_s_where_known(robot):
    q, target = [0.5, 0.6, 0.7], [pose((0.01, 0, 0.2))]
    assert len(robot.fk(q, with_covariance=True).results[0].solutions[0].covariance) == 0
    model = read_model(IDENTIFIED)
    sure = replace(model, covariance=np.diag((model.table.tolerance / 10) ** 2))
    write_model(sure, robot.folder / "sure.yaml")
    robot.learn(robot.folder / "sure.yaml")
    assert robot.call(LoadModel, "load_model", path=str(robot.folder / "sure.yaml")).success
    answer = robot.fk([q, q], with_covariance=True)
    k = robot.known[answer.model_hash]
    expected = k.direct_covariance(k.direct(np.array(q)), None, k.model.noise.joint)
    for row in answer.results:
        assert np.array_equal(np.reshape(row.solutions[0].covariance, (6, 6)), expected)
    joints = robot.ik(target, with_covariance=True).results[0].solutions[0]
    assert len(joints.covariance) == 9
    assert_pose_with_covariance(robot, expected)
    robot.back_to(NOMINAL)


def assert_pose_with_covariance(robot, expected):
    publisher = robot.client._node.create_publisher(JointState, "joint_states", 10)
    heard = heard_on(robot, PoseWithCovarianceStamped, f"{NODE}/pose_with_covariance")
    state = JointState(name=NAMES, position=[0.5, 0.6, 0.7])
    answer = publish_until(robot, publisher, state, heard)
    assert np.array_equal(np.reshape(answer.pose.covariance, (6, 6)), expected)


def test_conditions_are_taken_by_name_and_unknown_ones_are_a_message(robot):
    model = read_model(IDENTIFIED).with_effect("backlash")
    values = np.where(["width" in name for name in model.table.names], 1e-3, model.values)
    write_model(model.with_values(values), robot.folder / "play.yaml")
    robot.learn(robot.folder / "play.yaml")
    assert robot.call(LoadModel, "load_model", path=str(robot.folder / "play.yaml")).success
    assert robot.fk([0.5] * 3).model_hash in robot.known
    up = robot.fk([0.5] * 3, conditions=[Condition(name="direction", value=1.0)])
    at = {f"direction.{joint}": 1.0 for joint in NAMES}
    expected = robot.known[up.model_hash].direct(np.full(3, 0.5), at)
    assert numbers(up.results[0].solutions[0].pose)[:3] == expected.position.tolist()
    assert "no condition 'mood'" in robot.fk([0.5] * 3, conditions=[Condition(name="mood")]).message
    robot.back_to(NOMINAL)


# ------------------------------------------------------------------ exchanging the model


def test_under_load_every_answer_is_exactly_that_of_the_model_it_names(robot):
    """Good and bad files by parameter, service and watch, while requests come in."""
    q = RANDOM.uniform(0.3, 0.8, (5, 3))
    requests = [{"configurations": configurations(row)} for row in q] + [
        {"configurations": configurations(q)}
    ]
    bad = robot.folder / "bad.yaml"
    bad.write_text(IDENTIFIED.read_text().replace("value: 0.075902", "value: .nan"))
    nominal, identified = (model_hash(f.read_text()) for f in (NOMINAL, IDENTIFIED))
    with Hammer(robot.namespace, ComputeFK, f"{NODE}/compute_fk", requests) as hammer:
        robot.client.wait(lambda: len(hammer.answers) > 5, "first answers")
        for _ in range(2):
            assert robot.set(model_file=IDENTIFIED).successful
            robot.wait_for_status("parameter", True, identified)
            rejected = robot.set(model_file=bad)
            assert not rejected.successful
            assert "D_x" in rejected.reason
            robot.wait_for_status("parameter", False, identified)
            assert robot.model_file() == str(IDENTIFIED)

            loaded = robot.call(LoadModel, "load_model", path=str(robot.file))
            assert (loaded.success, loaded.hash) == (True, nominal)
            assert robot.model_file() == str(robot.file)
            refused = robot.call(LoadModel, "load_model", path=str(bad))
            assert (refused.success, refused.hash) == (False, nominal)
            assert "D_x" in refused.message

            write_model(read_model(IDENTIFIED), robot.file)
            robot.wait_for_status("watch", True, identified)
            robot.file.write_text(bad.read_text())
            robot.wait_for_status("watch", False, identified)
            assert not robot.call(Trigger, "reload").success
            shutil.copy(NOMINAL, robot.file)
            robot.wait_for_status("watch", True, nominal)
            assert robot.call(Trigger, "reload").success
        robot.client.wait(lambda: len(hammer.answers) > 50, "answers")
    for request, answer in hammer.answers:
        assert answer.message == ""
        kinematics = robot.known[answer.model_hash]
        for c, row in zip(request["configurations"], answer.results, strict=True):
            expected = kinematics.direct(np.array(c.positions))
            found = numbers(row.solutions[0].pose)
            assert found == [*expected.position, *expected.quaternion]
    used = {answer.model_hash for _, answer in hammer.answers}
    assert used == {nominal, identified}


def test_of_a_burst_of_requests_none_is_lost(robot):
    deep = QoSProfile(depth=1000)  # the client's own queue
    client = robot.client._node.create_client(ComputeFK, f"{NODE}/compute_fk", qos_profile=deep)
    robot.client.wait(client.service_is_ready, "the service")
    request = ComputeFK.Request(configurations=configurations([0.5] * 3))
    sent = [client.call_async(request) for _ in range(300)]
    robot.client.wait(lambda: all(future.done() for future in sent), "all answers")
    statuses = {future.result().results[0].solutions[0].status for future in sent}
    assert statuses == {Solution.CONVERGED}


def test_a_bad_file_is_reported_in_status_and_diagnostics_and_the_model_stays(robot):
    before = robot.fk([0.5] * 3)
    robot.file.write_text("parallel_cal: 1\nmechanism: delta54\n")
    status = robot.wait_for_status("watch", False)
    assert "joints" in status.reason
    assert (status.hash, status.model_file) == (before.model_hash, str(robot.file))
    told = robot.wait_for_diagnosis("model", lambda s: "joints" in s.message)
    assert robot.diagnostics["model"].level == DiagnosticStatus.WARN
    assert told["last failure"] == status.reason
    assert told["hash"] == before.model_hash
    assert robot.fk([0.5] * 3) == before
    shutil.copy(NOMINAL, robot.file)
    robot.wait_for_status("watch", True)
    robot.wait_for_diagnosis("model", lambda s: s.level == DiagnosticStatus.OK)


def test_loading_the_same_file_again_is_reported_as_unchanged(robot):
    assert "same content" in robot.call(Trigger, "reload").message


def test_files_outside_the_allowed_folders_and_modules_of_strangers_are_refused(robot):
    (robot.folder / "link.yaml").symlink_to("/etc/passwd")
    for path in (
        "/etc/passwd",
        "/dev/zero",
        f"{robot.folder}/../x.yaml",
        robot.folder / "link.yaml",
    ):
        refused = robot.call(LoadModel, "load_model", path=str(path))
        assert not refused.success
        assert "not in a folder that requests may use" in refused.message
        assert "allowed_folders" in robot.set(model_file=path).reason
    (robot.folder / "foreign.yaml").write_text("parallel_cal: 1\nmechanism: antigravity.robot\n")
    refused = robot.call(LoadModel, "load_model", path=str(robot.folder / "foreign.yaml"))
    assert "allow_foreign_modules" in refused.message
    assert "allow_foreign_modules" in robot.fk([0.5] * 3, solver="antigravity.robot").message


# ------------------------------------------------------------------ streams


def heard_on(robot, type, topic):
    heard = []
    robot.client._node.create_subscription(type, topic, heard.append, 10)
    return heard


def publish_until(robot, publisher, message, heard, stamped=True):
    """The answer to this very message, told by its stamp: those to the test before may still be
    under way. Published again and again: the first ones may find no reader. A command has no
    stamp (it begins when it arrives): for those the first one counts."""
    message.header.stamp.sec, begin = next(STAMPS), len(heard)

    def answers():
        new = heard[begin:]
        return [one for one in new if one.header.stamp == message.header.stamp] if stamped else new

    def there():
        publisher.publish(message)
        return bool(answers())

    robot.client.wait(there, "an answer on a topic")
    return answers()[0]


def test_joint_states_become_poses_at_their_time_whatever_their_order(robot):
    publisher = robot.client._node.create_publisher(JointState, "joint_states", 10)
    heard = heard_on(robot, PoseStamped, f"{NODE}/pose")
    state = JointState(name=["other", *NAMES[::-1]], position=[7.0, 0.7, 0.6, 0.5])
    answer = publish_until(robot, publisher, state, heard)
    expected = robot.kinematics.direct(np.array([0.5, 0.6, 0.7]))
    assert numbers(answer.pose) == [*expected.position, *expected.quaternion]
    assert answer.header.frame_id == "base"


def test_joint_states_become_those_of_the_passive_joints_of_the_exported_tree(robot):
    publisher = robot.client._node.create_publisher(JointState, "joint_states", 10)
    heard = heard_on(robot, JointState, f"{NODE}/passive_joint_states")
    state = JointState(name=[*NAMES], position=[0.5, 0.6, 0.7])
    answer = publish_until(robot, publisher, state, heard)
    tree = tree_of(robot.kinematics.model)
    row = robot.kinematics.direct(np.array([0.5, 0.6, 0.7])).configuration.rows
    assert list(answer.name) == tree.passive
    assert list(answer.position) == pytest.approx(tree.values(row), abs=1e-12)


def test_poses_outside_the_identified_region_are_counted(robot):
    """Samples came from joint angles of 0.5 to 0.6 rad; the robot is used at 0.9."""
    ranges = {name: [0.5, 0.6] for name in NAMES}
    model = read_model(IDENTIFIED)
    write_model(
        replace(model, history=({"step": "fit", "region": {"joints": ranges}},)), robot.file
    )
    robot.learn(robot.file)
    assert robot.call(LoadModel, "load_model", path=str(robot.file)).success
    publisher = robot.client._node.create_publisher(JointState, "joint_states", 10)
    heard = heard_on(robot, PoseStamped, f"{NODE}/pose")
    publish_until(robot, publisher, JointState(name=[*NAMES], position=[0.55] * 3), heard)
    key = "joint_states outside the identified region"
    far = JointState(name=[*NAMES], position=[0.9] * 3)

    def counted(status):
        publisher.publish(far)
        return any(item.key == key for item in status.values)

    assert int(robot.wait_for_diagnosis("traffic", counted)[key]) >= 1
    robot.back_to(NOMINAL)


def test_a_joint_state_without_a_joint_is_counted_and_reported(robot):
    publisher = robot.client._node.create_publisher(JointState, "joint_states", 10)
    robot.client.wait(lambda: publisher.get_subscription_count() > 0, "the node")
    incomplete = JointState(name=NAMES[:2], position=[0.5, 0.5])
    complete = JointState(name=[*NAMES], position=[0.5, 0.5, 0.5])
    for _ in range(3):
        robot.fk([0.5] * 3)

    def told(status):
        publisher.publish(incomplete)
        publisher.publish(complete)
        values = {v.key: v.value for v in status.values}
        return "joint3" in values.get("joint_states refused: last reason", "") and int(
            values.get("joint_states received", 0)
        ) > int(values.get("joint_states refused", 0))

    counts = robot.wait_for_diagnosis("traffic", told)
    assert int(counts["joint_states refused"]) >= 1
    assert int(counts["compute_fk answered"]) >= 3


def told_of(robot, publisher, message, reason):
    """Publish until the diagnostics give this reason for a refusal."""

    def told(status):
        publisher.publish(message)
        return any(reason in v.value for v in status.values if v.key.endswith("last reason"))

    robot.wait_for_diagnosis("traffic", told)


def test_a_joint_given_twice_and_an_invalid_temperature_are_refused(robot):
    joints = robot.client._node.create_publisher(JointState, "joint_states", 10)
    thermometer = robot.client._node.create_publisher(Temperature, "temperature", 10)
    twice = JointState(name=[*NAMES, "joint1"], position=[0.5, 0.6, 0.7, 0.9])
    told_of(robot, joints, twice, "joint1 given more than once")
    told_of(robot, thermometer, Temperature(temperature=np.nan), "the value is nan")


def test_velocities_that_are_not_numbers_are_computed_from_the_positions(robot):
    model = read_model(IDENTIFIED).with_effect("latency")
    write_model(model, robot.folder / "late.yaml")
    robot.learn(robot.folder / "late.yaml")
    assert robot.call(LoadModel, "load_model", path=str(robot.folder / "late.yaml")).success
    publisher = robot.client._node.create_publisher(JointState, "joint_states", 10)
    heard = heard_on(robot, PoseStamped, f"{NODE}/pose")
    state = JointState(name=NAMES, position=[0.5, 0.6, 0.7], velocity=[np.nan] * 3)
    answer = publish_until(robot, publisher, state, heard)
    expected = robot.kinematics.direct(np.array([0.5, 0.6, 0.7]))
    assert numbers(answer.pose)[:3] == expected.position.tolist()
    robot.back_to(NOMINAL)


def test_a_topic_that_is_published_with_another_type_is_reported(robot):
    stranger = Client("stranger", robot.namespace, [])
    stranger._node.create_publisher(Pose, "target_pose", 10)
    expected = "target_pose is published as geometry_msgs/msg/Pose, expected"
    robot.wait_for_diagnosis("traffic", lambda s: expected in s.message)
    assert robot.diagnostics["traffic"].level == DiagnosticStatus.WARN
    stranger.close()


def test_a_target_becomes_the_command_of_the_calibrated_inverse_and_others_nothing(robot):
    targets = robot.client._node.create_publisher(PoseStamped, "target_pose", 10)
    heard = heard_on(robot, JointTrajectory, "joint_command")
    spoken = heard_on(robot, CommandStatus, f"{NODE}/command_status")
    be_at(robot, robot.kinematics.inverse(np.array([0.0101, 0.02, 0.2])).joints)
    good = PoseStamped(pose=pose((0.01, 0.02, 0.2)))
    good.header.frame_id = "base"
    command = publish_until(robot, targets, good, heard, stamped=False)
    expected = robot.kinematics.inverse(np.array([0.01, 0.02, 0.2]))
    (point,) = command.points
    assert command.joint_names == NAMES
    assert list(point.positions) == expected.joints.tolist()
    assert list(point.velocities) == [0.0, 0.0, 0.0]
    assert point.time_from_start.nanosec == 100_000_000
    robot.client.wait(lambda: bool(spoken), "its status")
    assert (spoken[-1].status, spoken[-1].message) == (CommandStatus.ACCEPTED, "")
    assert spoken[-1].singularity > 0.1
    bad = {
        "unreachable": PoseStamped(pose=pose((0, 0, 0.9))),
        "not finite": PoseStamped(pose=pose((0, 0, np.nan))),
        "numpy.float32 or an int": PoseStamped(pose=pose((0, 0, 5e-324))),
        "length 0": PoseStamped(pose=pose((0, 0, 0.2), (0, 0, 0, 0))),
        "frame_id 'tool'": PoseStamped(pose=pose((0, 0, 0.2))),
        "outside limits": PoseStamped(pose=pose(outside_limits(robot))),
    }
    bad["frame_id 'tool'"].header.frame_id = "tool"
    robot.client.wait(lambda: all_answered(robot, "target_pose"), "the counts")
    targets.publish(PoseStamped(header=good.header, pose=pose((0.0, 0.02, 0.2))))
    joints = robot.kinematics.inverse(np.array([0.0, 0.02, 0.2])).joints.tolist()
    robot.client.wait(lambda: list(heard[-1].points[0].positions) == joints, "what is on its way")
    for reason, message in bad.items():
        before, commands = refused(robot), len(heard)
        targets.publish(message)
        told = robot.wait_for_diagnosis("traffic", lambda s, n=before: refused(robot) == n + 1)
        assert reason in told["target_pose refused: last reason"]
        assert len(heard) == commands
        robot.client.wait(lambda r=reason: r in spoken[-1].message, "the status of the target")
        assert spoken[-1].status == CommandStatus.REFUSED


def be_at(robot, q):
    """Let the node know that the robot is at joints q: a pose comes of it."""
    publisher = robot.client._node.create_publisher(JointState, "joint_states", 10)
    heard = heard_on(robot, PoseStamped, f"{NODE}/pose")
    publish_until(robot, publisher, JointState(name=NAMES, position=list(map(float, q))), heard)


def test_a_jump_is_given_the_time_it_needs_and_one_out_of_the_workspace_is_refused(robot):
    """120 mm in 0.1 s used to be passed on."""
    targets = robot.client._node.create_publisher(PoseStamped, "target_pose", 10)
    heard = heard_on(robot, JointTrajectory, "joint_command")
    told = heard_on(robot, CommandStatus, f"{NODE}/command_status")
    here, there = np.array([-0.05, -0.05, 0.2]), np.array([0.035, 0.035, 0.2])
    q = robot.kinematics.inverse(here).joints
    be_at(robot, q)
    be_at(robot, q)  # twice: it rests, wherever another test left it
    target = PoseStamped(pose=pose(there))
    command = publish_until(robot, targets, target, heard, stamped=False)
    low, high = np.array(robot.kinematics.model.mechanism.joint_limits).T
    goal = robot.kinematics.inverse(there).joints
    needed = float(np.max(1.5 * np.abs(goal - q) / (high - low)))
    given = command.points[0].time_from_start
    assert given.sec + given.nanosec * 1e-9 == pytest.approx(needed, rel=1e-6)
    robot.client.wait(lambda: told and told[-1].status == CommandStatus.SLOWED, "the status")
    assert "velocity" in told[-1].message
    targets.publish(PoseStamped(pose=pose((0.0, 0.0, 0.262))))
    robot.client.wait(lambda: told[-1].status == CommandStatus.REFUSED, "the refusal")
    assert "workspace" in told[-1].message
    assert heard
    assert all(list(command.points[0].positions) == goal.tolist() for command in heard)


def test_a_path_becomes_one_trajectory_within_the_limits_or_a_refusal(robot):
    paths = robot.client._node.create_publisher(PosePath, "target_path", 10)
    heard = heard_on(robot, JointTrajectory, "joint_command")
    told = heard_on(robot, CommandStatus, f"{NODE}/command_status")
    start = robot.kinematics.inverse(np.array([-0.03, 0.0, 0.2])).joints
    be_at(robot, start)
    be_at(robot, start)  # twice: it rests
    places = [(0.03, 0.0, 0.2), (0.03, 0.03, 0.2)]
    message = PosePath(poses=[PoseStamped(pose=pose(place)) for place in places])
    command = publish_until(robot, paths, message, heard, stamped=False)
    robot.client.wait(lambda: told and told[-1].status == CommandStatus.ACCEPTED, "the status")
    q, v = (np.array([getattr(p, k) for p in command.points]) for k in ("positions", "velocities"))
    time = np.array(
        [p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in command.points]
    )
    assert command.joint_names == NAMES
    assert time[0] == 0.0
    assert (np.diff(time) > 0).all()
    assert told[-1].time_from_start == pytest.approx(time[-1], abs=1e-6)
    assert told[-1].singularity > 0.02
    np.testing.assert_allclose(q[0], start, atol=1e-9)
    assert not v[[0, -1]].any()
    seen = robot.kinematics.direct(q).position
    np.testing.assert_allclose(seen[-1], places[-1], atol=1e-9)
    assert np.abs(seen[:, 2] - 0.2).max() < 1e-9
    low, high = np.array(robot.kinematics.model.mechanism.joint_limits).T
    assert (np.abs(v) <= (high - low) * (1 + 1e-9)).all()
    for reason, poses in (
        ("workspace before pose 1 of 1", [(0.0, 0.0, 0.27)]),
        ("no poses", []),
        ("not finite", [(0.0, 0.0, np.nan)]),
    ):
        paths.publish(PosePath(poses=[PoseStamped(pose=pose(place)) for place in poses]))
        robot.client.wait(lambda r=reason: r in told[-1].message, f"the refusal '{reason}'")
        assert told[-1].status == CommandStatus.REFUSED
    moving = JointState(name=NAMES, position=start.tolist(), velocity=[0.0, 0.5, 0.0])
    states = robot.client._node.create_publisher(JointState, "joint_states", 10)
    poses_heard = heard_on(robot, PoseStamped, f"{NODE}/pose")
    publish_until(robot, states, moving, poses_heard)
    paths.publish(message)
    robot.client.wait(lambda: "joint2 moves at 0.5" in told[-1].message, "the refusal")
    accepted = [status for status in told if status.status == CommandStatus.ACCEPTED]
    robot.client.wait(lambda: len(heard) == len(accepted), "one command for each accepted path")


def test_stop_halts_a_robot_that_is_seen_and_refuses_where_it_is_unknown(robot):
    states = robot.client._node.create_publisher(JointState, "joint_states", 10)
    poses = heard_on(robot, PoseStamped, f"{NODE}/pose")
    heard = heard_on(robot, JointTrajectory, "joint_command")
    q, speed = robot.kinematics.inverse(np.array([0.0, 0.0, 0.2])).joints, np.array([0.4, 0, 0])
    publish_until(robot, states, JointState(name=NAMES, position=q.tolist()), poses)
    rest = JointState(name=NAMES, position=q.tolist(), velocity=[0.0] * 3)
    publish_until(robot, states, rest, poses)
    assert robot.call(Trigger, "stop").success
    robot.client.wait(lambda: bool(heard), "the command")
    (point,) = heard[-1].points
    np.testing.assert_allclose(point.positions, q, atol=1e-12)
    assert list(point.velocities) == [0.0] * 3
    moving = JointState(name=NAMES, position=q.tolist(), velocity=speed.tolist())
    publish_until(robot, states, moving, poses)
    answer = robot.call(Trigger, "stop")
    if answer.success:  # a busy computer may have taken longer than such a stop may
        robot.client.wait(lambda: len(heard) == 2, "the command")
        ahead = np.array(heard[-1].points[0].positions) - q
        assert 0.4 * STOPPING_TIME_S / 2 <= ahead[0] < 0.4 * (MAX_HALT_AGE_S + STOPPING_TIME_S)
        np.testing.assert_allclose(ahead[1:], 0, atol=1e-12)
    time.sleep(2 * MAX_HALT_AGE_S)
    answer = robot.call(Trigger, "stop")
    assert not answer.success
    assert "its position is unknown; stop it by other means" in answer.message
    publish_until(robot, states, rest, poses)


def traffic(robot):
    """The counts of messages in the last diagnostics; empty before the first."""
    told = robot.diagnostics.get("traffic")
    return {v.key: v.value for v in told.values} if told else {}


def all_answered(robot, channel):
    counts = traffic(robot)
    return counts.get(f"{channel} received") == counts.get(f"{channel} answered") is not None


def refused(robot):
    return int(traffic(robot).get("target_pose refused", 0))


def outside_limits(robot):
    """A position the robot would reach if its arms could turn a little further."""
    low = robot.kinematics.model.mechanism.joint_limits[0][0]
    there = robot.kinematics.direct(np.full(3, low - 0.05))
    assert there.status == Status.OUTSIDE_LIMITS
    return there.position


# ------------------------------------------------------------------ beginning and end


@mock.patch.dict(os.environ)
def test_without_a_file_it_says_so_and_recovers_when_one_comes_under_other_topic_names(tmp_path):
    namespace, file = use_private_domain() + "_empty", tmp_path / "later" / "robot.yaml"
    ros = ["-r", "joint_states:=arm/angles"]
    ros += ["-p", f"qos_overrides.{namespace}/arm/angles.subscription.reliability:=reliable"]
    process = NodeProcess(NODE, tmp_path, namespace, ros=ros, model_file=str(file))
    client = Client("tester", namespace, [process])
    status = client.subscribe_latest(ModelStatus, f"{NODE}/model_status")
    client.wait(lambda: bool(status), "a status")
    assert (status[0].ok, status[0].source, status[0].hash) == (False, "startup", "")
    request = {"configurations": configurations([0.5] * 3)}
    empty = client.call(ComputeFK, f"{NODE}/compute_fk", **request)
    assert empty.results == []
    assert str(file) in empty.message
    file.parent.mkdir()
    write_model(read_model(IDENTIFIED), file)
    client.wait(lambda: status[0].ok, "the model")
    assert client.call(ComputeFK, f"{NODE}/compute_fk", **request).model_hash == status[0].hash
    listeners = client._node.get_subscriptions_info_by_topic(f"{namespace}/arm/angles")
    qos = [info.qos_profile for info in listeners]
    assert [q.reliability for q in qos] == [ReliabilityPolicy.RELIABLE]
    client.close()
    assert process.end(signal.SIGTERM) == 0


def test_a_parameter_of_the_wrong_kind_is_one_clear_line_and_a_whole_number_will_do(tmp_path):
    process = NodeProcess(NODE, tmp_path, use_private_domain() + "_kinds", time_from_start="soon")
    assert process.ended() == 1
    assert process.said.startswith("error: parameter time_from_start: expected a number")
    assert process.said.count("\n") == 1


def test_a_parameter_that_is_not_allowed_is_refused_while_running(robot):
    rclpys_words = "expected 'Type.DOUBLE' got 'Type.STRING'"
    for value in ("soon", 1e30, -1.0, np.nan):
        refused = robot.set(time_from_start=value)
        assert not refused.successful
        if isinstance(value, str):
            assert rclpys_words in refused.reason
        else:
            assert "time_from_start" in refused.reason
            assert "Min: 0.0, Max: 3600.0" in refused.reason
    assert robot.call(ComputeFK, "compute_fk", configurations=configurations([0.5] * 3)).results


def test_parameters_refused_together_leave_the_model_as_it_is(robot):
    before = robot.fk([0.5] * 3).model_hash
    together = robot.set_together(model_file=IDENTIFIED, direction_threshold=-1.0)
    assert "direction_threshold" in together.reason
    assert robot.fk([0.5] * 3).model_hash == before
    assert robot.model_file() == str(robot.file)


# ------------------------------------------------------------------ what takes long


@pytest.fixture(scope="module")
def stewart(tmp_path_factory):
    """A node on a Stewart platform, whose requests may take four seconds."""
    with mock.patch.dict(os.environ):
        folder, namespace = tmp_path_factory.mktemp("stewart"), use_private_domain() + "_stewart"
        file = shutil.copy(CONFIG / "stewart_general.yaml", folder / "robot.yaml")
        limits = {"request_time": 4.0, "request_poses": 500}
        process = NodeProcess(NODE, folder, namespace, model_file=str(file), **limits)
        client = Client("tester", namespace, [process])
        client.kinematics = Kinematics(read_model(file))
        client.home = np.array(client.kinematics.model.mechanism.home.joints)
        yield client
        client.close()
        assert process.end(signal.SIGTERM) == 0


@pytest.mark.wide
def test_a_request_over_its_budget_is_answered_with_what_was_done(stewart):
    """Four seconds are far too little for every pose of 450; the first ones are there."""
    rows = configurations(np.tile(stewart.home, (450, 1)))
    name = f"{NODE}/compute_fk"
    answer = stewart.call(ComputeFK, name, configurations=rows, all_solutions=True)
    assert "over budget" in answer.message
    assert len(answer.results) == 450
    first, last = answer.results[0].solutions, answer.results[-1].solutions
    assert first[0].status == Solution.CONVERGED
    assert [one.status for one in last] == [Solution.NOT_TRIED]
    done = sum(r.solutions[0].status != Solution.NOT_TRIED for r in answer.results)
    assert f"{done} of 450 were answered" in answer.message


@pytest.mark.wide
def test_more_configurations_than_a_request_may_ask_for_are_not_tried(stewart):
    rows = configurations(np.tile(stewart.home, (600, 1)))
    answer = stewart.call(ComputeFK, f"{NODE}/compute_fk", configurations=rows)
    assert "500 of 600 were answered" in answer.message
    assert [r.solutions[0].status for r in answer.results[499:501]] == [0, Solution.NOT_TRIED]


@pytest.mark.wide
def test_a_solver_that_builds_a_table_is_refused(stewart):
    rows = configurations(stewart.home)
    for solver in ("lookup_table", "lookup_table:size=400"):
        answer = stewart.call(ComputeFK, f"{NODE}/compute_fk", configurations=rows, solver=solver)
        assert "builds a table" in answer.message
        assert not answer.results


@pytest.mark.wide
def test_poses_go_on_while_a_request_is_worked_on(stewart):
    """No pose waits for a request: of 100 joint states sent one by one while it runs, each is
    answered before it."""
    client, node = stewart, stewart._node
    states, heard = node.create_publisher(JointState, "joint_states", 10), []
    node.create_subscription(PoseStamped, f"{NODE}/pose", heard.append, 10)
    names = list(client.kinematics.model.joints)
    state = JointState(name=names, position=client.home.tolist())

    def answered():
        states.publish(state)
        return bool(heard)

    client.wait(answered, "a pose")
    rows = configurations(np.tile(client.home, (300, 1)))
    running = client.ask(ComputeFK, f"{NODE}/compute_fk", configurations=rows, all_solutions=True)
    for _ in range(100):
        n = len(heard)
        states.publish(state)
        client.wait(lambda n=n: len(heard) > n, "a pose")
    assert not running.done()
    assert "over budget" in client.await_result(running, "the rest").message


@mock.patch.dict(os.environ)
def test_a_signal_ends_the_node_within_two_seconds_whatever_runs(tmp_path):
    namespace = use_private_domain() + "_busy"
    file = CONFIG / "stewart_general.yaml"
    process = NodeProcess(NODE, tmp_path, namespace, model_file=str(file), request_time=600.0)
    client = Client("tester", namespace, [process])
    home = list(read_model(file).mechanism.home.joints)
    rows = configurations(np.tile(home, (5000, 1)))
    one = client.call(ComputeFK, f"{NODE}/compute_fk", configurations=rows[:1])
    assert not one.message
    client.ask(ComputeFK, f"{NODE}/compute_fk", configurations=rows, all_solutions=True)
    begin = time.monotonic()
    assert process.end(signal.SIGTERM) == 0
    assert time.monotonic() - begin < 2
    client.close()


# The links are described once the node has been asked to end, and ROS has shut down.
DESCRIBED_LATE = """
import gc, os, signal, time
import rclpy
from parallel_cal.nodes import model_server
describe = model_server.describe
def late(model):
    description = describe(model)
    while not gc.get_freeze_count():  # it is frozen before the node spins
        time.sleep(0.01)
    os.kill(os.getpid(), signal.SIGINT)
    while rclpy.ok():
        time.sleep(1e-4)
    return description
model_server.describe = late
"""


@mock.patch.dict(os.environ)
def test_a_node_that_ends_while_its_links_are_described_ends_quietly(tmp_path):
    given = {"model_file": str(IDENTIFIED), "before": DESCRIBED_LATE}
    process = NodeProcess(NODE, tmp_path, use_private_domain(), **given)
    assert process.ended() == 0
    assert process.end() == 0
