"""Collects samples from topics, identifies the model on them, and writes the model file."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import Any

from geometry_msgs.msg import (
    InertiaStamped,
    PointStamped,
    PoseStamped,
    PoseWithCovarianceStamped,
)
from parallel_cal_msgs.action import Identify
from parallel_cal_msgs.msg import CollectionStatus
from parallel_cal_msgs.srv import AddEffect, Compare
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import String
from visualization_msgs.msg import MarkerArray

from parallel_cal.accuracy import Errors
from parallel_cal.errors import ModelFileError, ParallelCalError
from parallel_cal.evidence import Evidence
from parallel_cal.identification import compare
from parallel_cal.modelfile import read_model
from parallel_cal.nodes import calibration_messages as messages
from parallel_cal.nodes.collector import Collection, Collector
from parallel_cal.nodes.identify_server import IdentifyServer, in_words
from parallel_cal.nodes.parameters import LATCHED, declare, overridable
from parallel_cal.nodes.recalibration import Outcome, Request, recalibrate
from parallel_cal.nodes.run import run
from parallel_cal.nodes.sample_services import SERVICES
from parallel_cal.recordings.recording import Dropped
from parallel_cal.recordings.samples import Options

POSE_TYPES = {t.__name__: t for t in (PoseWithCovarianceStamped, PoseStamped)}
# Reliable, and deep enough for minutes of a 1 kHz stream while this process is busy.
STREAM = QoSProfile(depth=100_000)
BUSY = 0.25  # largest part of the time spent on looking at what was collected so far

PARAMETERS: dict[str, tuple[Any, str]] = {
    "model_file": ("", "model file to identify (YAML)"),
    "output_file": ("", "where the result goes; empty = model_file"),
    "auto_collect": (True, "take every standstill; else only those taken by take_sample"),
    "mode": ("auto", "auto | dwell | continuous, see parallel_cal.recordings.samples.Options"),
    "min_dwell": (0.3, "s the robot rests at least"),
    "trim_start": (0.1, "s left out at the start of a dwell, while the robot settles"),
    "trim_end": (0.05, "s left out at its end"),
    "still_tolerance": (0.0, "rad or m a joint may stray at rest; 0 = from the data"),
    "joint_sigma": (0.0, "1-sigma encoder noise, rad or m; 0 = as in the model file"),
    "hold_out": (0.25, "share of the poses left out per fold by add_effect"),
    "pose_type": ("PoseWithCovarianceStamped", "type of measured_pose, or PoseStamped"),
    "arrow_scale": (100.0, "length of residual arrows over the residuals'"),
    "look_period": (0.5, "s between two looks at what came in"),
}


class CalibrationNode(Node):
    """The calibration node; topics and services as in the package's documentation."""

    def __init__(self) -> None:
        super().__init__("calibration_node")
        declare(self, PARAMETERS)
        # One group and not the default one: `run` then calls everything from one thread.
        self._group = MutuallyExclusiveCallbackGroup()
        self._model_joints: tuple[Any, tuple[str, ...] | None] = (None, None)
        self._event, self._next_look = "", 0.0
        self._dropped_before: list[Dropped] = []
        self._collector = Collector(self._joints(), self._options(), auto=self._auto())
        self._status = self.create_publisher(CollectionStatus, "~/collection_status", LATCHED)
        self._dropped = self.create_publisher(String, "~/dropped", LATCHED)
        self._result = self.create_publisher(String, "~/result", LATCHED)
        self._arrows = self.create_publisher(MarkerArray, "~/residuals", LATCHED)
        self._subscribe()
        self._offer_services()
        self._identify = IdentifyServer(self, self._prepare, self._finished, self._say, self._group)
        self.create_timer(self._parameter("look_period"), self._look, callback_group=self._group)
        self._dropped.publish(messages.dropped_message([]))
        self._publish_status()

    def _parameter(self, name: str) -> Any:
        return self.get_parameter(name).value

    def _auto(self) -> bool:
        return bool(self._parameter("auto_collect"))

    def _sigma(self) -> float | None:
        return self._parameter("joint_sigma") or None

    def _options(self) -> Options:
        names = ("mode", "min_dwell", "trim_start", "trim_end")
        tolerance = self._parameter("still_tolerance") or None
        return Options(**{n: self._parameter(n) for n in names}, still_tolerance=tolerance)

    def _joints(self) -> tuple[str, ...] | None:
        """The model's joints, read again when the file changes; None while it cannot be read."""
        path = self._parameter("model_file")
        try:
            version = (path, Path(path).stat().st_mtime_ns) if path else None
            if version != self._model_joints[0]:
                self._model_joints = (version, read_model(path).joints)
        except (OSError, ParallelCalError) as error:
            if self._model_joints[0] != str(error):
                self.get_logger().error(f"model file: {error}")
            self._model_joints = (str(error), None)
        return self._model_joints[1]

    # ------------------------------------------------------------------ collecting

    def _subscribe(self) -> None:
        name = self._parameter("pose_type")
        if name not in POSE_TYPES:
            self.get_logger().error(f"pose_type '{name}': expected {' or '.join(POSE_TYPES)}")
        pose_type = POSE_TYPES.get(name, PoseWithCovarianceStamped)
        streams = {
            "joint_states": JointState,
            "measured_pose": pose_type,
            "measured_position": PointStamped,
            "temperature": Temperature,
            "payload": InertiaStamped,
        }
        for channel, type in streams.items():
            self._listen(channel, type, STREAM, overridable())
        # A payload is often said once, latched; the stream above would miss it, while a latched
        # subscription alone would not match a publisher that does not latch.
        quiet = SubscriptionEventCallbacks(use_default_callbacks=False)
        self._listen("payload", InertiaStamped, LATCHED, event_callbacks=quiet)

    def _listen(self, channel: str, type: Any, qos: QoSProfile, overrides: Any = None,
                **more: Any) -> None:  # fmt: skip
        callback = partial(self._on_message, channel)
        self.create_subscription(
            type,
            channel,
            callback,
            qos,
            callback_group=self._group,
            qos_overriding_options=overrides,
            **more,
        )

    def _on_message(self, channel: str, message: Any) -> None:
        self._collector.receive(channel, message, time.time_ns())

    def _look(self) -> None:
        """Make samples of what came in, now and then: it takes longer the more there is."""
        begin = time.monotonic()
        if begin < self._next_look:
            return
        self._refresh()
        end = time.monotonic()
        self._next_look = end + (end - begin) / BUSY

    def _refresh(self) -> None:
        self._collector.configure(self._joints(), self._options(), self._auto())
        samples, trouble = len(self._collector), self._collector.trouble
        if not self._collector.refresh():
            return
        dropped = self._collector.dropped()
        if len(self._collector) != samples:
            self._event = f"{len(self._collector)} samples"
        if len(dropped) > len(self._dropped_before):
            last = dropped[-1]
            self._event = f"dropped at {last.time:.2f} s: {last.reason} ({last.detail})"
        if self._collector.trouble and self._collector.trouble != trouble:
            self._event = self._collector.trouble
        self._publish_status()

    def _publish_status(self) -> None:
        self._status.publish(self._collection_status())
        dropped = self._collector.dropped()
        if dropped != self._dropped_before:
            self._dropped.publish(messages.dropped_message(dropped))
        self._dropped_before = dropped

    def _collection_status(self) -> CollectionStatus:
        c = self._collector
        return CollectionStatus(
            stamp=self.get_clock().now().to_msg(),
            joint_states_received=c.received["joint_states"],
            poses_received=c.received["measured_pose"] + c.received["measured_position"],
            paired=c.paired,
            dropped=c.dropped_poses,
            samples=len(c),
            last_event=self._event,
        )

    def _say(self, event: str) -> None:
        """An event worth a line in the log and in the status."""
        self._event = event
        self.get_logger().info(event)
        self._publish_status()

    # ------------------------------------------------------------------ services

    def _offer_services(self) -> None:
        own = {"compare": (Compare, self._compare), "add_effect": (AddEffect, self._add_effect)}
        samples = {
            name: (type, partial(f, self._collector)) for name, (type, f) in SERVICES.items()
        }
        for name, (type, work) in {**samples, **own}.items():
            on_call = partial(self._serve, work)
            self.create_service(type, f"~/{name}", on_call, callback_group=self._group)

    def _serve(self, work: Any, request: Any, response: Any) -> Any:
        """Bring the samples up to date, do it, and answer with a message whatever happens."""
        try:
            self._refresh()
            work(request, response)
        except Exception as error:  # whatever it is, the node goes on and the caller hears of it
            self._fail(response, in_words(error))
        if hasattr(response, "message"):
            self._say(response.message)
        if hasattr(response, "status"):
            response.status = self._collection_status()
        return response

    def _fail(self, response: Any, why: str) -> None:
        if not hasattr(response, "message"):  # list_samples: its status says so
            self._say(why)
            return
        response.success, response.message = False, why

    # ------------------------------------------------------------------ judging and identifying

    def _compare(self, request: Any, response: Any) -> None:
        model = read_model(self._model_file(request.model_file))
        collection = self._collector.collection()
        found = compare(model, collection.dataset, self._sigma())
        document = found.document()
        for row in document["rows"]:
            row["id"] = int(collection.ids[row["sample"]])
        response.success, response.json = True, messages.json_text(document)
        response.message = f"{len(collection)} samples compared"
        self._show(found.evidence, found.errors, collection)
        self._publish_result("compare", True, response.message, "", document)

    def _add_effect(self, request: Any, response: Any) -> None:
        if self._identify.busy:
            raise ParallelCalError("an identification is running; cancel it or wait")
        if not request.effect:
            raise ParallelCalError("no effect named, e.g. encoder_eccentricity")
        work = Request(
            **self._files("", request.output_file),
            hold_out=self._parameter("hold_out"),
            joint_sigma=self._sigma(),
            force=request.force,
            effect=request.effect,
        )
        collection = self._collector.collection()
        outcome = recalibrate(work, collection.dataset)
        response.success, response.message = outcome.success, outcome.message
        response.json = messages.json_text(outcome.document) if outcome.document else ""
        response.hash = outcome.hash
        self._finished("add_effect", outcome, collection)

    def _prepare(self, goal: Identify.Goal) -> tuple[Request, Collection]:
        self._refresh()
        work = Request(
            **self._files(goal.model_file, goal.output_file),
            method=goal.method,
            hold_out=goal.hold_out,
            joint_sigma=goal.joint_sigma or self._sigma(),
            free=tuple(goal.free),
            fix=tuple(goal.fix),
            force=goal.force,
        )
        return work, self._collector.collection()

    def _files(self, model_file: str, output_file: str) -> dict[str, Any]:
        model_file = self._model_file(model_file)
        output_file = output_file or self._parameter("output_file") or model_file
        return {"model_file": model_file, "output_file": output_file}

    def _model_file(self, given: str) -> str:
        path = given or self._parameter("model_file")
        if not path:
            raise ModelFileError("no model file: set the parameter model_file or name one")
        return path

    def _finished(self, kind: str, outcome: Outcome, collection: Collection | None) -> None:
        self._publish_result(kind, outcome.success, outcome.message, outcome.hash, outcome.document)
        if outcome.model is not None and collection is not None:
            found = compare(outcome.model, collection.dataset, self._sigma())
            self._show(found.evidence, found.errors, collection)
        if kind == "identify":  # a service says so itself
            self._say(outcome.message)

    def _publish_result(
        self, kind: str, success: bool, message: str, hash: str, document: dict[str, Any]
    ) -> None:
        content = {"kind": kind, "success": success, "message": message, "hash": hash}
        self._result.publish(messages.json_message({**content, "document": document}))

    def _show(self, evidence: Evidence, errors: Errors, collection: Collection) -> None:
        frame, scale = collection.dataset.frame, self._parameter("arrow_scale")
        arrows = messages.residual_markers(evidence, errors, collection.ids, frame, scale)
        self._arrows.publish(arrows)

    def destroy_node(self) -> None:
        self._identify.close()
        super().destroy_node()


def main(args: list[str] | None = None) -> int:
    """`ros2 run parallel_cal calibration_node --ros-args -p model_file:=robot.yaml`."""
    return run(CalibrationNode, args)
