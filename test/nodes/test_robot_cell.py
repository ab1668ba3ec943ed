"""The robot of a campaign waits for its device: what that costs, and when the target is lost."""

# ruff: noqa: E402 - what needs ROS is imported after the check that it is there

import os
import time
from contextlib import contextmanager
from threading import Event, Thread
from unittest import mock

import numpy as np
import pytest

pytestmark = pytest.mark.ros
rclpy = pytest.importorskip("rclpy")
pytest.importorskip("parallel_cal_msgs")

from builtin_interfaces.msg import Time
from campaign_cells import model_of
from geometry_msgs.msg import PoseWithCovarianceStamped
from parallel_cal_msgs.action import Calibrate
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState

from parallel_cal.base.errors import DatasetError
from parallel_cal.campaign.cell import CellError, Sample, UnansweredError, UnseenError
from parallel_cal.campaign.trajectory import Trajectory, plan_trajectory
from parallel_cal.model.file.modelfile import write_model
from parallel_cal.nodes import robot_cell
from parallel_cal.nodes.calibration_node import CalibrationNode
from parallel_cal.nodes.client import use_private_domain
from parallel_cal.nodes.collector import Collector
from parallel_cal.nodes.conversions import STOPPING_TIME_S
from parallel_cal.nodes.inbox import Snapshot
from parallel_cal.nodes.inflow import Inflow
from parallel_cal.nodes.robot_cell import RobotCell
from parallel_cal.nodes.run import FrontExecutor

MODEL = model_of("delta")
HOME = list(MODEL.mechanism.home.joints)
LONGEST = 1.0  # s, in place of 20
QOS = QoSProfile(depth=10_000)


class Reader:
    """Reads all that came in at once, until it falls behind."""

    behind_since = None

    @property
    def read_until(self):
        return time.monotonic() if self.behind_since is None else self.behind_since


class Desk:
    """A RobotCell beside a robot that rests, with a device that is played by the test."""

    def __init__(self, take):
        self.inflow, self.reader, self.said = Inflow(), Reader(), []
        self.inflow.add_reader(self.reader)
        self.taken, self._take = 0, take
        self.cell = RobotCell(mock.Mock(), MODEL, self.taking, 0.1, self.inflow, self.said.append)
        self.script, self.begun = [], time.monotonic()

    def taking(self, meanwhile):
        self.taken += 1
        return self._take()

    def measure(self, poses=1):
        for _ in range(poses):
            self.inflow.receive("measured_pose", time.time_ns())

    def go_on(self):
        """Hear of the robot, and do what the script has for this moment."""
        state = JointState(name=list(MODEL.joints), position=HOME)
        now = time.monotonic() - self.begun
        state.header.stamp = Time(sec=100 + int(now), nanosec=int(1e9 * (now % 1)))
        self.cell.on_joint_state(state)
        while self.script and now > self.script[0][0]:
            self.script.pop(0)[1]()


@pytest.fixture(autouse=True)
def soon(monkeypatch):
    monkeypatch.setattr(robot_cell, "SAMPLE_TIMEOUT_S", LONGEST)
    monkeypatch.setattr(robot_cell, "REPORT_INTERVAL_S", 0.1)
    monkeypatch.setattr(robot_cell, "MAX_SILENCE_MOVING_S", 30.0)  # this machine may be busy


def a_sample():
    return Sample(mock.Mock(time=np.array([1.0]), duration=np.array([0.2])), 10**9)


def no_dwell():
    raise DatasetError("no dwell to take")


@pytest.mark.wide
def test_a_silent_device_is_noticed_before_any_sample():
    desk = Desk(no_dwell)
    with pytest.raises(
        CellError, match=r"no pose was received while the robot rested\. Check that the device"
    ):
        desk.cell.sample(desk.go_on)
    assert desk.taken == 0


def test_a_target_is_left_soon_where_the_images_show_too_little():
    desk = Desk(no_dwell)
    why = "camera: image not used: too few corners"
    desk.script = [(0.0, lambda: desk.inflow.note_unusable(time.time_ns(), why))]
    with pytest.raises(UnseenError, match=why):
        desk.cell.sample(desk.go_on)
    assert desk.taken == 0


@pytest.mark.wide
def test_a_device_that_streams_no_usable_pose_is_noticed_by_few_samples_taken():
    desk = Desk(lambda: time.sleep(0.05) or no_dwell())
    looks = []

    def go_on():
        looks.append(time.monotonic())
        desk.measure()
        desk.inflow.process("measured_pose")
        desk.go_on()

    with pytest.raises(
        CellError, match=r"no dwell to take\. Check that the device sees its target"
    ):
        desk.cell.sample(go_on)
    assert len(looks) > desk.taken
    assert desk.taken <= 1 + (LONGEST + 0.3) / (0.05 / robot_cell.MAX_TAKING)


@pytest.mark.wide
def test_poses_that_came_in_and_are_not_read_yet_are_awaited_and_not_called_lost():
    desk = Desk(a_sample)
    desk.reader.behind_since = time.monotonic()
    desk.measure(1376)
    late = 3 * LONGEST
    desk.script = [(late, lambda: setattr(desk.reader, "behind_since", None))]
    assert desk.cell.sample(desk.go_on).start_ns == 10**9
    assert desk.reader.behind_since is None
    assert "1376 poses are not processed yet, others are not read yet" in desk.said
    assert desk.taken == 1


@pytest.mark.wide
def test_a_device_that_measures_once_in_a_while_is_awaited_pose_by_pose():
    """The first pose falls where the robot still settles, the second one counts."""
    answers = iter([no_dwell, a_sample])
    desk = Desk(lambda: next(answers)())
    measured = []

    def go_on():
        desk.go_on()
        if len(measured) == desk.taken:
            measured.append(desk.measure())

    assert desk.cell.sample(go_on).start_ns == 10**9
    assert len(measured) == desk.taken == 2


def drive(cell, trajectory, clock_rate):
    """Let the robot follow a trajectory on a clock of its own, which runs at a rate to this one."""
    begun, start = time.monotonic(), np.array(HOME)
    times = np.concatenate([[0.0], trajectory.time])
    path = np.vstack([start, trajectory.positions])

    def hear():
        elapsed = clock_rate * (time.monotonic() - begun)
        q = [float(np.interp(elapsed, times, column)) for column in path.T]
        state = JointState(name=list(MODEL.joints), position=q)
        stamp = 100 + elapsed
        state.header.stamp = Time(sec=int(stamp), nanosec=int(1e9 * (stamp % 1)))
        cell.on_joint_state(state)

    hear()
    cell.move(trajectory, hear)


def a_motion():
    return plan_trajectory([np.array(HOME), np.array(HOME) + 0.05], MODEL.mechanism)


def test_a_motion_takes_as_long_as_on_the_robots_own_clock(monkeypatch):
    """At a tenth of the speed, the limit of the time of this computer was exceeded."""
    monkeypatch.setattr(robot_cell, "ARRIVAL_TIMEOUT_S", 0.4)
    desk, motion = Desk(no_dwell), a_motion()
    begun = time.monotonic()
    drive(desk.cell, motion, 0.2)
    assert time.monotonic() - begun > motion.seconds + 0.4


class Losing:
    """A controller's action that loses its first goals, which are given up after a while."""

    def __init__(self, losses, patience):
        self.losses, self.patience, self.sent = losses, patience, []

    def require_controller(self):
        pass

    def send(self, trajectory):
        self.sent.append(time.monotonic())

    def is_answered(self):
        return len(self.sent) > self.losses

    def has_ended(self):
        if not self.is_answered() and time.monotonic() > self.sent[-1] + self.patience:
            raise UnansweredError("no answer to the goal for 10 s")
        return self.is_answered()


class Obeying(Desk):
    """A desk whose robot follows the motions of a controller that loses the first of them."""

    def __init__(self, motion, losses, starts_at_loss=False):
        super().__init__(no_dwell)
        self.cell._motion = self.motion = Losing(losses, motion.seconds + 1.0)
        self.path = np.vstack([HOME, motion.positions])
        self.times, self.starts_at_loss = np.append(0.0, motion.time), starts_at_loss
        self.go_on()

    def go_on(self):
        sent, begun = self.motion.sent, 1 if self.starts_at_loss else self.motion.losses + 1
        elapsed = time.monotonic() - sent[begun - 1] if len(sent) >= begun else 0.0
        q = [float(np.interp(elapsed, self.times, column)) for column in self.path.T]
        state, now = JointState(name=list(MODEL.joints), position=q), time.monotonic() - self.begun
        state.header.stamp = Time(sec=100 + int(now), nanosec=int(1e9 * (now % 1)))
        self.cell.on_joint_state(state)


@pytest.mark.wide
def test_a_motion_that_the_controller_does_not_answer_is_sent_again(monkeypatch):
    monkeypatch.setattr(robot_cell, "ARRIVAL_TIMEOUT_S", 0.5)  # counts from the answer on
    motion = a_motion()
    desk = Obeying(motion, losses=2)
    desk.cell.move(motion, desk.go_on)
    assert len(desk.motion.sent) == 3
    np.testing.assert_allclose(desk.cell.joints(), motion.positions[-1])
    assert desk.said == ["no answer to the goal for 10 s; sending the motion again"] * 2


@pytest.mark.wide
def test_a_controller_that_answers_no_motion_ends_the_campaign():
    motion = a_motion()
    desk = Obeying(motion, losses=3)
    with pytest.raises(CellError, match=r"^the motion was sent 3 times: no answer to the goal"):
        desk.cell.move(motion, desk.go_on)
    assert len(desk.motion.sent) == 3


@pytest.mark.wide
def test_a_motion_is_not_sent_again_to_a_robot_that_has_left_its_start():
    motion = a_motion()
    desk = Obeying(motion, losses=1, starts_at_loss=True)
    with pytest.raises(UnansweredError):
        desk.cell.move(motion, desk.go_on)
    assert len(desk.motion.sent) == 1


def test_joint_states_that_are_not_read_yet_are_not_missing(monkeypatch):
    monkeypatch.setattr(robot_cell, "MAX_SILENCE_RESTING_S", 0.05)
    desk = Desk(no_dwell)
    desk.inflow.joint_reader = reader = Reader()
    desk.go_on()
    reader.behind_since = time.monotonic()
    time.sleep(0.1)
    assert desk.cell.joints() == pytest.approx(HOME)
    reader.behind_since = None  # all is read, and there was none
    with pytest.raises(CellError, match="no joint states were received"):
        desk.cell.joints()


def test_joint_states_that_nobody_reads_any_more_are_missing_after_all(monkeypatch):
    monkeypatch.setattr(robot_cell, "MAX_SILENCE_RESTING_S", 0.05)
    monkeypatch.setattr(robot_cell, "MAX_STANDSTILL_S", 0.1)
    desk = Desk(no_dwell)
    desk.inflow.joint_reader = Reader()
    desk.go_on()
    desk.inflow.joint_reader.behind_since = time.monotonic()
    time.sleep(0.2)
    with pytest.raises(CellError, match="no joint states were received"):
        desk.cell.joints()


class Pausing:
    """A robot that follows a trajectory on this computer's clock; its driver is silent at times."""

    def __init__(self, cell, silences):
        self.cell, self.silences, self.begun, self.path = cell, silences, time.monotonic(), None

    def follow(self, trajectory):
        self.path = np.vstack([HOME, trajectory.positions])
        self.times, self.begun = np.append(0.0, trajectory.time), time.monotonic()

    def q(self):
        elapsed = time.monotonic() - self.begun
        return np.array([np.interp(elapsed, self.times, column) for column in self.path.T])

    def go_on(self):
        elapsed = time.monotonic() - self.begun
        if any(begin < elapsed < end for begin, end in self.silences):
            return
        state = JointState(name=list(MODEL.joints), position=self.q().tolist())
        state.header.stamp = Time(sec=100 + int(elapsed), nanosec=int(1e9 * (elapsed % 1)))
        self.cell.on_joint_state(state)


def pausing(trajectory, *silences):
    desk = Desk(no_dwell)
    robot = Pausing(desk.cell, silences)
    robot.follow(trajectory)
    robot.silences = ()
    robot.go_on()  # where it is at the start is known
    robot.silences = silences
    return desk, robot


@pytest.mark.wide
def test_a_driver_that_is_silent_at_rest_is_awaited_and_said_so(monkeypatch):
    monkeypatch.setattr(robot_cell, "MAX_SILENCE_MOVING_S", 0.2)
    monkeypatch.setattr(robot_cell, "FRESH_S", 0.3)
    motion = a_motion()
    end = motion.seconds + 0.05
    desk, robot = pausing(motion, (end, end + 1.5))
    desk.cell.move(motion, robot.go_on)
    assert time.monotonic() - robot.begun > end + 1.5
    assert any(words.startswith("no joint states for ") for words in desk.said)
    np.testing.assert_allclose(desk.cell.joints(), motion.positions[-1])


@pytest.mark.wide
def test_a_driver_that_is_silent_for_too_long_at_rest_is_told_that_it_must_publish(monkeypatch):
    monkeypatch.setattr(robot_cell, "MAX_SILENCE_RESTING_S", 1.0)
    motion = a_motion()
    desk, robot = pausing(motion, (motion.seconds, np.inf))
    with pytest.raises(CellError, match=r"for 1 s: .*must publish them also while the robot rests"):
        desk.cell.move(motion, robot.go_on)


def test_a_driver_that_is_silent_while_the_robot_moves_ends_the_motion(monkeypatch):
    monkeypatch.setattr(robot_cell, "MAX_SILENCE_MOVING_S", 0.1)
    motion = plan_trajectory([np.array(HOME), np.array(HOME) + 0.3], MODEL.mechanism)
    motion = Trajectory(100 * motion.time, motion.positions, motion.velocities / 100)
    desk, robot = pausing(motion, (0.1, np.inf))
    with pytest.raises(CellError, match="no joint states were received for 0 s"):
        desk.cell.move(motion, robot.go_on)
    assert time.monotonic() - robot.begun < motion.seconds / 2


def test_no_motion_begins_before_the_driver_tells_where_the_robot_is(monkeypatch):
    monkeypatch.setattr(robot_cell, "FRESH_S", 0.1)
    rest = Trajectory(np.array([1.0]), np.array([HOME]), np.zeros((1, 3)))
    desk, robot = pausing(rest, (0.0, 0.5))

    class Sent(Exception):
        pass

    desk.cell._motion.send.side_effect = Sent
    time.sleep(0.2)
    with pytest.raises(Sent):
        desk.cell.move(rest, robot.go_on)
    assert time.monotonic() - robot.begun > 0.5


def test_a_robot_that_was_moved_while_its_driver_was_silent_is_not_sent_on(monkeypatch):
    monkeypatch.setattr(robot_cell, "FRESH_S", 0.1)
    drift = Trajectory(np.array([1.0]), np.array([HOME]) + [[0, 0.1, 0]], np.zeros((1, 3)))
    desk, robot = pausing(drift, (0.0, 0.5))
    time.sleep(0.2)
    with pytest.raises(CellError, match=r"^joint2 moved while the driver was silent"):
        desk.cell.move(drift, robot.go_on)
    desk.cell._motion.send.assert_not_called()


@pytest.mark.parametrize("silence", [0.0, 0.4])
def test_a_stop_is_where_the_robot_is_and_not_where_it_was_last_seen(silence):
    """A stop used to lead back over the way since the last joint state, in 50 ms."""
    motion = plan_trajectory([np.array(HOME), np.array(HOME) + 0.5], MODEL.mechanism)
    slow = Trajectory(10 * motion.time, motion.positions, motion.velocities / 10)
    middle = slow.seconds / 2
    desk, robot = pausing(slow, (middle, np.inf))

    class Enough(Exception):
        pass

    def go_on():
        robot.go_on()
        if time.monotonic() - robot.begun > middle + silence:
            raise Enough

    with pytest.raises(Enough):
        desk.cell.move(slow, go_on)
    q, speed = robot.q(), np.gradient(slow.positions[:, 0], slow.time)[len(slow.time) // 2]
    point = desk.cell._make_halt().points[0]
    ahead = np.array(point.positions) - q
    assert (np.abs(ahead - speed * STOPPING_TIME_S / 2) < 0.05 * abs(speed)).all()


def test_stamps_that_stand_still_are_named(monkeypatch):
    monkeypatch.setattr(robot_cell, "MAX_STANDSTILL_S", 0.2)
    desk = Desk(no_dwell)
    words = "joint states are received, but their stamp has been 100.000 s for"
    with pytest.raises(CellError, match=words):
        drive(desk.cell, a_motion(), 0.0)


@pytest.mark.wide
def test_a_target_is_not_lost_before_the_robot_has_rested_long_enough_on_its_own_clock():
    """The simulated second takes four."""
    desk = Desk(no_dwell)
    real = desk.go_on

    def slowly():
        begun = desk.begun
        desk.begun = begun + 0.75 * (time.monotonic() - begun)
        real()
        desk.begun = begun

    slowly()
    begun = time.monotonic()
    with pytest.raises(CellError, match="no sample at this pose"):
        desk.cell.sample(slowly)
    assert time.monotonic() - begun > 3.0 * LONGEST


@pytest.mark.wide
def test_a_sample_can_be_cancelled_while_it_is_taken():
    """The thread that makes samples of messages is busy."""

    class Enough(Exception):
        pass

    def go_on():
        desk.go_on()
        if desk.taken:
            raise Enough

    desk = Desk(a_sample)
    desk.taking_waits = desk.cell._take
    desk.cell._take = lambda meanwhile: (desk.taking_waits(meanwhile), meanwhile())[0]
    desk.measure()
    with pytest.raises(Enough):
        desk.cell.sample(go_on)


# ------------------------------------------------------------------ in the node


class Played:
    """calibration_node in this process, beside a robot at rest; `poses` plays its device."""

    def __init__(self, folder):
        write_model(MODEL, folder / "robot.yaml")
        given = {
            "model_file": folder / "robot.yaml",
            "journal_folder": folder,
            "look_period": 3600.0,
        }
        parameters = [part for k, v in given.items() for part in ("-p", f"{k}:={v}")]
        rclpy.init(args=["--ros-args", "-r", f"__ns:={use_private_domain()}", *parameters])
        self.node, self.executor = CalibrationNode(), FrontExecutor()
        self.executor.add_node(self.node)
        self.device = rclpy.create_node("device")
        self.states = self.device.create_publisher(JointState, "joint_states", QOS)
        self.poses = self.device.create_publisher(PoseWithCovarianceStamped, "measured_pose", QOS)
        self.ended, self.measuring = Event(), Event()
        self.threads = [Thread(target=self.spin), Thread(target=self.play)]
        for thread in self.threads:
            thread.start()

    def spin(self):
        while not self.ended.is_set():
            self.executor.spin_once(timeout_sec=0.05)

    def play(self):
        rng = np.random.default_rng(3)
        while not self.ended.wait(0.01):
            now = self.device.get_clock().now().to_msg()
            q = np.array(HOME) + 1e-6 * rng.standard_normal(3)
            state = JointState(name=list(MODEL.joints), position=q.tolist())
            pose = PoseWithCovarianceStamped()
            state.header.stamp = pose.header.stamp = now
            pose.header.frame_id = "base"
            x, y, z = np.array([0.0, 0.0, 0.2]) + 1e-6 * rng.standard_normal(3)
            pose.pose.pose.position.x, pose.pose.pose.position.y = float(x), float(y)
            pose.pose.pose.position.z, pose.pose.pose.orientation.w = float(z), 1.0
            self.states.publish(state)
            if self.measuring.is_set():
                self.poses.publish(pose)

    def cell(self):
        campaigning = self.node._campaigning
        campaigning._prepare(Calibrate.Goal())
        end = time.monotonic() + 30
        while not campaigning._cell._states:
            assert time.monotonic() < end, "no joint states"
            time.sleep(0.01)
        return campaigning._cell

    def close(self):
        self.ended.set()
        for thread in self.threads:
            thread.join()
        self.node.end_work()
        self.executor.finish()
        self.node.destroy_node()
        self.device.destroy_node()
        rclpy.try_shutdown()


@contextmanager
def played(folder):
    with mock.patch.dict(os.environ):
        one = Played(folder)
        try:
            yield one
        finally:
            one.close()


@pytest.mark.wide
def test_waiting_for_a_pose_does_not_process_all_samples_again(tmp_path, monkeypatch):
    """It used to be ten times a second, and took longer with every sample."""
    made = []
    take = Collector.take_snapshots
    monkeypatch.setattr(Collector, "take_snapshots", lambda *given: made.append(1) or take(*given))
    with played(tmp_path) as desk:
        cell = desk.cell()
        made.clear()
        with pytest.raises(CellError, match="Check that the device sees its target"):
            cell.sample(lambda: None)
        assert made == []
        desk.measuring.set()
        monkeypatch.setattr(robot_cell, "SAMPLE_TIMEOUT_S", 20.0)
        sample = cell.sample(lambda: None)
    assert len(sample.dataset) == 1
    np.testing.assert_allclose(sample.dataset.r[0], [0.0, 0.0, 0.2], atol=1e-5)


@pytest.mark.wide
def test_a_node_that_is_busy_for_longer_than_a_sample_may_take_has_not_lost_the_target(
    tmp_path, monkeypatch
):
    """Poses come all the while; what makes samples of them does not get to it."""
    with played(tmp_path) as desk:
        cell, said, busy = desk.cell(), [], Event()
        cell._say = said.append
        desk.executor.create_task(lambda: busy.set() or time.sleep(3 * LONGEST))
        assert busy.wait(10)
        desk.measuring.set()
        sample = cell.sample(lambda: None)
    assert len(sample.dataset) == 1
    assert said
    assert all(" poses are not processed yet" in reason for reason in said)
    assert max(int(reason.split()[0]) for reason in said) > 10


@pytest.mark.wide
def test_the_node_answers_while_the_samples_of_a_campaign_are_made(tmp_path, monkeypatch):
    """Making them took up to seconds, in the thread that spins."""
    make_samples = Snapshot.make_samples
    monkeypatch.setattr(
        Snapshot, "make_samples", lambda one: time.sleep(3 * LONGEST) or make_samples(one)
    )
    waits, asked = [], []

    def ask(node):
        """Let the node call a function, and measure how long that takes."""
        if len(asked) == len(waits):
            begin = time.monotonic()
            asked.append(begin)
            node.create_task(lambda: waits.append(time.monotonic() - begin))

    with played(tmp_path) as desk:
        cell = desk.cell()
        desk.measuring.set()
        begin = time.monotonic()
        sample = cell.sample(lambda: ask(desk.executor))
        seconds = time.monotonic() - begin
    assert len(sample.dataset) == 1
    assert seconds > 3 * LONGEST
    assert len(waits) > 5
    assert max(waits) < LONGEST


def test_a_joint_that_leaves_its_path_ends_the_motion_by_name():
    """The others are where they should be; at the end of the motion it would be too late."""
    motion = a_motion()
    desk = Obeying(motion, losses=0)
    desk.path[:, 1] -= 20 * (desk.path[:, 1] - HOME[1])
    with pytest.raises(CellError, match=r"^joint2 left its path \(at .* rad\): the joint does not"):
        desk.cell.move(motion, desk.go_on)
