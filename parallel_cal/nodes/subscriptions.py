"""The subscriptions of the calibration node and the queue that they fill."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from operator import attrgetter
from typing import Any, NamedTuple

import geometry_msgs.msg
from rclpy.callback_groups import CallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import QoSProfile, ReliabilityPolicy

from parallel_cal.base.errors import BagError, ParallelCalError
from parallel_cal.imaging.messages import COMPRESSED, IMAGE
from parallel_cal.nodes.calibration_settings import CalibrationSettings
from parallel_cal.nodes.conversions import find_measured_pose, message_class
from parallel_cal.nodes.health import Stream
from parallel_cal.nodes.inflow import Inflow
from parallel_cal.nodes.live_images import LiveImages
from parallel_cal.nodes.managed_node import ManagedNode
from parallel_cal.nodes.parameters import LATCHED, overridable
from parallel_cal.nodes.pump import Messages, Pump
from parallel_cal.recordings.channels import CHANNELS
from parallel_cal.recordings.pose_messages import body_names

# Reliable, and deep enough for minutes of a 1 kHz stream while this process is busy.
STREAM = QoSProfile(depth=100_000)
BEST_EFFORT_STREAM = QoSProfile(depth=100_000, reliability=ReliabilityPolicy.BEST_EFFORT)
MEASURED = ("poses", "readings", "images")  # kinds that a measuring device fills by itself
IMAGES = QoSProfile(depth=10)  # an image is large, and the next one shows as much
BEST_EFFORT_IMAGES = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
LOG_THROTTLE_S = 5.0  # s between two log lines about messages without the pose
STREAMED = ("joints", *MEASURED)  # kinds read in threads of their own, however busy the node is


class ReceivedMessage(NamedTuple):
    """A message of a channel and when it was received, ns."""

    received_ns: int
    channel: str
    message: Any
    sequence: int


class MessageQueue:
    """Holds received messages until they are processed.

    The threads of the subscriptions `put` messages, the thread that spins takes them. `inflow`
    counts the device's messages.
    """

    def __init__(self, node: ManagedNode):
        self._node = node
        self._waiting: deque[ReceivedMessage] = deque()
        self._health = {name: Stream() for name in CHANNELS}
        # When the last messages of channels with two subscriptions were published, ns.
        self._published = {name: deque[int](maxlen=10) for name, c in CHANNELS.items() if c.latched}
        self.inflow = Inflow()

    def put(self, channel: str, message: Any, info: dict[str, int]) -> None:
        """Append a message while the node is active, once if two subscriptions receive it."""
        if not self._node.active:
            return
        published = self._published.get(channel)
        if published is not None:
            if info["source_timestamp"] in published:
                return
            published.append(info["source_timestamp"])
        # When the middleware received it, as a recorder sees it, not when a callback got its turn.
        received = info["received_timestamp"] or time.time_ns()
        sequence = info.get("publication_sequence_number")
        self._health[channel].count_received(sequence)
        self._health[channel].count_answered(received)
        self._waiting.append(ReceivedMessage(received, channel, message, sequence or 0))
        if CHANNELS[channel].kind in MEASURED:
            self.inflow.receive(channel, received)
        elif CHANNELS[channel].kind == "words":
            self.inflow.holds = True

    def take_all(self) -> list[ReceivedMessage]:
        """Remove all messages and return them in the order of reception."""
        # Other threads append meanwhile: only as many as are there now.
        taken = [self._waiting.popleft() for _ in range(len(self._waiting))]
        return sorted(taken, key=attrgetter("received_ns"))

    def diagnoses(self, name: str) -> list[Any]:
        """Return one DiagnosticStatus for each channel that was ever received."""
        return [h.diagnosis(name, channel) for channel, h in self._health.items() if h.total]


class Subscriptions:
    """Subscribes to every channel and puts its messages into a queue.

    Joint states also go to `on_joint_state` at once, in the thread that read them.
    """

    def __init__(
        self,
        node: ManagedNode,
        settings: CalibrationSettings,
        queue: MessageQueue,
        on_joint_state: Callable[[Any], None],
        group: CallbackGroup,
        cameras: Sequence[LiveImages] = (),
    ):
        """Read `measured_pose` as `pose_type`, or the poses of `body` from `driver_type`, as the
        settings state; `cameras` search the images on their topics."""
        self._node, self._queue, self._group = node, queue, group
        self._on_joint_state = on_joint_state
        # Before any thread is started, as it may fail.
        driver_class = _driver_class(settings.get("driver_type"))
        pose_class = driver_class or getattr(geometry_msgs.msg, settings.get("pose_type"))
        self._body = settings.get("body") if settings.get("driver_type") else None
        self._pumps: dict[str, Pump] = {}
        self._rare: dict[str, Any] = {}  # subscriptions in the executor, by their channel
        quiet = SubscriptionEventCallbacks(use_default_callbacks=False)
        for camera in cameras:
            # Each camera searches its images in the thread of its pump.
            type = message_class(COMPRESSED if camera.topic.endswith("/compressed") else IMAGE)
            self._start_pump(camera.camera, camera.topic, type, IMAGES, camera.take)
        for name, channel in CHANNELS.items():
            if channel.kind == "images":
                continue
            type = message_class(channel.types[0])
            if name == "measured_pose":
                type = pose_class
            self._subscribe(name, type, STREAM, qos_overriding_options=overridable())
            if channel.latched:
                # Often published once: the subscription above would miss it, while a latched one
                # alone would not match a publisher that does not latch.
                self._subscribe(name, type, LATCHED, event_callbacks=quiet)

    def end(self) -> None:
        """Read no more messages; call it before the node is destroyed."""
        for pump in self._pumps.values():
            pump.end()

    def follow_publishers(self) -> list[str]:
        """Subscribe best effort to each stream that is published so; return a sentence for each.

        A reliable subscription receives nothing from a best-effort publisher, a best-effort one
        receives from both kinds.
        """
        changes = []
        for channel, pump in list(self._pumps.items()):
            type, topic = pump.type, pump.topic
            if pump.is_reliable and (names := self._find_best_effort_publishers(topic)):
                pump.destroy()
                self._queue.inflow.remove_reader(pump)
                best_effort = BEST_EFFORT_STREAM if channel in CHANNELS else BEST_EFFORT_IMAGES
                self._start_pump(channel, topic, type, best_effort, pump.take)
                changes.append(_describe_best_effort(topic, names))
        for channel, subscription in list(self._rare.items()):
            topic = subscription.topic_name
            if names := self._find_best_effort_publishers(topic):
                self._node.destroy_subscription(self._rare.pop(channel))
                self._subscribe_rare(channel, subscription.msg_type, BEST_EFFORT_STREAM)
                changes.append(_describe_best_effort(topic, names))
        return changes

    def _find_best_effort_publishers(self, topic: str) -> list[str]:
        return sorted(
            f"{p.node_namespace.rstrip('/')}/{p.node_name}"
            for p in self._node.get_publishers_info_by_topic(topic)
            if p.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
        )

    def _subscribe(self, channel: str, type: Any, qos: QoSProfile, **options: Any) -> None:
        if CHANNELS[channel].kind in STREAMED:
            take = partial(self._on_stream, channel)
            self._start_pump(channel, channel, type, qos, take, **options)
            return
        made = self._subscribe_rare(channel, type, qos, **options)
        if qos is STREAM:  # a latched one gets what a reliable publisher stored for it
            self._rare[channel] = made

    def _subscribe_rare(self, channel: str, type: Any, qos: QoSProfile, **options: Any) -> Any:
        """Subscribe to a channel whose few messages the executor can take."""
        on_message = partial(self._queue.put, channel)
        return self._node.create_subscription(
            type, channel, on_message, qos, callback_group=self._group, **options
        )

    def _start_pump(
        self,
        channel: str,
        topic: str,
        type: Any,
        qos: QoSProfile,
        take: Callable[[Messages], None],
        **options: Any,
    ) -> None:
        pump = Pump(self._node, type, topic, qos, take, **options)
        self._pumps[channel] = pump
        if channel == "joint_states":
            self._queue.inflow.joint_reader = pump
        else:
            self._queue.inflow.add_reader(pump)

    def _on_stream(self, channel: str, received: Messages) -> None:
        """Take messages in the thread of their pump."""
        for message, info in received:
            if channel == "joint_states":
                self._on_joint_state(message)
            elif channel == "measured_pose" and self._body is not None:
                message = self._find_body(message, self._body)
                if message is None:
                    continue
            self._queue.put(channel, message, info)

    def _find_body(self, message: Any, body: str) -> Any:
        """Return the pose of the body; None, with a warning, if the driver's message lacks it."""
        try:
            found = find_measured_pose(message, body)
        except BagError as error:
            found, why = None, str(error)
        else:
            why = f"no body '{body}' in it; it holds {', '.join(body_names(message)) or 'no pose'}"
        # A tf topic carries the frames of everybody, each in messages of its own.
        if found is None and not hasattr(message, "transforms"):
            self._node.get_logger().warning(
                f"measured_pose: message without a pose: {why}",
                throttle_duration_sec=LOG_THROTTLE_S,
            )
        return found


def _describe_best_effort(topic: str, publishers: Sequence[str]) -> str:
    return (
        f"{topic} is published best effort by {', '.join(publishers)}, so this node receives it "
        "best effort, too: messages may be lost, and 'lost' counts them"
    )


def _driver_class(name: str) -> Any:
    """Return the class of a driver's message type; None for an empty name."""
    if not name:
        return None
    try:
        return message_class(name)
    except (ImportError, AttributeError, ValueError):
        raise ParallelCalError(
            f"driver_type {name}: not found; expected PACKAGE/msg/TYPE of a package that is "
            "installed and sourced here"
        ) from None
