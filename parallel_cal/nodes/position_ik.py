"""Inverse kinematics of the model in use, in the service type of MoveIt: GetPositionIK."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np

from parallel_cal.base.errors import ParallelCalError, SolveError
from parallel_cal.base.rotation import rotation_vector
from parallel_cal.base.worker import TimeBudgetExceeded, Worker
from parallel_cal.kinematics.kinematics import Status
from parallel_cal.nodes import computing
from parallel_cal.nodes.conversions import ADVICE, joint_order, pose_numbers
from parallel_cal.nodes.model_server import ServedModel

NAME = "position_ik"
# A shorter timeout counts as this one. A solution takes milliseconds, but to stop the process that
# looks for it costs a second: MoveIt's usual 5 ms would stop it whenever the computer is busy.
MIN_TIMEOUT_S = 0.1
# A larger difference to the target, in coordinates that the robot does not control, is no solution.
# The platform of a calibrated Delta is turned by some 0.01 rad.
POSITION_TOLERANCE_M = 1e-4
ORIENTATION_TOLERANCE_RAD = 0.05


class _Refusal(Exception):
    """A request is not answered: the name of its error code, and the reason."""


def find_service_type() -> Any:
    """Return the class GetPositionIK, or None if moveit_msgs is not installed."""
    try:
        # A folder of this name, such as the sources of the package, is a module without the class.
        return getattr(import_module("moveit_msgs.srv"), "GetPositionIK", None)
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] != "moveit_msgs":
            raise
        return None


def answer(
    worker: Worker,
    seconds: float,
    served: ServedModel | None,
    at: dict[str, float] | None,
    why_none: str,
    request: Any,
    response: Any,
) -> Any:
    """Fill a response of GetPositionIK.

    Parameters
    ----------
    worker
        The process that solves.
    seconds
        The longest time that a request may take.
    served
        The model in use; None: `why_none` says why.
    at
        The known conditions of the robot.
    """
    code = response.error_code
    code.source = "parallel_cal"
    try:
        if served is None:
            raise _Refusal("FAILURE", f"no model in use: {why_none}")
        joints = _solve(worker, seconds, served, at, request.ik_request)
        state = response.solution.joint_state
        state.header.frame_id = served.model.frames["base"]
        state.name, state.position = list(served.model.joints), joints.tolist()
        code.val = code.SUCCESS
        if request.ik_request.avoid_collisions:
            code.message = "collisions were not checked"
    except _Refusal as refusal:
        name, code.message = refusal.args
        code.val = getattr(code, name)
    except Exception as error:  # whatever it is, the node goes on and the caller gets a reason
        code.val, code.message = code.FAILURE, str(error) or type(error).__name__
    return response


def _solve(
    worker: Worker, seconds: float, served: ServedModel, at: dict[str, float] | None, asked: Any
) -> np.ndarray:
    """Return the joints (nq,) for the target; raise _Refusal if there are none."""
    r, R = _read_target(served, asked)
    seed = _read_seed(served, asked.robot_state.joint_state)
    given = asked.timeout.sec + 1e-9 * asked.timeout.nanosec
    if given > 0:
        seconds = min(seconds, max(given, MIN_TIMEOUT_S))
    try:
        # Building a model's functions does not count as time of the request.
        computing.warm_in(worker, served.text)
        found = worker.work(computing.solve_near, served.text, seed, r, R, at, seconds=seconds)
    except TimeBudgetExceeded:
        raise _Refusal("TIMED_OUT", f"no solution within {seconds:g} s") from None
    if found.status != Status.CONVERGED:
        raise _Refusal("NO_IK_SOLUTION", ADVICE[int(found.status)])
    off = np.linalg.norm(found.position - r)
    turned = np.linalg.norm(rotation_vector(R @ found.rotation.T))
    if off > POSITION_TOLERANCE_M or turned > ORIENTATION_TOLERANCE_RAD:
        raise _Refusal(
            "NO_IK_SOLUTION",
            "the robot does not control all coordinates of the pose: the nearest pose is off by "
            f"{1e3 * off:.3g} mm and {turned:.3g} rad",
        )
    return np.asarray(found.joints)


def _read_target(served: ServedModel, asked: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return position (3,) and rotation (3, 3) of {P} in {B}; _Refusal says what is wrong."""
    base, platform = (served.model.frames[name] for name in ("base", "platform"))
    poses = list(asked.pose_stamped_vector) or [asked.pose_stamped]
    links = list(asked.ik_link_names) or [asked.ik_link_name]
    if len(poses) > 1 or any(link not in ("", platform) for link in links):
        raise _Refusal(
            "INVALID_LINK_NAME", f"{len(poses)} poses of {', '.join(links)}; expected {platform}"
        )
    kinds = asked.constraints.get_fields_and_field_types()
    if any(len(getattr(asked.constraints, kind)) for kind in kinds if kind != "name"):
        raise _Refusal("INVALID_GOAL_CONSTRAINTS", "constraints are not supported; expected none")
    frame = poses[0].header.frame_id
    if frame not in ("", base):
        raise _Refusal(
            "FRAME_TRANSFORM_FAILURE", f"frame_id '{frame}', expected '{base}' or an empty one"
        )
    try:
        return pose_numbers(poses[0].pose)
    except SolveError as error:
        raise _Refusal("FAILURE", str(error)) from None


def _read_seed(served: ServedModel, state: Any) -> np.ndarray | None:
    """Return the joints (nq,) of a state; None if it names none of the model's joints."""
    joints = served.model.joints
    if not set(joints) & set(state.name):
        return None
    try:
        seed = np.asarray(state.position, float)[joint_order(state.name, joints)]
        if not np.isfinite(seed).all():
            raise SolveError("a joint position is not finite")
    except (ParallelCalError, IndexError) as error:
        raise _Refusal("INVALID_ROBOT_STATE", str(error)) from None
    return seed
