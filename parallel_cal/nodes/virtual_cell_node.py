"""A simulated robot with controller and tracker, to try nodes and programs and to practise."""

from __future__ import annotations

import math
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import InertiaStamped, PoseWithCovarianceStamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState, Temperature
from trajectory_msgs.msg import JointTrajectory

from parallel_cal.base.errors import ParallelCalError, SolveError
from parallel_cal.base.rotation import matrix_to_quaternion
from parallel_cal.model.file.modelfile import write_model
from parallel_cal.model.model import Noise, new_model
from parallel_cal.model.shelf import load_sensor
from parallel_cal.nodes.beat import Beat
from parallel_cal.nodes.conversions import joint_order, pose_message
from parallel_cal.nodes.parameters import ACCEPTED, LATCHED, Changes, Setting, absolute, declare
from parallel_cal.nodes.rendering import BOARD, SQUARE_M
from parallel_cal.nodes.run import run
from parallel_cal.virtual.board_camera import usual_camera
from parallel_cal.virtual.cell import Box, Cell
from parallel_cal.virtual.kinds import words_of
from parallel_cal.virtual.machines import MACHINES
from parallel_cal.virtual.tracker import Tracker

# The mechanism of the nominal model of each robot.
BELIEVED = {
    "delta": "delta54",
    "stewart": "stewart42",
    "argos": "argos9",
    "linear_delta": "linear_delta",
}

SET_UP = {
    "robot": Setting("delta", "the robot in the cell", tuple(BELIEVED), fixed=True),
    "seed": Setting(0, "seed of the geometric errors, hidden effects and noise", fixed=True),
    "effects": Setting(
        "",
        "effects of the robot, separated by commas; hidden = one drawn at random",
        fixed=True,
    ),
    "noise": Setting(1.0, "factor on the usual noise of encoders and tracker", (0.0, 100.0), True),
    "device": Setting(
        "tracker",
        "what measures: a tracker of poses, or a camera before a board on the platform, whose "
        "images are rendered",
        ("tracker", "camera"),
        True,
    ),
    "rate": Setting(1.0, "factor on real time", (0.01, 100.0), True),
    "joint_rate": Setting(
        100.0, "rate of joint states and of the controller, Hz", (50.0, 500.0), True
    ),
    "pose_rate": Setting(20.0, "rate of poses, Hz", (1.0, 100.0), True),
    "model_file": Setting(
        "", "file to which the nominal model is written unless it exists", fixed=True
    ),
    "air": Setting(0.3, "amplitude of the temperature's variation, degC", (0.0, 10.0), True),
    "missing": Setting(0.01, "share of the tracker's poses that are lost", (0.0, 1.0), True),
    "clock_offset": Setting(0.0, "time by which the tracker's clock is ahead, s", fixed=True),
    "clock_drift": Setting(0.0, "drift of the tracker's clock, s per s", (-1e-2, 1e-2), True),
    "frame_offset": Setting(
        0.0, "offset of the tracker's frame from the base, m, and its rotation, rad", fixed=True
    ),
    "target_offset": Setting(
        0.0, "offset of the target from the platform's origin, m, and its rotation, rad", fixed=True
    ),
}
# Can be set at any time: what a person or a fault changes.
CIRCUMSTANCES = {
    "payload": Setting(0.0, "mass on the platform, kg", (0.0, 100.0)),
    "temperature": Setting(22.0, "temperature of the robot, degC", (-40.0, 120.0)),
    "obstacle": Setting(
        "", "box x y z x y z (m) that stops the platform's origin; separate several by ;"
    ),
    "stuck_axis": Setting(0, "number of the joint that does not move; 0 = none"),
    "stuck_encoder": Setting(0, "number of the joint whose reading is constant; 0 = none"),
    "drives_off": Setting(False, "no joint moves"),
    "crossed_axes": Setting(False, "the first two joints receive each other's commands"),
    "slipped": Setting(0.0, "slip of the first joint under its encoder, rad or m"),
    "lost_target": Setting(False, "the tracker sees nothing"),
    "swapped_target": Setting(False, "the tracker sees a different target"),
    "homed": Setting(0, "number of times the robot was homed again"),
}
PARAMETERS = SET_UP | CIRCUMSTANCES
TICK = 0.01  # s between two steps of the cell; twice that if its rate exceeds FAST
FAST = 5.0
MAX_TICK_S = 0.1  # largest step, s: on a computer that is too slow, the cell runs slower
CONDITION_PERIOD_S = 1.0  # s between two messages of temperature and payload
UNMEASURED_VARIANCE = 1e6  # variance of a coordinate that the device does not measure


class VirtualCellNode(Node):
    """The cell, at `rate` times the speed of the wall clock; docs/ros.md lists its topics."""

    def __init__(self) -> None:
        super().__init__("virtual_cell_node")
        declare(self, PARAMETERS, self._on_parameters)
        self._cell = self._build()
        self._write_nominal()
        self._asked: deque[Callable[[], None]] = deque()  # of the cell, by other threads
        own, factor = self._cell.machine.noise, self._value("noise")
        position = (
            (factor * own.position) ** 2
            if self._cell.machine.sees_position
            else UNMEASURED_VARIANCE
        )
        self._covariance = np.diag([position] * 3 + [(factor * own.orientation) ** 2] * 3).ravel()
        self._frame = "tracker" if self._value("frame_offset") else "base"
        self._begin, self._last_tick = time.time_ns(), time.monotonic()
        self._conditions_published = -CONDITION_PERIOD_S  # time in the cell, s
        many, group = QoSProfile(depth=1000), MutuallyExclusiveCallbackGroup()
        self._joints = self.create_publisher(JointState, "joint_states", many)
        self._camera: Any = None
        self._poses: Any = None
        if self._value("device") == "camera":
            from parallel_cal.nodes.photographer import Photographer  # needs OpenCV

            self._camera = Photographer(self, self._cell, self._value("seed"), self._stamp)
        else:
            self._poses = self.create_publisher(PoseWithCovarianceStamped, "measured_pose", many)
        self._air = self.create_publisher(Temperature, "temperature", many)
        self._load = self.create_publisher(InertiaStamped, "payload", LATCHED)
        self.create_subscription(
            JointTrajectory, "joint_trajectory", self._on_trajectory, 10, callback_group=group
        )
        tick = TICK if self._value("rate") <= FAST else 2 * TICK
        self._beat = Beat(self, tick, self._tick)

    def _value(self, name: str) -> Any:
        return self.get_parameter(name).value

    # ------------------------------------------------------------------ the cell

    def _build(self) -> Cell:
        rng = np.random.default_rng([self._value("seed"), 60])
        directions = rng.standard_normal((4, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        shift, spin, target, target_spin = directions
        frame_offset, target_offset = self._value("frame_offset"), self._value("target_offset")
        tracker = Tracker(
            period=1 / self._value("pose_rate"),
            missing=self._value("missing"),
            offset=self._value("clock_offset"),
            drift=self._value("clock_drift"),
            shift=frame_offset * shift,
            spin=frame_offset * spin,
            target=target_offset * target,
            target_spin=target_offset * target_spin,
        )
        try:
            cell = Cell(
                self._value("robot"),
                self._value("seed"),
                words_of(self._value("effects")),
                self._value("noise"),
                tracker,
                1 / self._value("joint_rate"),
                self._value("air"),
            )
            cell.change(**self._circumstances({}))
        except ValueError as error:
            raise ParallelCalError(str(error)) from None
        return cell

    def _circumstances(self, changed: dict[str, Any]) -> dict[str, Any]:
        """Return the fields of Circumstances; ValueError for an obstacle that is not a box."""
        fields = {name: changed.get(name, self._value(name)) for name in CIRCUMSTANCES}
        boxes = fields.pop("obstacle").split(";")
        fields["obstacles"] = tuple(_parse_box(text) for text in boxes if text)
        return fields

    def _write_nominal(self) -> None:
        path = absolute(self._value("model_file"))
        if path and not Path(path).exists():
            robot, factor = self._value("robot"), self._value("noise") or 1.0
            own = MACHINES[robot].noise
            noise = Noise(factor * own.joint, factor * own.position, factor * own.orientation)
            model, limits = new_model(BELIEVED[robot]), MACHINES[robot].limits
            model.mechanism.joint_rates = ((limits.velocity, limits.acceleration),) * len(
                model.joints
            )
            model = replace(model, noise=noise)
            if self._value("device") == "camera":
                camera = load_sensor(
                    "camera",
                    columns=BOARD.columns,
                    rows=BOARD.rows,
                    square=SQUARE_M,
                    image_size=usual_camera().size,
                )
                noise = replace(noise, position=None, orientation=None)  # no other device
                model = replace(model.with_sensors((camera,)), noise=noise)
            write_model(model, path)

    def _on_parameters(self, changes: Changes) -> SetParametersResult:
        """Queue changed parameters for the next tick."""
        try:
            changed = self._circumstances({c.name: c.value for c in changes})
            self._asked.append(partial(self._change, changed))
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return ACCEPTED

    def _change(self, circumstances: dict[str, Any]) -> None:
        self._cell.change(**circumstances)
        self._conditions_published = -CONDITION_PERIOD_S

    # ------------------------------------------------------------------ commands

    def _on_trajectory(self, trajectory: JointTrajectory) -> None:
        """Queue a trajectory for the next tick; until then no time passes in the cell."""
        self._asked.append(partial(self._follow, trajectory))

    def _follow(self, trajectory: JointTrajectory) -> None:
        """Follow a trajectory at once, as joint_trajectory_controller does."""
        try:
            self._cell.follow(*_read_points(trajectory, self._cell.machine.joints))
        except SolveError as error:
            self.get_logger().error(f"trajectory refused: {error}")

    # ------------------------------------------------------------------ messages

    def _tick(self) -> None:
        """Advance the cell by the time that has passed and publish what it shows."""
        while self._asked:
            self._asked.popleft()()
        now = time.monotonic()
        passed = self._value("rate") * min(now - self._last_tick, MAX_TICK_S)
        self._last_tick = now
        tripped = self._cell.drive.tripped
        shown = self._cell.advance(self._cell.time + passed)
        if self._cell.drive.tripped > tripped:
            self.get_logger().warning(
                "a joint does not follow its command: the drives stopped and hold"
            )
        names = list(self._cell.machine.joints)
        for moment, q, speed in zip(shown.time, shown.q, shown.speed, strict=True):
            message = JointState(name=names, position=q.tolist(), velocity=speed.tolist())
            message.header.stamp = self._stamp(moment)
            self._joints.publish(message)
        if self._camera is not None:
            self._camera.watch()
            poses = []
        else:
            poses = [*zip(shown.stamp, shown.r, matrix_to_quaternion(shown.R), strict=True)]
        for moment, r, quaternion in poses:
            pose = PoseWithCovarianceStamped()
            pose.header.stamp, pose.header.frame_id = self._stamp(moment), self._frame
            pose.pose.pose = pose_message(r, quaternion)
            pose.pose.covariance = self._covariance
            self._poses.publish(pose)
        if self._cell.time - self._conditions_published >= CONDITION_PERIOD_S:
            self._conditions_published, at = self._cell.time, self._stamp(self._cell.time)
            air = Temperature(temperature=float(self._cell.temperature(self._cell.time)))
            load = InertiaStamped()
            air.header.stamp = load.header.stamp = at
            load.inertia.m = self._cell.now.payload
            self._air.publish(air)
            self._load.publish(load)

    def end_work(self) -> None:
        """Move no more; the node is destroyed next."""
        self._beat.end()

    def destroy_node(self) -> None:
        if self._camera is not None:
            self._camera.close()
        super().destroy_node()

    def _stamp(self, seconds: float) -> Time:
        sec, nanosec = divmod(self._begin + round(1e9 * float(seconds)), 1_000_000_000)
        return Time(sec=sec, nanosec=nanosec)


def _read_points(
    trajectory: JointTrajectory, joints: Sequence[str]
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return times (n,), positions and velocities (n, nq) in the order of the joints.

    SolveError if joint_trajectory_controller would refuse the trajectory.
    """
    if not trajectory.points:
        raise SolveError("it has no points; to stop the robot, send one point where it may rest")
    if sorted(trajectory.joint_names) != sorted(joints):
        raise SolveError(f"it names {', '.join(trajectory.joint_names) or 'no joints'}")
    order = joint_order(trajectory.joint_names, joints)
    starts = [point.time_from_start for point in trajectory.points]
    times = np.array([start.sec + 1e-9 * start.nanosec for start in starts])
    if times[0] < 0 or (np.diff(times) <= 0).any():
        raise SolveError("its times do not increase")
    positions = [list(point.positions) for point in trajectory.points]
    velocities = [list(point.velocities) for point in trajectory.points]
    if any(len(p) != len(joints) or not np.isfinite(p).all() for p in positions):
        raise SolveError("each point needs one finite position per joint")
    if not any(velocities):
        return times, np.array(positions)[:, order], None
    if any(len(v) != len(joints) or not np.isfinite(v).all() for v in velocities):
        raise SolveError("each point needs one finite velocity per joint")
    if any(velocities[-1]):
        raise SolveError("its last point has a velocity other than zero")
    return times, np.array(positions)[:, order], np.array(velocities)[:, order]


def _parse_box(text: str) -> Box:
    """Return the lower and upper corner (3,) of a box written as six numbers."""
    numbers = [float(word) for word in text.split()]
    if len(numbers) != 6 or not all(map(math.isfinite, numbers)):
        raise ValueError(f"obstacle '{text}': expected x y z x y z in m")
    corners = np.array(numbers).reshape(2, 3)
    return corners.min(axis=0), corners.max(axis=0)


def main(args: list[str] | None = None) -> None:
    """`ros2 run parallel_cal virtual_cell_node --ros-args -p robot:=delta -p effects:=hidden`."""
    sys.exit(run(VirtualCellNode, args))
