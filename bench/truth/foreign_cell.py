"""A hexapod, its controller and its tracker, as others would write them: numpy and rclpy only.

    python -m bench.truth.foreign_cell --ros-args -r __ns:=/foreign -p speed:=2.5

Nothing here comes from parallel_cal, so that a campaign at this cell meets foreign conventions. The
legs are not as drawn, two of them have backlash, and the tracker has a frame of its own and stamps
its poses late. Faults are parameters, and so is the file to which the truth is written at the end.
"""

import json
import threading
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

LEGS = [f"leg{i}" for i in range(1, 7)]
# The drawing: joints on two circles, legs of 250 mm with 0 to 200 mm of travel.
PLATFORM_DEG, PLATFORM_RADIUS = (-50, 50, 70, 170, 190, 290), 0.15
BASE_DEG, BASE_RADIUS = (-10, 10, 110, 130, 230, 250), 0.25
LEG_LENGTH, TRAVEL, HOME = 0.25, (0.0, 0.2), (0.0, 0.0, 0.3)
PLAY = {1: 90e-6, 4: 60e-6}  # m of backlash by leg, from 0
MANUFACTURING = 0.5e-3  # m, standard deviation of each coordinate of a joint
READING, SIGHT, ANGLE = 1e-6, 5e-6, 20e-6  # noise of joints (m) and tracker (m, rad)
JOINT_PERIOD, POSE_PERIOD = 0.01, 0.05  # s
STAMPED_LATE = 0.03  # s by which the tracker's stamps are late
MAX_STEP = 0.1  # s of the cell's time in one step: on a busy computer the cell runs slower
STOP_RATE = 1.0  # m/s^2 with which a blocked drive stops

PARAMETERS = {
    "seed": 0,  # of the legs and of all noise
    "speed": 1.0,  # of the cell's clock
    "best_effort": False,  # the tracker publishes best effort
    "slip_after": 0.0,  # s after which the target slips on the platform; 0: never
    "slip": 0.3e-3,  # m
    "stuck_leg": 0,  # number of the leg that sticks from stuck_after on; 0: none
    "stuck_after": 0.0,  # s
    "switch_leg": 0,  # number of the leg with a limit switch inside its range; 0: none
    "switch_at": 0.12,  # m at which the switch blocks it
    "truth": "",  # file for what is true and what was commanded
}


def on_circle(degrees, radius):
    angle = np.radians(degrees)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle])


def turned(w):
    """The rotation matrix (3, 3) of a rotation vector."""
    angle = float(np.linalg.norm(w))
    K = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    if angle < 1e-12:
        return np.eye(3) + K
    return np.eye(3) + np.sin(angle) / angle * K + (1 - np.cos(angle)) / angle**2 * K @ K


def quaternion(R):
    """x, y, z, w of a rotation by less than half a turn."""
    w = np.sqrt(max(1 + np.trace(R), 1e-12)) / 2
    axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / (4 * w)
    return [*axis, w]


class Hexapod:
    """The robot as it was built."""

    def __init__(self, rng):
        self.platform = on_circle(PLATFORM_DEG, PLATFORM_RADIUS)
        self.base = on_circle(BASE_DEG, BASE_RADIUS)
        self.zero = np.full(6, LEG_LENGTH)
        drawn = self.lengths(np.array(HOME), np.eye(3))
        self.home = drawn - LEG_LENGTH
        self.platform += MANUFACTURING * rng.standard_normal((6, 3))
        self.base += MANUFACTURING * rng.standard_normal((6, 3))
        self.zero += MANUFACTURING * rng.standard_normal(6)
        self._r, self._R = np.array(HOME), np.eye(3)

    def lengths(self, r, R):
        return np.linalg.norm(r + self.platform @ R.T - self.base, axis=1)

    def pose(self, q):
        """Position and rotation for the legs' extensions, by Newton from the last pose."""
        r, R = self._r, self._R
        for _ in range(50):
            arms = self.platform @ R.T
            legs = r + arms - self.base
            length = np.linalg.norm(legs, axis=1)
            left = self.zero + q - length
            unit = legs / length[:, None]
            step = np.linalg.solve(np.hstack([unit, np.cross(arms, unit)]), left)
            r, R = r + step[:3], turned(step[3:]) @ R
            if np.abs(step).max() < 1e-13:
                break
        self._r, self._R = r, R
        return r, R


class Drives:
    """Motors that follow trajectories, and the play between them and the legs."""

    def __init__(self, home):
        self.q, self.speed, self.legs = home.copy(), np.zeros(6), home.copy()
        self._points = []
        self._lock = threading.Lock()

    def follow(self, now, points):
        """Replace the motion by one through points (time, positions, velocities or None)."""
        with self._lock:
            start = (now, self.q.copy(), self.speed.copy())
            self._points = [start, *((now + t, q, v) for t, q, v in points)]

    def advance(self, now, stuck, blocked):
        """Move to a time; `stuck` motors stay, and `blocked` (6,) are the highest positions."""
        with self._lock:
            q, speed = self._wanted(now)
        q = np.minimum(np.where(stuck, self.q, q), blocked)
        self.q, self.speed = q, np.where(stuck | (q >= blocked), 0.0, speed)
        play = np.array([PLAY.get(i, 0.0) for i in range(6)]) / 2
        self.legs = np.clip(self.legs, q - play, q + play)

    def _wanted(self, now):
        points = self._points
        while len(points) > 1 and points[1][0] <= now:
            points.pop(0)
        if not points:
            return self.q, np.zeros(6)
        begin, q0, v0 = points[0]
        if len(points) == 1:
            return q0, np.zeros(6)
        end, q1, v1 = points[1]
        T, s = end - begin, (now - begin) / (end - begin)
        if v1 is None:
            return q0 + s * (q1 - q0), (q1 - q0) / T
        a, b = 3 * (q1 - q0) - T * (2 * v0 + v1), 2 * (q0 - q1) + T * (v0 + v1)
        return q0 + s * (T * v0 + s * (a + s * b)), v0 + s * (2 * a + 3 * s * b) / T


class ForeignCell(Node):
    def __init__(self):
        super().__init__("foreign_cell")
        for name, value in PARAMETERS.items():
            self.declare_parameter(name, value)
        self.set = {name: self.get_parameter(name).value for name in PARAMETERS}
        self.rng = np.random.default_rng(self.set["seed"])
        self.robot = Hexapod(self.rng)
        self.drives = Drives(self.robot.home)
        self.frame = (self.rng.uniform(-2.0, 2.0, 3), turned(self.rng.uniform(-0.8, 0.8, 3)))
        self.outside = self.fastest = self.silence = 0.0
        self.trajectories = self.poses = 0
        self.now, self.begin = 0.0, time.time()
        deep = QoSProfile(depth=1000)
        how = ReliabilityPolicy.BEST_EFFORT if self.set["best_effort"] else deep.reliability
        self.states = self.create_publisher(JointState, "joint_states", deep)
        self.seen = self.create_publisher(
            PoseWithCovarianceStamped, "measured_pose", QoSProfile(depth=1000, reliability=how)
        )
        self.create_subscription(JointTrajectory, "joint_trajectory", self.command, 10)

    def command(self, message):
        order = [message.joint_names.index(leg) for leg in LEGS]
        points = []
        for point in message.points:
            t = point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec
            q = np.array(point.positions)[order]
            v = np.array(point.velocities)[order] if len(point.velocities) else None
            out = max(float(np.max(TRAVEL[0] - q)), float(np.max(q - TRAVEL[1])))
            self.outside = max(self.outside, out)
            points.append((t, q, v))
        self.trajectories += 1
        self.drives.follow(self.now, points)

    def run(self):
        """Let the cell's time pass until the node ends."""
        last, read, looked = time.monotonic(), 0.0, 0.0
        stuck, blocked = np.zeros(6, dtype=bool), np.full(6, np.inf)
        if self.set["switch_leg"]:
            blocked[self.set["switch_leg"] - 1] = self.set["switch_at"]
        while rclpy.ok():
            time.sleep(JOINT_PERIOD / self.set["speed"] / 2)
            moment = time.monotonic()
            self.silence = max(self.silence, moment - last)
            until = self.now + min(self.set["speed"] * (moment - last), MAX_STEP)
            last = moment
            while read + JOINT_PERIOD <= until:
                read += JOINT_PERIOD
                self.now = read
                if self.set["stuck_leg"] and self.now > self.set["stuck_after"]:
                    stuck[self.set["stuck_leg"] - 1] = True
                self.drives.advance(self.now, stuck, blocked)
                self.fastest = max(self.fastest, float(np.abs(self.drives.speed).max()))
                self.read_joints()
                if read >= looked + POSE_PERIOD - 1e-9:
                    looked = read
                    self.look()
            self.now = until

    def stamp(self, message, seconds):
        nanoseconds = round(1e9 * (self.begin + seconds))
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(nanoseconds, 10**9)

    def read_joints(self):
        q = self.drives.q + READING * self.rng.standard_normal(6)
        message = JointState(name=LEGS, position=q.tolist(), velocity=self.drives.speed.tolist())
        self.stamp(message, self.now)
        self.states.publish(message)

    def look(self):
        r, R = self.robot.pose(self.drives.legs)
        if 0 < self.set["slip_after"] < self.now:
            r = r + R @ np.array([self.set["slip"], 0.0, 0.0])
        shift, turn = self.frame
        r = shift + turn @ r + SIGHT * self.rng.standard_normal(3)
        R = turned(ANGLE * self.rng.standard_normal(3)) @ turn @ R
        message = PoseWithCovarianceStamped()
        message.header.frame_id = "tracker"
        self.stamp(message, self.now + STAMPED_LATE)
        p, o = message.pose.pose.position, message.pose.pose.orientation
        p.x, p.y, p.z = map(float, r)
        o.x, o.y, o.z, o.w = map(float, quaternion(R))
        message.pose.covariance = np.diag([SIGHT**2] * 3 + [ANGLE**2] * 3).ravel().tolist()
        self.seen.publish(message)
        self.poses += 1

    def tell(self):
        """Write what is true and what happened."""
        if not self.set["truth"]:
            return
        robot = self.robot
        told = {
            "platform": robot.platform.tolist(),
            "base": robot.base.tolist(),
            "zero": robot.zero.tolist(),
            "play": [PLAY.get(i, 0.0) for i in range(6)],
            "seconds": self.now,
            "poses": self.poses,
            "trajectories": self.trajectories,
            "outside_limits": self.outside,
            "fastest": self.fastest,
            "silence": self.silence,
        }
        Path(self.set["truth"]).write_text(json.dumps(told))


def main():
    rclpy.init()
    cell = ForeignCell()
    spinning = threading.Thread(target=cell.run, daemon=True)
    spinning.start()
    try:
        with suppress(KeyboardInterrupt, ExternalShutdownException):
            rclpy.spin(cell)
        rclpy.try_shutdown()
        spinning.join()
    finally:  # Python may raise a KeyboardInterrupt after rclpy has ended the spinning
        cell.tell()


if __name__ == "__main__":
    main()
