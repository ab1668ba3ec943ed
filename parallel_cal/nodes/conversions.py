"""Convert between messages and numbers: joints by name, poses, conditions, solutions."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Sequence
from functools import lru_cache
from importlib import import_module
from typing import Any

import numpy as np
from builtin_interfaces.msg import Duration
from geometry_msgs.msg import Point, Pose, PoseWithCovarianceStamped, Quaternion
from parallel_cal_msgs.msg import Condition, Solution
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from parallel_cal.base.errors import SolveError
from parallel_cal.base.float_fields import UNCONVERTED, is_unconverted
from parallel_cal.base.rotation import quaternion_to_matrix
from parallel_cal.campaign.trajectory import Trajectory
from parallel_cal.kinematics.answers import named_conditions
from parallel_cal.kinematics.kinematics import Solutions, Status
from parallel_cal.model.model import Model
from parallel_cal.recordings.pose_messages import read_pose
from parallel_cal.recordings.pose_stream import NOT_MEASURED

STOPPING_TIME_S = 0.05  # s in which a stop message brings the robot to rest
UNIT_LENGTH = 1e-3  # a quaternion whose norm deviates more from 1 is refused

ADVICE: dict[int, str] = {
    Status.CONVERGED: "",
    Status.UNREACHABLE: "no real solution exists: out of reach",
    Status.SINGULAR: "the mechanism is singular here: it cannot be controlled",
    Status.OUTSIDE_LIMITS: "solved, but a joint is outside its limits",
    Status.NOT_CONVERGED: "the solver gave up; a solution may exist",
    Status.INVALID_INPUT: "the input holds a value that is not finite",
    Status.OTHER_BRANCH: "solved, but mirrored or turned over: no path without a singularity from "
    "home to this solution was found",
}


def message_class(type: str) -> Any:
    """Return the class of a type such as `sensor_msgs/msg/JointState`.

    Raise ImportError or AttributeError if there is none.
    """
    package, _, name = type.split("/")
    return getattr(import_module(f"{package}.msg"), name)


def find_measured_pose(message: Any, body: str) -> PoseWithCovarianceStamped | None:
    """Return the pose of a body in a driver's message; None if the message lacks the body.

    The covariance is zero where the driver states none. Raise BagError if the message holds several
    bodies and none is named.
    """
    found = read_pose(message, body)
    if found is None:
        return None
    stamp, (frame, position, quaternion, covariance) = found
    pose = PoseWithCovarianceStamped()
    pose.header.frame_id = frame
    pose.header.stamp.sec, pose.header.stamp.nanosec = divmod(stamp, 1_000_000_000)
    turn = quaternion or (0.0, 0.0, 0.0, 1.0)
    set_pose(pose.pose.pose, np.array(position), np.array(turn))
    if covariance is not None:
        pose.pose.covariance = covariance
    elif quaternion is None:
        variances = [0.0] * 3 + [2 * NOT_MEASURED] * 3
        pose.pose.covariance = np.diag(variances).ravel()
    return pose


def joint_order(names: Sequence[str], joints: Sequence[str]) -> list[int]:
    """Return the index in `names` of each joint of the model.

    `names` may contain further joints. Raise SolveError unless each joint occurs exactly once.
    """
    missing = [joint for joint in joints if joint not in names]
    if missing:
        have = ", ".join(names) or "none"
        raise SolveError(f"joint {', '.join(missing)} not given; the message names {have}")
    twice = [joint for joint in joints if list(names).count(joint) > 1]
    if twice:
        raise SolveError(f"joint {', '.join(twice)} given more than once")
    return [list(names).index(joint) for joint in joints]


@lru_cache(maxsize=64)
def _order(names: tuple[str, ...], joints: tuple[str, ...]) -> list[int]:
    return joint_order(names, joints)


def match_joints(message: Any, joints: Sequence[str]) -> tuple[np.ndarray, np.ndarray | None]:
    """Return positions (nq,) and velocities (nq,) of a JointState in the model's order.

    Velocities are None if the driver sent none or sent values that are not finite.
    """
    order = _order(tuple(message.name), tuple(joints))
    if len(message.position) != len(message.name):
        raise SolveError(f"{len(message.position)} positions for {len(message.name)} joint names")
    q = np.asarray(message.position)[order]
    if is_unconverted(q).any():
        raise SolveError(
            f"the joint positions are {' '.join(f'{v:.4g}' for v in q)}: {UNCONVERTED}"
        )
    if not np.isfinite(q).all():
        raise SolveError("a joint position is not finite")
    if len(message.velocity) != len(message.name):
        return q, None
    velocity = np.asarray(message.velocity)[order]
    return q, velocity if np.isfinite(velocity).all() else None


def check_finite(value: float) -> float:
    """Return the value; raise SolveError if it is not finite or was no float in the driver."""
    if is_unconverted(value).any():
        raise SolveError(f"the value is {value:.4g}: {UNCONVERTED}")
    if not np.isfinite(value):
        raise SolveError(f"the value is {value}")
    return value


def pose_numbers(pose: Pose) -> tuple[np.ndarray, np.ndarray]:
    """Return position (3,) [m] and rotation (3, 3).

    Raise SolveError if a number is not finite or the quaternion has not unit length.
    """
    p, o = pose.position, pose.orientation
    r, quaternion = np.array([p.x, p.y, p.z]), np.array([o.x, o.y, o.z, o.w])
    if is_unconverted(numbers := np.concatenate([r, quaternion])).any():
        raise SolveError(f"the pose is {' '.join(f'{v:.4g}' for v in numbers)}: {UNCONVERTED}")
    if not (np.isfinite(r).all() and np.isfinite(quaternion).all()):
        raise SolveError("the pose holds a value that is not finite")
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1) > UNIT_LENGTH:
        raise SolveError(f"the quaternion has length {length:.6g}, expected 1")
    return r, quaternion_to_matrix(quaternion)


def conditions_of(model: Model, conditions: Iterable[Condition]) -> dict[str, float] | None:
    """Return the named conditions of a request; `direction` sets it for all joints.

    Raise ModelError for an unknown name.
    """
    return named_conditions(model, ((c.name, c.value) for c in conditions)) or None


def pose_message(r: np.ndarray, quaternion: np.ndarray) -> Pose:
    """Make a pose message from position (3,) and quaternion x y z w (4,)."""
    x, y, z = r.tolist()
    a, b, c, d = quaternion.tolist()
    return Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=a, y=b, z=c, w=d))


def set_pose(pose: Pose, r: np.ndarray, quaternion: np.ndarray) -> None:
    """Write position (3,) and quaternion x y z w (4,) into an existing pose message."""
    p, o = pose.position, pose.orientation
    p.x, p.y, p.z = r.tolist()
    o.x, o.y, o.z, o.w = quaternion.tolist()


def solution_messages(found: Solutions) -> list[Solution]:
    """Make one message per solution."""
    rows = (found.joints, found.position, found.quaternion, found.residual, found.status)
    if found.joints.ndim == 1:
        return [_solution(*rows)]
    return [_solution(*row) for row in zip(*rows, strict=True)]


def _solution(
    q: np.ndarray, r: np.ndarray, quaternion: np.ndarray, residual: Any, status: Any
) -> Solution:
    code = int(status)
    return Solution(
        status=code,
        message=ADVICE[code],
        pose=pose_message(r, quaternion),
        joints=array("d", q.tobytes()),
        residual=float(residual),
    )


def trajectory_message(joints: Sequence[str], trajectory: Trajectory) -> JointTrajectory:
    """Make the message of a trajectory that begins when it is received."""
    points = [
        JointTrajectoryPoint(
            positions=q.tolist(),
            velocities=v.tolist(),
            time_from_start=Duration(sec=int(t), nanosec=int(1e9 * (t % 1.0))),
        )
        for t, q, v in zip(
            trajectory.time, trajectory.positions, trajectory.velocities, strict=True
        )
    ]
    return JointTrajectory(joint_names=list(joints), points=points)


def stop_message(
    joints: Sequence[str], q: np.ndarray, velocity: np.ndarray | None = None
) -> JointTrajectory:
    """Make a trajectory that stops a robot at q (nq,) moving with the given velocity (nq,).

    Its only point is where the robot comes to rest with constant deceleration. An empty trajectory
    no longer stops the robot: since ROS 2 Jazzy, joint_trajectory_controller discards it.
    """
    speed = np.zeros(len(q)) if velocity is None else velocity
    point = JointTrajectoryPoint(
        positions=(q + speed * STOPPING_TIME_S / 2).tolist(),
        velocities=[0.0] * len(q),
        time_from_start=Duration(nanosec=round(1e9 * STOPPING_TIME_S)),
    )
    return JointTrajectory(joint_names=list(joints), points=[point])


def invalid_solution(reason: str) -> Solution:
    """Make the answer to a configuration or target that is invalid, with the reason."""
    nan = float("nan")
    pose = pose_message(np.full(3, nan), np.full(4, nan))
    return Solution(status=Solution.INVALID_INPUT, message=reason, pose=pose, residual=nan)
