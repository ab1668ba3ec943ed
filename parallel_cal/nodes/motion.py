"""Send trajectories to the controller of a robot: by a topic, or by an action."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from trajectory_msgs.msg import JointTrajectory

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.campaign.cell import CellError
from parallel_cal.nodes.parameters import Setting

TRAJECTORY_ACTION = {
    "trajectory_action": Setting(
        "",
        "name of the controller's action FollowJointTrajectory, such as "
        "/joint_trajectory_controller/follow_joint_trajectory; empty = the topic",
        fixed=True,
    )
}


class Motion(Protocol):
    """The way to a controller, which follows one trajectory at a time."""

    def require_controller(self) -> None:
        """Raise CellError if no controller is there."""

    def send(self, trajectory: JointTrajectory, source: str = "") -> None:
        """Send a trajectory that replaces the present one; `source` names what asked for it."""

    def is_answered(self) -> bool:
        """Whether the controller has answered the last trajectory, if it does that at all."""

    def has_ended(self) -> bool:
        """Whether nothing more is to be heard of the last trajectory.

        CellError if it failed, UnansweredError if it was given up without an answer.
        """

    def explain_silence(self) -> str:
        """Explain why nothing is heard of the last trajectory; empty if the controller answers."""

    def stop(self, make_halt: Callable[[], JointTrajectory]) -> None:
        """Stop the robot; `make_halt` makes a trajectory that does so, if one is needed."""

    def withdraw(self, make_halt: Callable[[], JointTrajectory]) -> None:
        """Cancel what was sent, if the controller can do that, as `stop` does."""


class TopicMotion:
    """A controller that subscribes to trajectories and reports nothing."""

    def __init__(self, publisher: Any):
        self._publisher = publisher

    def require_controller(self) -> None:
        if not self._publisher.get_subscription_count():
            raise CellError(
                f"no node subscribes to {self._publisher.topic_name}: is a controller running?"
            )

    def send(self, trajectory: JointTrajectory, source: str = "") -> None:
        self._publisher.publish(trajectory)

    def is_answered(self) -> bool:
        return True

    def has_ended(self) -> bool:
        return True

    def explain_silence(self) -> str:
        return ""

    def stop(self, make_halt: Callable[[], JointTrajectory]) -> None:
        self._publisher.publish(make_halt())

    def withdraw(self, make_halt: Callable[[], JointTrajectory]) -> None:
        return


def make_trajectory_action(
    node: Node, name: str, group: CallbackGroup, publish_status: bool = False
) -> Motion:
    """Make the client of an action FollowJointTrajectory.

    `publish_status` publishes what becomes of each trajectory on `~/motion_status`. Raise
    ParallelCalError if the package of the action is not installed.
    """
    try:
        # Imported only here: the package is on no Python index, and not everybody needs it.
        from parallel_cal.nodes.trajectory_action import TrajectoryAction
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] != "control_msgs":
            raise
        raise ParallelCalError(
            f"parameter trajectory_action {name}: the package control_msgs, which defines the "
            "action, is not installed here: install ros-jazzy-control-msgs and source ROS again, "
            "or leave the parameter empty and use the topic"
        ) from None
    return TrajectoryAction(node, name, group, publish_status)
