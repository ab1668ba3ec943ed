"""Turn joint states into poses and targets into joint commands, and count all messages."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import (
    PoseStamped,
    PoseWithCovariance,
    PoseWithCovarianceStamped,
)
from nav_msgs.msg import Path
from parallel_cal_msgs.msg import CommandStatus
from rclpy.callback_groups import CallbackGroup
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from parallel_cal.base.errors import SolveError
from parallel_cal.campaign.cartesian import plan_cartesian_path
from parallel_cal.campaign.trajectory import rates
from parallel_cal.kinematics.kinematics import Status
from parallel_cal.kinematics.singularity import distances
from parallel_cal.kinematics.solving import controlled_pose
from parallel_cal.model.model import Model
from parallel_cal.model.region import describe_untested_conditions
from parallel_cal.nodes.conversions import (
    check_finite,
    match_joints,
    message_class,
    pose_numbers,
    set_pose,
    stop_message,
    trajectory_message,
)
from parallel_cal.nodes.health import Stream
from parallel_cal.nodes.link_transforms import make_link_publisher
from parallel_cal.nodes.managed_node import ManagedNode
from parallel_cal.nodes.model_server import ModelServer, ServedModel, describe_status
from parallel_cal.nodes.motion import Motion, TopicMotion, make_trajectory_action
from parallel_cal.nodes.parameters import LATCHED, RELIABLE, SENSOR, overridable
from parallel_cal.nodes.path_check import Bounds, check_path
from parallel_cal.nodes.pump import Messages, Pump
from parallel_cal.nodes.run import WorkerThreadGroup
from parallel_cal.nodes.stream_memory import Memory, joints_for
from parallel_cal.nodes.tally import Tally
from parallel_cal.recordings.channels import CHANNELS, list_channels
from parallel_cal.recordings.pose_messages import stamp_of

# Room for the messages that arrive while the interpreter is busy: 0.1 s at 1 kHz.
STATES = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
MAX_WAITING_JOINT_STATES = 50  # joint states answered one by one, in about 5 ms; older are skipped
MAX_REST_SPEED = 0.01  # share of a joint's velocity limit below which it counts as at rest
MAX_HALT_AGE_S = 0.5  # s since the last joint state for which a moving robot can be stopped
LOG_THROTTLE_S = 5.0  # s between two log lines about refused messages


class Streams:
    """The topics of a node on which each message causes a message on another topic."""

    def __init__(
        self,
        node: ManagedNode,
        server: ModelServer,
        memory: Memory,
        tally: Tally,
        group: CallbackGroup,
    ):
        self._node, self._server, self._group = node, server, group
        self._memory, self._tally = memory, tally
        self.health: dict[str, Stream] = {}
        self._warned: dict[str, str] = {}  # the hash of the model that each kind was logged for
        self._answer = PoseStamped()
        self._pose = self._publisher(PoseStamped, "~/pose")
        self._sure_pose = self._publisher(PoseWithCovarianceStamped, "~/pose_with_covariance")
        self._passive = self._publisher(JointState, "~/passive_joint_states")
        self._links = make_link_publisher(node)
        self._motion: Motion
        if action := node.get_parameter("trajectory_action").value:
            self._motion = make_trajectory_action(node, action, group, publish_status=True)
        else:
            self._motion = TopicMotion(self._publisher(JointTrajectory, "joint_command"))
        self.health["joint_states"] = Stream()
        self._pump = Pump(
            node,
            JointState,
            "joint_states",
            STATES,
            self._on_states,
            qos_overriding_options=overridable(),
        )
        # A target out of reach takes longer to solve than a joint state may wait.
        self._command_status = self._publisher(CommandStatus, "~/command_status")
        targets = WorkerThreadGroup()
        for type, topic, command in (
            (PoseStamped, "target_pose", self._command_target),
            (Path, "target_path", self._command_path),
        ):
            take = partial(self._on_target, command)
            self._subscribe(type, topic, RELIABLE, take, targets)
        for name in list_channels("condition"):
            channel, take = CHANNELS[name], partial(self._on_condition, name)
            self._subscribe(message_class(channel.types[0]), name, SENSOR, take)
            if channel.latched:
                self._subscribe_latched(message_class(channel.types[0]), name, take)

    def _publisher(self, type: Any, topic: str) -> Any:
        options = overridable()
        return self._node.create_publisher(type, topic, RELIABLE, qos_overriding_options=options)

    def _subscribe(
        self, type: Any, topic: str, qos: QoSProfile, take: Any, group: CallbackGroup | None = None
    ) -> None:
        self.health[topic] = Stream()
        self._node.create_subscription(
            type,
            topic,
            partial(self._receive, topic, take),
            qos,
            callback_group=group or self._group,
            qos_overriding_options=overridable(),
        )

    def _subscribe_latched(self, type: Any, topic: str, take: Any) -> None:
        """Also subscribe latched, to get a message published before this node started.

        A latched subscription does not match a publisher that does not latch, so the other
        subscription stays.
        """
        quiet = SubscriptionEventCallbacks(use_default_callbacks=False)
        self._node.create_subscription(
            type,
            topic,
            partial(self._receive, f"latched {topic}", take),
            LATCHED,
            callback_group=self._group,
            event_callbacks=quiet,
        )

    def _receive(self, channel: str, take: Any, message: Any, info: Any) -> None:
        """Process and count a message; log the reason if it is refused."""
        if not self._node.active:
            return
        self._tally.add(channel, "received")
        health = self.health.get(channel)
        if health is not None:
            health.count_received(info["publication_sequence_number"])
        try:
            take(message)
            if health is not None:
                health.count_answered(info["received_timestamp"])
        except Exception as error:  # a plug-in may raise anything, and the node must not end
            self._tally.add(channel, "refused", str(error))
            if health is not None:
                health.count_refused(str(error))
            log = self._node.get_logger()
            log.warning(f"{channel} refused: {error}", throttle_duration_sec=LOG_THROTTLE_S)

    def end(self) -> None:
        """Stop answering joint states."""
        self._pump.end()

    def stop(self) -> None:
        """Stop the robot; raise SolveError if its motion is not known well enough for that."""
        self._motion.stop(self._make_halt)

    def withdraw(self) -> None:
        """Cancel what a controller that has an action still follows."""
        self._motion.withdraw(self._make_halt)

    def _make_halt(self) -> JointTrajectory:
        """Make a trajectory that stops the robot where it is now."""
        model = self._get_served_model().model
        q, speed = self._present_motion(model)
        full_travel = self._node.get_parameter("full_travel").value
        moves = (np.abs(speed) > MAX_REST_SPEED * rates(model.mechanism, full_travel)[0]).any()
        age = time.monotonic() - self._memory.received
        if moves and age > MAX_HALT_AGE_S:
            raise SolveError(
                f"the robot moved in its last joint state, which was received {age:.1f} s ago: its "
                "position is unknown; stop it by other means"
            )
        return stop_message(model.joints, q + moves * age * speed, speed)

    def diagnoses(self, name: str) -> list[Any]:
        """Return a DiagnosticStatus per topic; called once a second."""
        return [health.diagnosis(name, topic) for topic, health in self.health.items()]

    def _get_served_model(self) -> ServedModel:
        served = self._server.current  # read once: it may be exchanged meanwhile
        if served is None:
            raise SolveError("no model in use")
        return served

    # ------------------------------------------------------------------ conditions

    def _on_condition(self, name: str, message: Any) -> None:
        served, value = self._server.current, check_finite(*CHANNELS[name].decode(message))
        stamp = 1e-9 * (stamp_of(message) or time.time_ns())
        self._memory.on_condition(served.model if served else None, name, value, stamp)

    # ------------------------------------------------------------------ poses

    def _on_states(self, waiting: Messages) -> None:
        """Answer the newest joint states; skip older ones, whose answers would come too late."""
        for _, info in waiting[:-MAX_WAITING_JOINT_STATES]:
            self._tally.add("joint_states", "skipped")
            self.health["joint_states"].count_skipped(info["publication_sequence_number"])
        for message, info in waiting[-MAX_WAITING_JOINT_STATES:]:
            self._receive("joint_states", self._on_joints, message, info)

    def _on_joints(self, message: JointState) -> None:
        """Publish the pose of joint readings, with their stamp."""
        served = self._get_served_model()
        model, stamp = served.model, message.header.stamp
        q, velocity = match_joints(message, model.joints)
        self._memory.on_joint_state(model, q, stamp.sec + stamp.nanosec * 1e-9, velocity)
        conditions = self._memory.conditions(model)
        found = served.kinematics.direct(q, conditions)
        if found.status not in (Status.CONVERGED, Status.OUTSIDE_LIMITS):
            raise SolveError(describe_status(found.status))
        answer = self._answer  # reused: making a new message takes a third of the time
        answer.header.stamp, answer.header.frame_id = stamp, model.frames["base"]
        set_pose(answer.pose, found.position, found.quaternion)
        self._pose.publish(answer)
        if model.covariance is not None and self._sure_pose.get_subscription_count():
            covariance = served.kinematics.direct_covariance(
                found, conditions, np.nan_to_num(model.joint_noise)
            )
            sure = PoseWithCovariance(pose=answer.pose, covariance=covariance.ravel())
            self._sure_pose.publish(PoseWithCovarianceStamped(header=answer.header, pose=sure))
        if served.description is not None:
            tree = served.description.tree
            if tree is not None and self._passive.get_subscription_count():
                state = JointState(header=answer.header, name=tree.passive)
                state.position = tree.values(found.configuration.rows).tolist()
                self._passive.publish(state)
            self._links.publish(served.description, found.configuration.rows, conditions, stamp)
        self._warn_outside_region(served, "joint_states", q, found.position)
        self._tally.add("joint_states", "answered")
        if found.status == Status.OUTSIDE_LIMITS:
            self._tally.add("joint_states", "outside limits")

    def _warn_outside_region(
        self, served: ServedModel, topic: str, joints: np.ndarray, position: np.ndarray
    ) -> None:
        """Count poses outside the region in which the model was identified, and outside the
        conditions in which its laws were tested; log the first one of each."""
        if served.region is None:
            return
        if served.region.conditions:
            rows = served.model.condition_rows(self._memory.conditions(served.model), 1)
            if words := describe_untested_conditions(served.model, rows, served.region):
                self._tally.add(topic, "outside the tested conditions")
                self._log_once("conditions", served, topic, lambda: words)
        excess = served.region.compute_excess(joints, position)
        if not excess.any():
            return
        self._tally.add(topic, "outside the identified region")
        describe = partial(served.region.describe_excess, excess, "poses")
        self._log_once("region", served, topic, describe)

    def _log_once(
        self, kind: str, served: ServedModel, topic: str, describe: Callable[[], str]
    ) -> None:
        """Log one warning of a kind for each model, and make its words only then."""
        if self._warned.get(kind) != served.hash:
            self._warned[kind] = served.hash
            words = f"{topic}: {describe()} (logged once for each model)"
            self._node.get_logger().warning(words)

    # ------------------------------------------------------------------ commands

    def _on_target(
        self, command: Callable[[Any, CommandStatus], None], message: PoseStamped | Path
    ) -> None:
        """Publish the joint command for a target, unless it cannot be reached safely."""
        status = CommandStatus(stamp=message.header.stamp, status=CommandStatus.REFUSED)
        status.time_from_start = status.singularity = math.nan
        try:
            command(message, status)
        except Exception as error:
            status.message = str(error) or type(error).__name__
            raise
        finally:
            self._command_status.publish(status)

    def _check_frame(self, model: Model, header: Header) -> None:
        if header.frame_id not in ("", model.frames["base"]):
            raise SolveError(
                f"frame_id '{header.frame_id}', expected '{model.frames['base']}' or an empty one"
            )

    def _present_motion(self, model: Model) -> tuple[np.ndarray, np.ndarray]:
        motion = self._memory.motion(model)
        if motion is None:
            raise SolveError("no joint state received yet: the position of the robot is unknown")
        return motion

    def _command_target(self, message: PoseStamped, status: CommandStatus) -> None:
        """Publish a command with enough time for its path, and complete the status."""
        served = self._get_served_model()
        model = served.model
        self._check_frame(model, message.header)
        r, R = controlled_pose(model, *pose_numbers(message.pose))
        start, speed = self._present_motion(model)
        found = joints_for(served, self._memory, r, R)
        requested, crossing, least = (
            self._node.get_parameter(name).value
            for name in ("time_from_start", "full_travel", "singularity_margin")
        )
        at, bounds = self._memory.conditions(model), Bounds(crossing, least)
        path = check_path(served.kinematics, start, found, at, bounds, speed, requested)
        # Without velocities, a controller would interpolate linearly and break the limits.
        point = JointTrajectoryPoint(positions=found.joints.tolist(), velocities=[0.0] * len(start))
        point.time_from_start = Duration(seconds=path.seconds).to_msg()
        command = JointTrajectory(joint_names=list(model.joints), points=[point])
        self._motion.send(command, "target_pose")
        status.time_from_start, status.singularity = path.seconds, path.singularity
        status.status = CommandStatus.ACCEPTED
        if path.seconds > requested:
            status.status = CommandStatus.SLOWED
            status.message = f"{path.seconds:.3g} s instead of {requested:.3g} s: {path.why}"
            self._tally.add("target_pose", "slowed", status.message)
        self._warn_outside_region(served, "target_pose", found.joints, r)
        self._tally.add("target_pose", "answered")

    def _command_path(self, message: Path, status: CommandStatus) -> None:
        """Publish the trajectory through the poses of a path, and complete the status."""
        served = self._get_served_model()
        model = served.model
        for header in (message.header, *(pose.header for pose in message.poses)):
            self._check_frame(model, header)
        poses = [pose_numbers(pose.pose) for pose in message.poses]
        if not poses:
            raise SolveError("the path has no poses: expected at least one")
        start, speed = self._present_motion(model)
        crossing, least = (
            self._node.get_parameter(name).value for name in ("full_travel", "singularity_margin")
        )
        fast = np.abs(speed) > MAX_REST_SPEED * rates(model.mechanism, crossing)[0]
        if fast.any():
            i = int(np.argmax(fast))
            raise SolveError(
                f"{model.joints[i]} moves at {speed[i]:.3g} per s: a path begins at rest; send it "
                "when the robot rests"
            )
        r, R = (np.array(part) for part in zip(*poses, strict=True))
        at, of_robot = map(self._memory.conditions, (model, served.guard.model))
        trajectory = plan_cartesian_path(served.guard, start, r, R, of_robot, crossing)
        found = served.kinematics.direct(trajectory.positions, at)
        margins = distances(model, found, at)
        status.singularity = float(np.minimum(margins.direct, margins.inverse).min())
        if status.singularity < least:
            raise SolveError(
                f"the path is too near a singularity: {status.singularity:.3g}, allowed {least:g}"
            )
        self._motion.send(trajectory_message(model.joints, trajectory), "target_path")
        status.status, status.time_from_start = CommandStatus.ACCEPTED, trajectory.seconds
        self._warn_outside_region(served, "target_path", trajectory.positions, found.position)
        self._tally.add("target_path", "answered")
