"""Serves the calibrated direct and inverse problem, and exchanges its model while it runs."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from parallel_cal_msgs.msg import ModelStatus
from parallel_cal_msgs.srv import ComputeFK, ComputeIK, LoadModel
from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from parallel_cal.nodes.file_watch import FileWatch
from parallel_cal.nodes.following import Memory
from parallel_cal.nodes.model_server import Attempt, ModelServer
from parallel_cal.nodes.parameters import LATCHED, declare
from parallel_cal.nodes.requests import answer
from parallel_cal.nodes.run import run
from parallel_cal.nodes.streams import Streams
from parallel_cal.nodes.tally import Tally, model_diagnostics, traffic_diagnostics

PARAMETERS: dict[str, tuple[Any, str]] = {
    "model_file": ("", "model file in use (YAML); setting it loads, a bad file is rejected"),
    "watch_model_file": (True, "load the file again whenever it is written"),
    "time_from_start": (0.1, "s in which a joint command is to be reached"),
    "direction_threshold": (5e-4, "rad or m; smaller motions have no direction of approach"),
}


class KinematicsNode(Node):
    """The kinematics node; topics and services as in the package's documentation."""

    def __init__(self) -> None:
        super().__init__("kinematics_node")
        declare(self, PARAMETERS)
        self._tally, self._failure, self._adopting = Tally(), "", False
        self._memory = Memory(self._parameter("direction_threshold"))
        self._server = ModelServer(self._report)
        self._status = self.create_publisher(ModelStatus, "~/model_status", LATCHED)
        self._changed = self.create_guard_condition(self._reload_changed)
        self._watch = FileWatch(self._changed.trigger)
        self._watch_file()  # before the first load: a change in between is not missed
        self._server.load(_absolute(self._parameter("model_file")), "startup")
        self.add_on_set_parameters_callback(self._on_parameters)
        # What is in this group answers at once; the default group may take its time.
        self._front = MutuallyExclusiveCallbackGroup()
        self._offer_services()
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._streams = Streams(self, self._server, self._memory, self._tally, self._front)
        self.create_timer(1.0, self._tick)

    def _parameter(self, name: str) -> Any:
        return self.get_parameter(name).value

    # ------------------------------------------------------------------ the model in use

    def _report(self, attempt: Attempt) -> None:
        """Tell what came of loading a file, in the log and on ~/model_status."""
        if attempt.ok:
            self.get_logger().info(attempt.reason)
        else:
            self._failure = attempt.reason
            self.get_logger().error(attempt.reason)
        self._status.publish(self._status_message(attempt))

    def _status_message(self, attempt: Attempt) -> ModelStatus:
        message = ModelStatus(ok=attempt.ok, source=attempt.source, reason=attempt.reason)
        message.stamp = self.get_clock().now().to_msg()
        served = self._server.current
        if served is not None:
            message.mechanism = served.model.mechanism.name
            message.effects = [effect.name for effect in served.model.effects]
            message.model_file, message.hash = served.path, served.hash
        return message

    def _on_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        """Load a new model file, or say why the parameter cannot have this value."""
        values = {p.name: p.value for p in parameters}
        for name in ("time_from_start", "direction_threshold"):
            value = values.get(name, 0)
            if not isinstance(value, (int, float)) or not 0 <= value < float("inf"):
                return SetParametersResult(successful=False, reason=f"{name} must be >= 0")
        if "model_file" in values and not self._adopting:
            attempt = self._server.load(_absolute(values["model_file"]), "parameter")
            if not attempt.ok:
                return SetParametersResult(successful=False, reason=attempt.reason)
        if "direction_threshold" in values:
            self._memory.tracker.threshold = values["direction_threshold"]
        watched = values.get("watch_model_file", self._parameter("watch_model_file"))
        self._watch_file(watched, values.get("model_file"))
        return SetParametersResult(successful=True)

    def _watch_file(self, watched: bool | None = None, path: str | None = None) -> bool:
        watched = self._parameter("watch_model_file") if watched is None else watched
        path = self._parameter("model_file") if path is None else path
        return self._watch.watch(_absolute(path) if watched and path else None)

    def _reload_changed(self) -> None:
        self._server.load(_absolute(self._parameter("model_file")), "watch")

    def _load_model(self, request: Any, response: Any) -> Any:
        path = _absolute(request.path)
        attempt = self._server.load(path, "service")
        if attempt.ok:
            self._adopt(path)
        served = self._server.current
        response.success, response.message = attempt.ok, attempt.reason
        response.hash = served.hash if served is not None else ""
        return response

    def _adopt(self, path: str) -> None:
        """Let the parameter and the watch follow what a service has loaded."""
        self._adopting = True
        try:
            self.set_parameters([Parameter("model_file", value=path)])
        finally:
            self._adopting = False

    def _reload(self, request: Any, response: Any) -> Any:
        attempt = self._server.load(_absolute(self._parameter("model_file")), "service")
        response.success, response.message = attempt.ok, attempt.reason
        return response

    # ------------------------------------------------------------------ services

    def _offer_services(self) -> None:
        for type, name in ((ComputeFK, "compute_fk"), (ComputeIK, "compute_ik")):
            on_call = partial(self._answer, name)
            self.create_service(type, f"~/{name}", on_call, callback_group=self._front)
        self.create_service(LoadModel, "~/load_model", self._load_model)
        self.create_service(Trigger, "~/reload", self._reload)

    def _answer(self, name: str, request: Any, response: Any) -> Any:
        served = self._server.current  # one reference for the whole request
        answer(served, self._server.last.reason, request, response)
        self._tally.add(name, "refused" if response.message else "answered", response.message)
        return response

    # ------------------------------------------------------------------ once a second

    def _tick(self) -> None:
        self._catch_up()
        name, served = self.get_fully_qualified_name(), self._server.current
        unheard = self._memory.unheard(served.model) if served and self._memory.heard else []
        message = DiagnosticArray(
            status=[
                model_diagnostics(name, served, self._server.last, self._failure),
                traffic_diagnostics(name, self._tally, unheard),
            ]
        )
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)

    def _catch_up(self) -> None:
        """A folder that was not there could not be watched: look whether it has come."""
        path = self._parameter("model_file")
        if not (path and self._watch.idle and self._parameter("watch_model_file")):
            return
        if self._watch_file() and Path(_absolute(path)).exists():
            self._reload_changed()

    def destroy_node(self) -> None:
        self._watch.stop()
        super().destroy_node()


def _absolute(path: str) -> str:
    return str(Path(path).expanduser().absolute()) if path else ""


def main(args: list[str] | None = None) -> None:
    """`ros2 run parallel_cal kinematics_node --ros-args -p model_file:=robot.yaml`."""
    sys.exit(run(KinematicsNode, args))
