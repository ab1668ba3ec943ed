"""Collects samples from topics, judges the model on them, and writes the better model file."""

from __future__ import annotations

import os
import time
from collections import deque
from contextlib import suppress
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any

import geometry_msgs.msg
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from parallel_cal_msgs.msg import CollectionStatus
from parallel_cal_msgs.srv import Compare, SaveSamples
from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from std_msgs.msg import String
from std_srvs.srv import Trigger

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.keyed_warning import KeyedWarning, warning_key
from parallel_cal.campaign.cell import Sample
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.model.model import Model
from parallel_cal.model.shelf import forbid_foreign
from parallel_cal.nodes import calibration_messages as messages
from parallel_cal.nodes.calibrator import Calibrator
from parallel_cal.nodes.campaign_server import CampaignServer, NodeAccess
from parallel_cal.nodes.collector import Collection, Collector
from parallel_cal.nodes.conversions import message_class
from parallel_cal.nodes.folders import Folders
from parallel_cal.nodes.frames import DEVICE_FRAME_SENSOR, by_tf
from parallel_cal.nodes.health import Stream
from parallel_cal.nodes.inflow import Inflow
from parallel_cal.nodes.jobs import describe_error
from parallel_cal.nodes.journal import Journal
from parallel_cal.nodes.managed_node import AUTOSTART, ManagedNode
from parallel_cal.nodes.parameters import (
    ACCEPTED,
    LATCHED,
    SECURITY,
    WAITING,
    Setting,
    absolute,
    declare,
    overridable,
)
from parallel_cal.nodes.pump import Messages, Pump
from parallel_cal.nodes.run import (
    create_steady_timer,
    foreign_publishers,
    rival_publishers,
    run,
    type_name,
)
from parallel_cal.nodes.sample_services import SERVICES
from parallel_cal.nodes.tally import diagnostics
from parallel_cal.recordings.channels import CHANNELS, list_channels, register_channels
from parallel_cal.recordings.options import MODES, SampleOptions
from parallel_cal.recordings.recording import Dropped

POSE_TYPES = ("PoseWithCovarianceStamped", "PoseStamped")
# Reliable, and deep enough for minutes of a 1 kHz stream while this process is busy.
STREAM = QoSProfile(depth=100_000)
MEASURED = ("poses", "readings")  # kinds of channels that a measuring device fills by itself
STREAMED = ("joints", *MEASURED)  # those that are read in threads of their own, however busy it is
EXTRA_DWELL_S = 0.3  # s that a campaign rests beyond the least dwell, so that poses enough come
MAX_BUSY_SHARE = 0.25  # largest part of the time spent on looking at what was collected so far

PARAMETERS = {
    "model_file": Setting("", "model file to identify (YAML)"),
    "output_file": Setting("", "file for the calibrated model; empty = model_file"),
    "auto_collect": Setting(True, "sample every standstill; false = only on take_sample"),
    "mode": Setting("auto", "one sample per standstill (dwell) or per pose (continuous)", MODES),
    "min_dwell": Setting(0.3, "shortest dwell, s", (0, 3600)),
    "trim_start": Setting(
        0.1, "time ignored at the start of a dwell, s: the robot settles", (0, 3600)
    ),
    "trim_end": Setting(0.05, "time ignored at the end of a dwell, s", (0, 3600)),
    "still_tolerance": Setting(
        0.0, "motion of a joint at rest, rad or m; 0 = estimated from the data", (0, 1)
    ),
    "joint_sigma": Setting(
        0.0, "1-sigma encoder noise, rad or m; 0 = as in the model file", (0, 1)
    ),
    "hold_out": Setting(0.25, "share of held-out poses if a goal gives none", (0, 0.5)),
    "pose_type": Setting(POSE_TYPES[0], "type of measured_pose", POSE_TYPES, fixed=True),
    "channels": Setting("", "Python paths of your own channels, separated by commas", fixed=True),
    "journal": Setting(True, "write every sample to disk at once", fixed=True),
    "journal_folder": Setting(
        "", "folder of the journal; empty = parallel_cal in ROS_HOME (~/.ros)", fixed=True
    ),
    "record": Setting(False, "while true, record every message to an MCAP file in journal_folder"),
    "arrow_scale": Setting(100.0, "length of a residual arrow divided by the residual", (0, 1e9)),
    "look_period": Setting(
        0.5, "interval at which received messages are processed, s", (0.01, 3600), fixed=True
    ),
    **SECURITY,
    **AUTOSTART,
}


class CalibrationNode(ManagedNode):
    """The calibration node; topics and services are listed in docs/ros.md."""

    def __init__(self) -> None:
        super().__init__("calibration_node")
        self._folders: Folders | None = None  # what is said at the start is trusted
        declare(self, PARAMETERS, self._on_parameters)
        if not self._parameter("allow_foreign_modules"):
            forbid_foreign()
        # One group and not the default one: `run` then calls everything from one thread.
        self._group = MutuallyExclusiveCallbackGroup()
        self._model_joints: tuple[Any, tuple[str, ...] | None] = (None, None)
        self._event, self._trouble, self._next_look = "", "", 0.0
        self._warnings: list[str] = []
        for path in filter(None, self._parameter("channels").split(",")):
            register_channels(path)
        self._waiting: deque[tuple[int, str, Any, int]] = deque()
        self._health = {name: Stream() for name in CHANNELS}
        self._inflow, self._pumps = Inflow(), list[Pump]()
        self._base = ""
        self._dropped_before: list[Dropped] = []
        self._collector = Collector(self._joints(), self._options(), auto=self._auto())
        home = absolute(os.environ.get("ROS_HOME") or "~/.ros")
        self._folder = Path(absolute(self._parameter("journal_folder")) or f"{home}/parallel_cal")
        named = (absolute(self._parameter(name)) for name in ("model_file", "output_file"))
        usual = [self._folder, *(Path(path).parent for path in named if path)]
        self._folders = Folders(self._parameter("allowed_folders"), usual)
        self._recorder: Any = None
        self._journal = self._open_journal()
        self._status = self.create_publisher(CollectionStatus, "~/collection_status", LATCHED)
        self._dropped = self.create_publisher(String, "~/dropped", LATCHED)
        self._calibrator = Calibrator(self, self._collect, self._say, self._group, self._folders)
        here = NodeAccess(
            self._calibrator.files,
            self._take,
            self._folder / "campaigns",
            self._fit_options,
            self._dwell,
            self._inflow,
        )
        calibrator = self._calibrator
        self._campaigning = CampaignServer(
            self, here, calibrator.one, calibrator.worker, self._say, self._group
        )
        self._subscribe()
        self._offer_services()
        create_steady_timer(self._parameter("look_period"), self, self._update_samples, self._group)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        create_steady_timer(1.0, self, self._diagnose, self._group)
        self._dropped.publish(messages.dropped_message([]))
        journal = f"journal in {self._folder}" if self._journal else "no journal"
        model = self._parameter("model_file") or "none: set the parameter model_file"
        self.get_logger().info(f"collecting; model file {model}; {journal}")
        self._publish_status()
        self.start()

    def _open_journal(self) -> Journal | None:
        """The journal that the last run of a node of this name left, or a new one."""
        if not self._parameter("journal"):
            return None
        name = self.get_fully_qualified_name().strip("/").replace("/", ".")
        journal = Journal(self._folder, name)
        try:
            resumed = self._collector.resume(journal.resume())
        except ParallelCalError as error:
            self._trouble = self._event = f"the journal could not be read: {error}"
            self.get_logger().error(self._event)
            return Journal(self._folder, name)
        if resumed:
            self._event = (
                f"{resumed} samples of the previous run were read from {journal.path}; "
                "call clear_samples to discard them"
            )
            self.get_logger().warning(self._event)
        return journal

    def _keep(self) -> None:
        """Make sure of every sample; a disk that is full ends nothing."""
        if self._journal is None:
            return
        try:
            self._journal.keep(self._collector.entries())
        except OSError as error:
            trouble = f"the journal cannot be written: {error.strerror}; samples are in memory only"
            if trouble != self._trouble:
                self._trouble = self._event = trouble
                self.get_logger().error(trouble)
        else:
            self._trouble = ""

    def _parameter(self, name: str) -> Any:
        return self.get_parameter(name).value

    def _auto(self) -> bool:
        return bool(self._parameter("auto_collect"))

    def _options(self) -> SampleOptions:
        names = ("mode", "min_dwell", "trim_start", "trim_end")
        tolerance = self._parameter("still_tolerance") or None
        return SampleOptions(**{n: self._parameter(n) for n in names}, still_tolerance=tolerance)

    def _joints(self) -> tuple[str, ...] | None:
        """The model's joints, read again when the file changes; None while it cannot be read."""
        path = absolute(self._parameter("model_file"))
        if not path:
            return None
        try:
            version = (path, _modified(path))
            if version != self._model_joints[0]:
                model = read_model(path)
                moves = any(sensor.name == DEVICE_FRAME_SENSOR for sensor in model.sensors)
                self._base = "" if moves else model.frames["base"]
                self._model_joints = (version, model.joints)
        except ParallelCalError as error:
            if self._model_joints[0] != str(error):
                self.get_logger().error(f"model file: {error}")
            self._model_joints = (str(error), None)
        return self._model_joints[1]

    def _on_parameters(self, changes: list[Parameter]) -> SetParametersResult:
        """Refuse a model file that cannot be read."""
        named = {c.name: c.value for c in changes if c.name in ("model_file", "output_file")}
        try:
            for name, file in named.items():
                if file and self._folders is not None:
                    self._folders.to_read(file)
                if file and name == "model_file":
                    read_model(absolute(file))
        except Exception as error:  # a user's own mechanism may raise anything
            return SetParametersResult(successful=False, reason=describe_error(error))
        return ACCEPTED

    # ------------------------------------------------------------------ collecting

    def _subscribe(self) -> None:
        quiet = SubscriptionEventCallbacks(use_default_callbacks=False)
        for name, channel in CHANNELS.items():
            type = message_class(channel.types[0])
            if name == "measured_pose":
                type = getattr(geometry_msgs.msg, self._parameter("pose_type"))
            self._listen(name, type, STREAM, overridable())
            if channel.latched:
                # Often said once; the stream above would miss it, while a latched subscription
                # alone would not match a publisher that does not latch.
                self._listen(name, type, LATCHED, event_callbacks=quiet)

    def _listen(
        self, channel: str, type: Any, qos: QoSProfile, overrides: Any = None, **more: Any
    ) -> None:
        if CHANNELS[channel].kind in STREAMED:
            on_messages = partial(self._on_stream, channel)
            more["qos_overriding_options"] = overrides
            pump = Pump(self, type, channel, qos, on_messages, **more)
            self._pumps.append(pump)
            if channel != "joint_states":
                self._inflow.add_reader(pump)
            return
        self.create_subscription(
            type,
            channel,
            partial(self._on_message, channel),
            qos,
            callback_group=self._group,
            qos_overriding_options=overrides,
            **more,
        )

    def _on_message(self, channel: str, message: Any, info: dict[str, int]) -> None:
        """Keep a message until the next look; it was received when it came in, as a recorder sees
        it, not when its turn came here."""
        if not self.active:
            return
        received = info["received_timestamp"] or time.time_ns()
        health = self._health[channel]
        health.count_received(info.get("publication_sequence_number"))
        health.count_answered(received)
        sequence = info.get("publication_sequence_number") or 0
        self._waiting.append((received, channel, message, sequence))
        if CHANNELS[channel].kind in MEASURED:
            self._inflow.receive(channel, received)
        elif CHANNELS[channel].kind == "words":
            self._inflow.holds = True

    def _on_stream(self, channel: str, waiting: Messages) -> None:
        """Messages of a stream, in the thread of its pump."""
        for message, info in waiting:
            if channel == "joint_states":
                self._campaigning.on_joint_state(message)
            self._on_message(channel, message, info)

    def _process_messages(self) -> None:
        """What came since the last look, in the order in which it came."""
        came = [self._waiting.popleft() for _ in range(len(self._waiting))]
        for received, channel, message, sequence in sorted(came, key=itemgetter(0)):
            self._collector.receive(channel, message, received, sequence)
            if CHANNELS[channel].kind in MEASURED:
                self._inflow.process(channel)
            if self._recorder is not None:
                self._record(channel, message, received)

    def _record(self, channel: str, message: Any, received: int) -> None:
        try:
            self._recorder.write(channel, type_name(type(message)), message, received)
        except OSError as error:
            self._stop_recording(f": {error.strerror}")

    def _stop_recording(self, why: str = "") -> None:
        recorder, self._recorder = self._recorder, None
        if recorder is not None:
            with suppress(OSError):
                recorder.close()
            if self.context.ok():  # else nobody hears it any more
                self._say(f"recording ended{why}: {recorder.path}")

    def _follow_record(self) -> None:
        """Begin or end a recording as the parameter says."""
        if self._parameter("record") == (self._recorder is not None):
            return
        if self._recorder is not None:
            self._stop_recording()
            return
        from parallel_cal.nodes.recorder import Recorder  # rosbags costs half a second

        try:
            self._recorder = Recorder(self._folder)
            self._say(f"recording to {self._recorder.path}")
        except OSError as error:
            self.set_parameters([Parameter("record", value=False)])
            self._say(f"cannot record to {self._folder}: {error.strerror}")

    def _update_samples(self) -> None:
        """Make samples of what came in, now and then: it takes longer the more there is."""
        begin = time.monotonic()
        if begin < self._next_look:
            return
        self._refresh()
        if self._trouble:
            self._keep()
        self._follow_record()
        self._warn()
        end = time.monotonic()
        self._next_look = end + (end - begin) / MAX_BUSY_SHARE

    def _warn(self) -> None:
        """Tell what was not told at the last look, in log and status."""
        before, self._warnings = self._warnings, self._suspicions()
        known = set(map(warning_key, before))
        new = [text for text in self._warnings if warning_key(text) not in known]
        for text in new:
            self._event = text
            self.get_logger().warning(text)
        if self._warnings != before:
            self._publish_status()

    def _diagnose(self) -> None:
        """Once a second: the samples and each stream that was ever heard."""
        name, level = self.get_fully_qualified_name(), DiagnosticStatus.OK
        if self._warnings:
            level = DiagnosticStatus.WARN
        if self._trouble:
            level = DiagnosticStatus.ERROR
        said = "; ".join(filter(None, [self._trouble, *self._warnings]))
        status = self._collection_status()
        counts = ("samples", "paired", "dropped", "lost", "strays", "journal", "last_event")
        items = {key: str(getattr(status, key)) for key in counts}
        message = DiagnosticArray(
            status=[
                diagnostics(f"{name}: samples", level, said or "OK", items),
                self._campaigning.diagnosis(name),
                *(h.diagnosis(name, topic) for topic, h in self._health.items() if h.total),
            ]
        )
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)

    def _suspicions(self) -> list[str]:
        """Whatever of the topics or of the samples may be wrong."""
        said = [
            *foreign_publishers(self),
            *rival_publishers(self, list_channels("joints", "poses")),
        ]
        said += self._collector.warnings()
        frame, base = self._collector.frame, self._base
        if frame and base and frame != base:
            words = (
                f"the poses are in frame '{frame}', the model's base is '{base}': the transform "
                "between them is estimated from the samples, unless TF provides it"
            )
            said.append(KeyedWarning(words, "frame", f"{frame} {base}"))
        if registered := self._calibrator.registered:
            said.append(KeyedWarning(registered, "registration"))
        return said

    def _refresh(self) -> None:
        self._process_messages()
        self._collector.configure(self._joints(), self._options(), self._auto())
        samples, trouble = len(self._collector), self._collector.trouble
        if not self._collector.refresh(time.time_ns()):
            return
        dropped = self._collector.dropped()
        if len(self._collector) != samples:
            self._event = f"{len(self._collector)} samples"
        if len(dropped) > len(self._dropped_before):
            last = dropped[-1]
            self._event = f"dropped at {last.time:.2f} s: {last.reason} ({last.detail})"
        if self._collector.trouble and self._collector.trouble != trouble:
            self._event = self._collector.trouble
        self._keep()
        self._publish_status()

    def _collect(self) -> Collection:
        self._refresh()
        return self._collector.collection()

    def _take(self, model: Model) -> Sample:
        """The sample of the dwell going on, for a campaign of a model; DatasetError says why there
        is none."""
        self._refresh()
        entry = self._collector.entries()[self._collector.take()]
        self._keep()
        return Sample(by_tf(entry.alone, model, self._calibrator.look), entry.start_ns)

    def _dwell(self) -> float:
        """s that the robot rests where it is measured."""
        times = (self._parameter(name) for name in ("min_dwell", "trim_start", "trim_end"))
        return float(sum(times)) + EXTRA_DWELL_S

    def _fit_options(self) -> dict[str, Any]:
        sigma = self._parameter("joint_sigma") or None
        return {"hold_out": self._parameter("hold_out"), "joint_sigma": sigma}

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
            lost=c.lost,
            strays=c.strays,
            warnings=self._warnings,
            journal=self._journal.path if self._journal else "",
            last_event=self._event,
        )

    def _say(self, event: str) -> None:
        """An event worth a line in the log and in the status."""
        self._event = event
        self.get_logger().info(event)
        self._publish_status()

    # ------------------------------------------------------------------ services

    def _offer_services(self) -> None:
        assert self._folders is not None
        folders = self._folders
        works: dict[str, Any] = {
            name: (type, partial(f, self._collector, folders))
            for name, (type, f) in SERVICES.items()
        }
        works["compare"] = (Compare, self._calibrator.compare)
        works["undo"] = (Trigger, self._calibrator.undo)
        for name, (type, work) in works.items():
            on_call = partial(self._serve, work)
            self.create_service(
                type, f"~/{name}", on_call, qos_profile=WAITING, callback_group=self._group
            )

    def _serve(self, work: Any, request: Any, response: Any) -> Any:
        """Bring the samples up to date, do it, and answer with a message whatever happens."""
        try:
            if self.refusal:
                raise ParallelCalError(self.refusal)
            self._refresh()
            work(request, response)
            self._keep()
            if isinstance(request, SaveSamples.Request) and self._journal is not None:
                self._journal.close(f"saved to {request.path}")
        except Exception as error:  # whatever it is, the node goes on and the caller hears of it
            self._fail(response, describe_error(error))
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

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._calibrator.cancel()
        return super().on_deactivate(state)

    def end_work(self) -> None:
        """Keep what came in last, however the node ends, and stop what is at work."""
        for pump in self._pumps:
            pump.end()
        self._process_messages()
        self._collector.refresh()
        self._keep()
        self._stop_recording()
        self._calibrator.stop()

    def destroy_node(self) -> None:
        self._campaigning.action.close()
        self._calibrator.close()
        super().destroy_node()


def _modified(path: str) -> int | None:
    """When a file was written, ns; None where there is none."""
    try:
        return Path(path).stat().st_mtime_ns
    except OSError:
        return None


def main(args: list[str] | None = None) -> int:
    """`ros2 run parallel_cal calibration_node --ros-args -p model_file:=robot.yaml`."""
    return run(CalibrationNode, args)
