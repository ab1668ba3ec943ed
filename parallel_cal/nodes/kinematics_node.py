"""Provides forward and inverse kinematics, and can exchange its model while it runs."""

from __future__ import annotations

import os
import sys
from functools import partial
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from parallel_cal_msgs.msg import ModelStatus
from parallel_cal_msgs.srv import ComputeFK, ComputeIK, LoadModel
from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from std_msgs.msg import String
from std_srvs.srv import Trigger

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.worker import Worker
from parallel_cal.model.shelf import forbid_foreign
from parallel_cal.nodes import position_ik
from parallel_cal.nodes.computing import prepare
from parallel_cal.nodes.file_watch import FileWatch
from parallel_cal.nodes.folders import Folders
from parallel_cal.nodes.link_transforms import LINK_TRANSFORMS
from parallel_cal.nodes.managed_node import AUTOSTART, ManagedNode
from parallel_cal.nodes.model_server import Attempt, ModelServer
from parallel_cal.nodes.motion import TRAJECTORY_ACTION
from parallel_cal.nodes.parameters import (
    ACCEPTED,
    LATCHED,
    SECURITY,
    WAITING,
    Setting,
    absolute,
    declare,
)
from parallel_cal.nodes.requests import Budget, answer, warm_up
from parallel_cal.nodes.robot_watch import ROBOT_WATCH, RobotWatch
from parallel_cal.nodes.run import WorkerThreadGroup, create_steady_timer, foreign_publishers, run
from parallel_cal.nodes.stream_memory import Memory
from parallel_cal.nodes.streams import Streams
from parallel_cal.nodes.tally import Tally, model_diagnostics, traffic_diagnostics
from parallel_cal.reporting.age import describe_age, is_past

PARAMETERS = {
    "model_file": Setting(
        "", "model file in use (YAML); setting it loads the file, a bad file is rejected"
    ),
    "watch_model_file": Setting(True, "reload the file when it changes"),
    "time_from_start": Setting(0.1, "time in which a joint command is to be reached, s", (0, 3600)),
    "full_travel": Setting(
        1.0, "shortest time to cross the range of a joint without a velocity limit, s", (1e-3, 3600)
    ),
    "singularity_margin": Setting(
        0.02, "smallest allowed scaled singular value on a path, 0 = singular", (0, 1)
    ),
    "request_poses": Setting(
        10_000, "maximum number of configurations or targets in a request", (1, 10**7)
    ),
    "request_time": Setting(5.0, "maximum time for a request, s", (0.01, 3600)),
    "request_memory": Setting(2048, "maximum memory for requests, MB", (64, 10**6), fixed=True),
    "direction_threshold": Setting(5e-4, "smallest motion that has a direction, rad or m", (0, 1)),
    **ROBOT_WATCH,
    **LINK_TRANSFORMS,
    **TRAJECTORY_ACTION,
    **SECURITY,
    **AUTOSTART,
}


class KinematicsNode(ManagedNode):
    """The kinematics node; topics and services are listed in docs/ros.md."""

    def __init__(self) -> None:
        super().__init__("kinematics_node")
        self._folders: Folders | None = None  # parameters at the start may name any file
        declare(self, PARAMETERS, self._on_parameters)
        if not self._parameter("allow_foreign_modules"):
            forbid_foreign()
        file = absolute(self._parameter("model_file"))
        usual = [Path(file).parent] if file else []
        self._folders = Folders(self._parameter("allowed_folders"), usual)
        self._tally, self._failure, self._adopting = Tally(), "", False
        self._memory = Memory(self._parameter("direction_threshold"))
        self._urdf = self.create_publisher(String, "~/robot_description", LATCHED)
        # Other threads only trigger: publishing would fail in them once ROS has shut down.
        described = self.create_guard_condition(self._publish_description)
        self._server = ModelServer(self._report, described.trigger)
        first = partial(prepare, self._parameter("allow_foreign_modules"))
        self._worker = Worker(self._parameter("request_memory"), first)
        self._status = self.create_publisher(ModelStatus, "~/model_status", LATCHED)
        self._changed = self.create_guard_condition(self._reload_changed)
        self._watch = FileWatch(self._changed.trigger)
        self._load(self._parameter("model_file"), "startup")
        # compute_fk and compute_ik wait for the worker process, so they have their own thread.
        requests = WorkerThreadGroup()
        for type, name in ((ComputeFK, "compute_fk"), (ComputeIK, "compute_ik")):
            self._serve(type, name, partial(self._answer, name), requests)
        if position_ik_type := position_ik.find_service_type():
            self._serve(position_ik_type, position_ik.NAME, self._answer_position_ik, requests)
        else:
            self.get_logger().info(f"no service ~/{position_ik.NAME}: moveit_msgs is not installed")
        self._serve(LoadModel, "load_model", self._load_model)
        self._serve(Trigger, "reload", self._reload)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        # The streams must answer at once, so only they are in this group (see FrontExecutor).
        self._front = MutuallyExclusiveCallbackGroup()
        self._streams = Streams(self, self._server, self._memory, self._tally, self._front)
        self._robot_watch = (
            RobotWatch(self, self._server, self._memory) if self._parameter("watch") else None
        )
        self._serve(Trigger, "stop", self._stop)
        create_steady_timer(1.0, self, self._tick)
        self.start()

    def _parameter(self, name: str) -> Any:
        return self.get_parameter(name).value

    # ------------------------------------------------------------------ the model in use

    def _report(self, attempt: Attempt) -> None:
        """Report an attempt to load a file, in the log and on ~/model_status."""
        if attempt.ok:
            self.get_logger().info(attempt.reason)
            self._report_age()
        else:
            self._failure = attempt.reason
            if attempt.source == "startup" and attempt.path and not os.path.lexists(attempt.path):
                # Another node that is launched with this one may write it.
                self.get_logger().warning(f"{attempt.path} does not exist yet; waiting for it")
            else:
                self.get_logger().error(attempt.reason)
        message = ModelStatus(ok=attempt.ok, source=attempt.source, reason=attempt.reason)
        message.stamp = self.get_clock().now().to_msg()
        served = self._server.current
        if served is not None:
            message.mechanism = served.model.mechanism.name
            message.effects = [effect.name for effect in served.model.effects]
            message.model_file, message.hash = served.path, served.hash
        self._status.publish(message)

    def _report_age(self) -> None:
        """Say in the log until when the model in use can be trusted."""
        served = self._server.current
        if served is None:
            return
        words = f"calibration: {describe_age(served.age, self._now)}"
        log = self.get_logger()
        log.warning(words) if is_past(served.age, self._now) else log.info(words)

    @property
    def _now(self) -> float:
        """The time, s since 1970."""
        return 1e-9 * self.get_clock().now().nanoseconds

    def _publish_description(self) -> None:
        served = self._server.current
        if served is not None and served.description is not None:
            self._urdf.publish(String(data=served.description.urdf))

    def _on_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        """Load a new model file, or reject the parameter with the reason."""
        values = {p.name: p.value for p in parameters}
        if "model_file" in values and not self._adopting:
            try:
                path = self._allowed(values["model_file"])
            except ParallelCalError as error:
                return SetParametersResult(successful=False, reason=str(error))
            attempt = self._load(path, "parameter")
            if not attempt.ok:
                return SetParametersResult(successful=False, reason=attempt.reason)
        if "direction_threshold" in values:
            self._memory.tracker.threshold = values["direction_threshold"]
        self._watch_file(**values)
        return ACCEPTED

    def _allowed(self, path: str) -> str:
        """Return a path that a request may name; raise ParallelCalError for another one."""
        return path if self._folders is None else self._folders.to_read(path)

    def _watch_file(self, **changed: Any) -> None:
        names = ("watch_model_file", "model_file")
        watched, path = (changed.get(n, self._parameter(n)) for n in names)
        self._watch.watch(absolute(path) if watched and path else None)

    def _load(self, path: str, source: str) -> Attempt:
        """Load a file; watch it before reading it, so that no change is missed."""
        self._watch_file(model_file=path)
        attempt = self._server.load(absolute(path), source)
        if not attempt.ok:
            self._watch_file()
        elif self._server.current is not None:
            warm_up(self._worker, self._server.current)
        return attempt

    def _reload_changed(self) -> None:
        self._load(self._parameter("model_file"), "watch")

    def _load_model(self, request: Any, response: Any) -> Any:
        try:
            if self.refusal:
                raise ParallelCalError(self.refusal)
            attempt = self._load(self._allowed(request.path), "service")
            if attempt.ok:
                self._adopting = True  # the parameter follows the file that the service loaded
                try:
                    self.set_parameters([Parameter("model_file", value=attempt.path)])
                finally:
                    self._adopting = False
            response.success, response.message = attempt.ok, attempt.reason
        except ParallelCalError as error:
            response.success, response.message = False, str(error)
        served = self._server.current
        response.hash = served.hash if served is not None else ""
        return response

    def _reload(self, request: Any, response: Any) -> Any:
        if self.refusal:
            response.success, response.message = False, self.refusal
            return response
        attempt = self._load(self._parameter("model_file"), "service")
        response.success, response.message = attempt.ok, attempt.reason
        return response

    # ------------------------------------------------------------------ services

    def _serve(self, type: Any, name: str, on_call: Any, group: Any = None) -> None:
        self.create_service(type, f"~/{name}", on_call, qos_profile=WAITING, callback_group=group)

    def _answer(self, name: str, request: Any, response: Any) -> Any:
        if self.refusal:
            response.message = self.refusal
            return response
        served = self._server.current  # read once: the model may be exchanged during the request
        budget = Budget(self._parameter("request_poses"), self._parameter("request_time"))
        answer(self._worker, budget, served, self._server.last.reason, request, response)
        self._tally.add(name, "refused" if response.message else "answered", response.message)
        return response

    def _answer_position_ik(self, request: Any, response: Any) -> Any:
        served = None if self.refusal else self._server.current
        known = self._memory.conditions(served.model) if served else None
        # The directions are those of the last motion, not of one to the target.
        at = known and {k: v for k, v in known.items() if not k.startswith("direction.")}
        seconds, why = self._parameter("request_time"), self.refusal or self._server.last.reason
        position_ik.answer(self._worker, seconds, served, at, why, request, response)
        code = response.error_code
        done = "answered" if code.val == code.SUCCESS else "refused"
        self._tally.add(position_ik.NAME, done, code.message)
        return response

    def _stop(self, request: Any, response: Any) -> Any:
        """Stop the robot; an inactive node does it, too."""
        try:
            self._streams.stop()
            response.success = True
        except ParallelCalError as error:
            response.message = str(error)
        return response

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._streams.withdraw()
        return super().on_deactivate(state)

    # ------------------------------------------------------------------ once a second

    def _tick(self) -> None:
        name, served = self.get_fully_qualified_name(), self._server.current
        unheard = self._memory.unheard(served.model) if served and self._memory.heard else []
        message = DiagnosticArray(
            status=[
                model_diagnostics(name, served, self._server.last, self._failure, self._now),
                traffic_diagnostics(name, self._tally, unheard, foreign_publishers(self)),
                *self._streams.diagnoses(name),
                *([self._robot_watch.diagnose(name)] if self._robot_watch else []),
            ]
        )
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)

    def end_work(self) -> None:
        """Stop the streams, the threads and the worker process."""
        self._streams.end()
        self._server.wait_until_compiled()
        if self._robot_watch:
            self._robot_watch.end()
        self._worker.end()

    def destroy_node(self) -> None:
        self.end_work()
        self._watch.stop()
        super().destroy_node()


def main(args: list[str] | None = None) -> None:
    """`ros2 run parallel_cal kinematics_node --ros-args -p model_file:=robot.yaml`."""
    sys.exit(run(KinematicsNode, args))
