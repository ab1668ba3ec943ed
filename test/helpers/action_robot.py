"""A Delta with its drives, a tracker, and a controller that has the action FollowJointTrajectory.

All of it keeps one clock, which runs slower on a busy computer. The controller judges as
joint_trajectory_controller does: a joint too far from its path, or from its goal when it should be
there, ends the goal with the code of the action. A goal replaces the one before it.

    python test/helpers/action_robot.py NAMESPACE RATE    # runs until it is killed
"""

import sys
import time
from contextlib import suppress
from threading import Event, Lock, Thread

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from control_msgs.action import FollowJointTrajectory
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.exceptions import InvalidHandle
from rclpy.executors import MultiThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState

from parallel_cal.virtual.machines import MACHINES

NAME = "arm_controller/follow_joint_trajectory"
JOINTS = ["joint1", "joint2", "joint3"]
HOME = np.array([0.0, 0.0, 0.2])  # m
PATH_TOLERANCE, GOAL_TOLERANCE, GOAL_TIME = 0.02, 0.01, 0.5  # rad, rad, s
STEP, POSE_PERIOD = 0.02, 0.05  # s on the robot's clock
READING, SIGHT, TURN = 1e-6, 5e-6, 20e-6  # noise: rad, m, rad
Result = FollowJointTrajectory.Result


class Goal:
    """A trajectory that is followed from where the robot is, until something ends it."""

    def __init__(self, trajectory, clock, q, speed):
        self.begin, self.done, self.cancelled = clock, Event(), False
        self.code, self.text, self.status = Result.SUCCESSFUL, "", "aborted"
        order = [list(trajectory.joint_names).index(joint) for joint in JOINTS]
        starts = [p.time_from_start for p in trajectory.points]
        self.ends = np.array([start.sec + 1e-9 * start.nanosec for start in starts])
        q1 = np.array([p.positions for p in trajectory.points])[:, order]
        v1 = np.array([p.velocities for p in trajectory.points])[:, order]
        if self.ends[0] > 0:
            self.ends = np.append(0.0, self.ends)
            q1, v1 = np.vstack([q, q1]), np.vstack([speed, v1])
        self._path = CubicHermiteSpline(self.ends, q1, v1)

    def desired(self, clock):
        elapsed = min(clock - self.begin, self.ends[-1])
        moves = clock - self.begin < self.ends[-1]
        return self._path(elapsed), self._path(elapsed, 1) * moves

    def end(self, status, code=Result.SUCCESSFUL, text=""):
        self.status, self.code, self.text = status, code, text
        self.done.set()


class ActionRobot:
    """Faults are attributes: `stuck` is the number of a joint that does not move, `lag` (rad) how
    far the joints stay behind, `accepts` and `obeys` whether goals and cancels are accepted. Goals
    are answered while `answers` is set, followed and reported while `reports` is set. The next
    `losses` goals are not answered until the robot is repaired.

    `goals` are the trajectories so far, `rate` is how fast its clock is.
    """

    def __init__(self, namespace, rate=2.0):
        self.goals, self.rate = [], rate
        self.answers, self.reports, self.losses, self._found = Event(), Event(), 0, Event()
        self.repair()
        self._body = MACHINES["delta"].make_nominal()
        self._q, self._speed = self._body.inverse(HOME[None])[0][0], np.zeros(3)
        self._clock, self._active, self._lock = 100.0, None, Lock()
        self._rng, self._stop = np.random.default_rng(5), Event()
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self._node = rclpy.create_node("arm", namespace=namespace, context=self._context)
        self._states = self._node.create_publisher(JointState, "joint_states", 100)
        self._poses = self._node.create_publisher(PoseWithCovarianceStamped, "measured_pose", 100)
        self.serve()
        self._executor = MultiThreadedExecutor(6, context=self._context)
        self._executor.add_node(self._node)
        self._threads = [Thread(target=self._spin), Thread(target=self._live)]
        for thread in self._threads:
            thread.start()

    def repair(self):
        """Set all attributes as they are without a fault."""
        self.stuck, self.lag, self.accepts, self.obeys = 0, 0.0, True, True
        for event in (self.answers, self.reports, self._found):
            event.set()

    def lose(self, n):
        """Lose the next n goals."""
        self.losses, self._found = n, Event()

    def serve(self):
        """Provide the action, again after its `server` was destroyed."""
        self.server = ActionServer(
            self._node,
            FollowJointTrajectory,
            NAME,
            self._execute,
            goal_callback=self._judge,
            cancel_callback=lambda goal: (CancelResponse.REJECT, CancelResponse.ACCEPT)[self.obeys],
            callback_group=ReentrantCallbackGroup(),
        )

    def close(self):
        self.repair()
        self._stop.set()
        if self._active:
            self._active.done.set()
        for thread in self._threads:
            thread.join()
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def _spin(self):
        # Raised if the server is destroyed while one of its requests is taken.
        destroyed = InvalidHandle, rclpy_implementation.RCLError
        while not self._stop.is_set():
            with suppress(*destroyed):
                self._executor.spin_once(timeout_sec=0.05)

    def _judge(self, goal):
        self.answers.wait()
        if self.losses:
            self.losses -= 1
            self._found.wait()
            return GoalResponse.REJECT
        return (GoalResponse.REJECT, GoalResponse.ACCEPT)[self.accepts]

    def _execute(self, handle):
        trajectory = handle.request.trajectory
        with self._lock:
            goal = Goal(trajectory, self._clock, self._q, self._speed)
            before, self._active = self._active, goal
            if before:
                before.end("aborted", text="another goal takes its place")
            self.goals.append(trajectory)
        while not goal.done.wait(0.02):
            goal.cancelled = goal.cancelled or handle.is_cancel_requested
            with self._lock:
                want, _ = goal.desired(self._clock)
                feedback = FollowJointTrajectory.Feedback(joint_names=JOINTS)
                feedback.desired.positions, feedback.actual.positions = list(want), list(self._q)
                feedback.error.positions = list(want - self._q)
            if self.reports.is_set():
                handle.publish_feedback(feedback)
        self.reports.wait()
        getattr(handle, {"aborted": "abort"}.get(goal.status, goal.status))()
        return Result(error_code=goal.code, error_string=goal.text)

    # ------------------------------------------------------------------ the robot

    def _live(self):
        last, posed = time.monotonic(), 0.0
        while not self._stop.wait(STEP / self.rate / 2):
            now = time.monotonic()
            if self.rate * (now - last) < STEP:
                continue
            last = now  # one step however long it took: a slow computer slows the robot
            with self._lock:
                self._clock += STEP
                self._advance()
            self._publish_joints()
            if self._clock - posed >= POSE_PERIOD:
                posed = self._clock
                self._publish_pose()

    def _advance(self):
        goal = self._active
        if goal is None:
            self._speed = np.zeros(3)
            return
        want, self._speed = goal.desired(self._clock)
        free = np.arange(1, 4) != self.stuck
        self._q = np.where(free, want - self.lag, self._q)
        off = want - self._q
        worst = int(np.argmax(np.abs(off)))
        text = f"{JOINTS[worst]} is off by {off[worst]:.3f}"
        late = self._clock - goal.begin - goal.ends[-1]
        if goal.cancelled:
            goal.end("canceled")
        elif late < 0 and abs(off[worst]) > PATH_TOLERANCE:
            goal.end("aborted", Result.PATH_TOLERANCE_VIOLATED, text)
        elif late >= 0 and abs(off[worst]) < GOAL_TOLERANCE:
            goal.end("succeed")
        elif late > GOAL_TIME:
            goal.end("aborted", Result.GOAL_TOLERANCE_VIOLATED, text)
        if goal.done.is_set():
            self._active, self._speed = None, np.zeros(3)

    def _stamp(self):
        return Time(sec=int(self._clock), nanosec=int(1e9 * (self._clock % 1)))

    def _publish_joints(self):
        q = self._q + READING * self._rng.standard_normal(3)
        state = JointState(name=JOINTS, position=q.tolist(), velocity=self._speed.tolist())
        state.header.stamp = self._stamp()
        self._states.publish(state)

    def _publish_pose(self):
        message, (r, R) = PoseWithCovarianceStamped(), self._body.forward(self._q[None])
        turn = R[0] @ Rotation.from_rotvec(TURN * self._rng.standard_normal(3)).as_matrix()
        r, turn = r[0] + SIGHT * self._rng.standard_normal(3), Rotation.from_matrix(turn).as_quat()
        message.header.stamp, message.header.frame_id = self._stamp(), "base"
        at = message.pose.pose
        at.position.x, at.position.y, at.position.z = map(float, r)
        at.orientation.x, at.orientation.y, at.orientation.z, at.orientation.w = map(float, turn)
        message.pose.covariance = np.diag([SIGHT**2] * 3 + [TURN**2] * 3).ravel()
        self._poses.publish(message)


if __name__ == "__main__":
    ActionRobot(sys.argv[1], float(sys.argv[2]))
    Event().wait()
