"""A client of the action FollowJointTrajectory, as joint_trajectory_controller provides it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from action_msgs.msg import GoalStatus
from action_msgs.srv import CancelGoal
from control_msgs.action import FollowJointTrajectory
from parallel_cal_msgs.msg import MotionStatus
from rclpy.action import ActionClient
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.task import Future
from trajectory_msgs.msg import JointTrajectory

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.campaign.cell import CellError, UnansweredError
from parallel_cal.nodes.parameters import RELIABLE
from parallel_cal.nodes.run import create_steady_timer

Result = FollowJointTrajectory.Result
ERRORS = {
    Result.INVALID_GOAL: "the trajectory is invalid",
    Result.INVALID_JOINTS: "the joint names are not those of the controller",
    Result.OLD_HEADER_TIMESTAMP: "the trajectory begins in the past",
    Result.PATH_TOLERANCE_VIOLATED: "path tolerance violated",
    Result.GOAL_TOLERANCE_VIOLATED: "goal tolerance violated",
}
UNENDED = (MotionStatus.SENT, MotionStatus.MOVING)
WATCH_INTERVAL_S = 1.0  # s between two checks of whether the controller still answers
# Checks in a row, counted in the thread that spins: a busy computer, on which no message is read,
# delays the checks as well.
MAX_CHECKS_SILENT = 10  # without an answer to a goal, or without feedback after the first one
MAX_CHECKS_GONE = 3  # without a server: DDS may lose a participant for a moment

MakeHalt = Callable[[], JointTrajectory]


@dataclass
class _Goal:
    """One trajectory that was sent, and what is known of it."""

    trajectory: JointTrajectory
    source: str
    state: int = MotionStatus.SENT
    code: int = 0
    message: str = ""
    errors: Mapping[str, float] = field(default_factory=dict)  # desired minus actual, by joint
    handle: Any = None  # of the goal, once the controller has accepted it
    make_halt: MakeHalt | None = None  # how to stop the robot, once the goal is to be cancelled
    silent: int = 0  # checks since the controller last answered
    gone: int = 0  # checks since there was a controller
    unanswered: bool = False  # it was given up, and nothing was heard of it

    @property
    def owes_answer(self) -> bool:
        """Whether an answer or feedback is due; some controllers never send feedback."""
        return self.handle is None or bool(self.errors)


class TrajectoryAction:
    """Sends trajectories as goals, of which the controller reports the end.

    A goal replaces the one before it, as the controller does it. Goals are sent by the thread that
    spins, which also receives the answers: rclpy loses an answer that arrives before the thread
    that sent the request has noted its number.
    """

    def __init__(self, node: Node, name: str, group: CallbackGroup, publish_status: bool = False):
        """`group` must be called by the thread that spins."""
        self._node, self._name = node, name
        self._client = ActionClient(node, FollowJointTrajectory, name, callback_group=group)
        create_steady_timer(WATCH_INTERVAL_S, node, self._watch, group)
        self._goals: list[_Goal] = []  # the newest one, and others that have not ended
        self._status = None
        if publish_status:
            self._status = node.create_publisher(MotionStatus, "~/motion_status", RELIABLE)

    def require_controller(self) -> None:
        if not self._client.server_is_ready():
            raise CellError(
                f"no node provides the action {self._name} (parameter trajectory_action): is the "
                "controller active?"
            )

    def send(self, trajectory: JointTrajectory, source: str = "") -> None:
        self.require_controller()
        goal = _Goal(trajectory, source)
        self._goals = [one for one in self._goals if one.state in UNENDED] + [goal]
        self._node.executor.create_task(self._begin, goal)

    def is_answered(self) -> bool:
        return self._goals[-1].state != MotionStatus.SENT

    def has_ended(self) -> bool:
        goal = self._goals[-1]
        if goal.state in UNENDED:
            return False
        if goal.state != MotionStatus.ARRIVED:
            kind = UnansweredError if goal.unanswered else CellError
            raise kind(goal.message or "the motion was stopped")
        return True

    def explain_silence(self) -> str:
        goal = self._goals[-1]
        heard = goal.silent <= 1 or not goal.owes_answer
        return "" if heard and not goal.gone else _describe_silence(goal)

    def stop(self, make_halt: MakeHalt) -> None:
        """Cancel all goals; the controller then stops the robot and holds its position.

        This is done at once, in the calling thread: the node may be about to end. It is done again
        in the thread that spins, which loses no answer. If the controller refuses, a goal with the
        trajectory of `make_halt` takes the place of the present one.
        """
        for goal in self._goals:
            goal.make_halt = make_halt
            self._cancel(goal)
            self._node.executor.create_task(self._cancel, goal)

    withdraw = stop

    def _cancel(self, goal: _Goal) -> None:
        if goal.handle is not None and goal.state in UNENDED:
            answer = goal.handle.cancel_goal_async()
            answer.add_done_callback(partial(self._on_cancelled, goal))

    # ------------------------------------------------------------------ in the thread that spins

    def _begin(self, goal: _Goal) -> None:
        if goal.make_halt:
            self._end(goal, MotionStatus.STOPPED)
            return
        self._report(goal)
        answer = self._client.send_goal_async(
            FollowJointTrajectory.Goal(trajectory=goal.trajectory), partial(self._on_feedback, goal)
        )
        answer.add_done_callback(partial(self._on_answer, goal))

    def _watch(self) -> None:
        """Give up the goals of a controller that is gone or has fallen silent."""
        goals = [goal for goal in self._goals if goal.state in UNENDED]
        ready = not goals or self._client.server_is_ready()
        for goal in goals:
            goal.silent, goal.gone = goal.silent + 1, 0 if ready else goal.gone + 1
            if goal.gone > MAX_CHECKS_GONE or (
                goal.silent > MAX_CHECKS_SILENT and goal.owes_answer
            ):
                message = f"{_describe_silence(goal)}; the robot may still move"
                goal.unanswered = not (goal.handle or goal.errors or goal.gone)
                self._cancel(goal)
                self._end(goal, MotionStatus.FAILED, message=message)

    def _on_answer(self, goal: _Goal, answer: Future) -> None:
        handle = answer.result()
        if goal.state not in UNENDED:  # it was given up
            if handle.accepted:
                handle.cancel_goal_async()
            return
        if not handle.accepted:
            why = "the controller rejected the trajectory; its log has the reason"
            self._end(goal, MotionStatus.FAILED, Result.INVALID_GOAL, why)
            return
        goal.handle, goal.state, goal.silent = handle, MotionStatus.MOVING, 0
        self._report(goal)
        handle.get_result_async().add_done_callback(partial(self._on_result, goal))
        if goal.make_halt:
            self._cancel(goal)

    def _on_feedback(self, goal: _Goal, message: Any) -> None:
        feedback, goal.silent = message.feedback, 0
        goal.errors = dict(zip(feedback.joint_names, feedback.error.positions, strict=False))
        if goal.state == MotionStatus.MOVING:
            self._report(goal)

    def _on_result(self, goal: _Goal, answer: Future) -> None:
        if goal.state not in UNENDED:  # it was given up
            return
        status, result = answer.result().status, answer.result().result
        code = result.error_code
        if status == GoalStatus.STATUS_SUCCEEDED and code == Result.SUCCESSFUL:
            self._end(goal, MotionStatus.ARRIVED)
        elif goal.make_halt and status == GoalStatus.STATUS_CANCELED:
            self._end(goal, MotionStatus.STOPPED, code)
        elif goal is not self._goals[-1]:
            self._end(goal, MotionStatus.REPLACED, code, goal.message)
        else:
            self._end(goal, MotionStatus.FAILED, code, _describe_failure(goal, status, result))

    def _on_cancelled(self, goal: _Goal, answer: Future) -> None:
        """Stop the robot by another goal if the controller refuses to cancel the present one."""
        response = answer.result()
        # Servers of rclcpp state the refusal; those of rclpy only name no goal.
        refused = response.return_code == CancelGoal.Response.ERROR_REJECTED or not (
            response.return_code or response.goals_canceling
        )
        if not refused or goal.state not in UNENDED or goal is not self._goals[-1]:
            return
        goal.message = "the controller refused to cancel the motion"
        self._report(goal)
        log = self._node.get_logger()
        try:
            assert goal.make_halt is not None  # only a goal that is to stop is cancelled
            self.send(goal.make_halt(), "stop")
            log.error(f"{self._name}: {goal.message}; sent a trajectory that stops the robot")
        except ParallelCalError as error:
            log.error(f"{self._name}: {goal.message}; stop the robot by other means ({error})")

    def _end(self, goal: _Goal, state: int, code: int = 0, message: str = "") -> None:
        goal.state, goal.code, goal.message = state, code, message
        if state == MotionStatus.FAILED:
            self._node.get_logger().warning(f"{self._name}: {message}")
        self._report(goal)

    def _report(self, goal: _Goal) -> None:
        if self._status is None:
            return
        names, end = list(goal.trajectory.joint_names), goal.trajectory.points[-1].time_from_start
        known = all(name in goal.errors for name in names)
        self._status.publish(
            MotionStatus(
                stamp=self._node.get_clock().now().to_msg(),
                state=goal.state,
                source=goal.source,
                error_code=goal.code,
                message=goal.message,
                time_from_start=end.sec + 1e-9 * end.nanosec,
                joint_names=names,
                errors=[goal.errors[name] for name in names] if known else [],
            )
        )


def _describe_silence(goal: _Goal) -> str:
    if goal.gone:
        return "no node provides the action any more: has the controller ended?"
    expected = "answer to the goal" if goal.state == MotionStatus.SENT else "feedback"
    return f"the controller sent no {expected} for {WATCH_INTERVAL_S * (goal.silent - 1):.0f} s"


def _describe_failure(goal: _Goal, status: int, result: Any) -> str:
    """Say why the controller ended a motion, and which joint was furthest off."""
    if status == GoalStatus.STATUS_CANCELED:
        why = "the motion was cancelled by the controller or by another client"
    else:
        why = "the controller ended the motion"
    if result.error_code in ERRORS:
        why += f": {ERRORS[result.error_code]}"
    if result.error_string:
        why += f" ({result.error_string})"
    if goal.errors:
        joint = max(goal.errors, key=lambda name: abs(goal.errors[name]))
        why += f"; {joint} was furthest off its path, by {goal.errors[joint]:.4g} rad or m"
    return why
