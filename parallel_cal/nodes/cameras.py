"""The cameras of the calibration node: what they show, and what is said about it."""

from __future__ import annotations

from collections import deque
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage

from parallel_cal.imaging.drawing import draw_corners
from parallel_cal.imaging.messages import describe_lens
from parallel_cal.nodes.calibration_settings import CalibrationSettings
from parallel_cal.nodes.live_images import LiveImages, Look, RestMemory, SeenBoard
from parallel_cal.nodes.parameters import LATCHED
from parallel_cal.nodes.subscriptions import MessageQueue
from parallel_cal.nodes.tally import diagnostics
from parallel_cal.recordings.channels import CORNERS
from parallel_cal.recordings.images import camera_topics


class Cameras:
    """Searches the images on the topics of the parameter `images` for the board.

    Every image that was searched is published on `~/CAMERA/board`, with the corners drawn. `events`
    holds in words what the images showed, until `take_events`.
    """

    def __init__(
        self, node: Node, settings: CalibrationSettings, queue: MessageQueue, group: CallbackGroup
    ):
        self._node, self._settings, self._queue = node, settings, queue
        self._events: deque[str] = deque(maxlen=20)
        self.rests = RestMemory(lambda: settings.known_joints, settings.find_rest_tolerance)
        self._lenses: dict[str, str] = {}
        self._pictures: dict[str, Any] = {}
        topics = {
            camera: topic.strip()
            for camera, topic in camera_topics(settings.get("images").split(",")).items()
        }
        self.images = [
            LiveImages(
                camera,
                topic,
                settings.board(),
                self.rests,
                lambda: float(settings.get("trim_start")),
                self._on_board,
                queue.inflow.note_unusable,
                self._on_look,
            )
            for camera, topic in topics.items()
        ]
        for camera, topic in topics.items():
            self._pictures[camera] = node.create_publisher(
                CompressedImage, f"~/{camera}/board", LATCHED
            )
            folder = topic.removesuffix("/compressed").rpartition("/")[0]
            node.create_subscription(
                CameraInfo,
                f"{folder}/camera_info" if folder else "camera_info",
                partial(self._on_lens, camera),
                1,
                callback_group=group,
            )

    def take_events(self) -> list[str]:
        """Return what images have shown since the last call."""
        return [self._events.popleft() for _ in range(len(self._events))]

    def warnings(self) -> list[str]:
        """List what keeps images from being used, one sentence for each camera."""
        if self._settings.camera_board and not self.images:
            return [
                "the model has a camera, but no topic of images is stated: set the parameter images"
            ]
        return [one.warning for one in self.images if one.warning]

    def diagnoses(self, name: str) -> list[Any]:
        """Return one DiagnosticStatus for each camera."""
        return [
            diagnostics(
                f"{name}: {one.camera}",
                DiagnosticStatus.WARN if one.warning else DiagnosticStatus.OK,
                one.warning or one.last,
                one.items(),
            )
            for one in self.images
        ]

    def _on_board(self, seen: SeenBoard) -> None:
        self._queue.put(CORNERS, seen, {"received_timestamp": seen.received})

    def _on_look(self, look: Look) -> None:
        """Say and draw what an image shows; in the thread of its camera."""
        used = "image not used: " if look.corners.problem else ""
        self._events.append(f"{look.camera}: {used}{look.words}")
        picture = CompressedImage(format="jpeg", data=draw_corners(look.image, look.corners))
        picture.header.stamp = self._node.get_clock().now().to_msg()
        self._pictures[look.camera].publish(picture)

    def _on_lens(self, camera: str, message: Any) -> None:
        """Say once which lens a camera's driver states."""
        lens = describe_lens(message)
        if lens and lens != self._lenses.get(camera):
            self._events.append(f"{camera}: its driver states the lens; sensor: camera: {{{lens}}}")
        self._lenses[camera] = lens
