"""Collects samples from topics, judges the model on them, and writes the better model file."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from trajectory_msgs.msg import JointTrajectory

from parallel_cal.campaign.cell import Sample
from parallel_cal.model.model import Model
from parallel_cal.model.shelf import forbid_foreign
from parallel_cal.nodes.calibration_settings import PARAMETERS, CalibrationSettings
from parallel_cal.nodes.calibrator import Calibrator
from parallel_cal.nodes.cameras import Cameras
from parallel_cal.nodes.campaign_server import CampaignServer, NodeAccess
from parallel_cal.nodes.collection_report import CollectionReport
from parallel_cal.nodes.collector import Collector
from parallel_cal.nodes.frames import lookup
from parallel_cal.nodes.journal import Journal
from parallel_cal.nodes.live_samples import LiveSamples
from parallel_cal.nodes.managed_node import ManagedNode
from parallel_cal.nodes.message_recording import MessageRecording
from parallel_cal.nodes.motion import Motion, TopicMotion, make_trajectory_action
from parallel_cal.nodes.run import (
    WorkerThreadGroup,
    create_steady_timer,
    run,
    run_in_spin_thread,
)
from parallel_cal.nodes.sample_services import SampleServices
from parallel_cal.nodes.subscriptions import MessageQueue, Subscriptions
from parallel_cal.recordings.channels import register_channels

__all__ = ["PARAMETERS", "CalibrationNode", "main"]

MAX_BUSY_SHARE = 0.25  # largest part of the time spent on making samples of what came in


class CalibrationNode(ManagedNode):
    """The calibration node; topics, services and actions are listed in docs/ros.md.

    Messages go from the subscriptions through a queue to the live samples, once every
    `look_period`. Services and actions work on those samples. Samples are made in a thread of their
    own, so that the thread that spins answers meanwhile.
    """

    def __init__(self) -> None:
        super().__init__("calibration_node")
        self._settings = settings = CalibrationSettings(self)
        if not settings.get("allow_foreign_modules"):
            forbid_foreign()
        for path in filter(None, settings.get("channels").split(",")):
            register_channels(path)
        settings.check_model_file()
        # One group and not the default one: `run` then calls everything from one thread.
        group = MutuallyExclusiveCallbackGroup()
        collector = Collector(
            settings.joints(), settings.sample_options(), auto=settings.get("auto_collect")
        )
        name = self.get_fully_qualified_name().strip("/").replace("/", ".")
        journal = Journal(settings.folder, name) if settings.get("journal") else None
        self._report = report = CollectionReport(self, collector, journal)
        self._recording = MessageRecording(self, settings.folder, report.say)
        self._queue, look = MessageQueue(self), lookup(self)
        self._samples = samples = LiveSamples(
            settings, collector, journal, self._queue, self._recording, report, look
        )
        samples.resume()
        self._calibrator = calibrator = Calibrator(
            self, settings, samples.collection, look, report.say, group
        )
        access = NodeAccess(
            calibrator.files,
            self._take,
            settings.folder / "campaigns",
            settings.fit_options,
            settings.dwell,
            self._queue.inflow,
            self._make_motion(group),
        )
        self._campaigning = CampaignServer(
            self, access, calibrator.slot, calibrator.worker, report.say, group
        )
        self._cameras = Cameras(self, settings, self._queue, group)
        self._input = Subscriptions(
            self, settings, self._queue, self._on_joint_state, group, self._cameras.images
        )
        SampleServices(self, samples, settings.folders, calibrator, report, group)
        self._next_update, self._ending = 0.0, False
        create_steady_timer(settings.get("look_period"), self, self._update, WorkerThreadGroup())
        create_steady_timer(1.0, self, self._publish_diagnostics, group)
        where = f"journal in {settings.folder}" if journal else "no journal"
        if journal and (obstacle := journal.describe_obstacle()):
            where = "no journal"
            report.warn(
                f"no journal can be written in {settings.folder}: {obstacle}; samples are in "
                "memory only. Set the parameter journal_folder to a folder that can be written"
            )
        model = settings.get("model_file") or "none: set the parameter model_file"
        self.get_logger().info(f"collecting; model file {model}; {where}")
        report.publish()
        self.start()

    def _on_joint_state(self, message: Any) -> None:
        """Pass on a joint state, in the thread that read it."""
        self._campaigning.on_joint_state(message)
        if self._cameras.images:
            self._cameras.rests.add(message)

    def _make_motion(self, group: MutuallyExclusiveCallbackGroup) -> Motion:
        """Make the way to the robot of campaigns."""
        if action := self._settings.get("trajectory_action"):
            return make_trajectory_action(self, action, group)
        return TopicMotion(self.create_publisher(JointTrajectory, "joint_trajectory", 10))

    def _update(self) -> None:
        """Make samples of what came in, less often the longer it takes; in a worker thread."""
        begin = time.monotonic()
        if begin < self._next_update or self._ending:
            return
        call = partial(run_in_spin_thread, self, meanwhile=self._check_ending)
        self._samples.refresh_beside(call, self._check_ending)
        call(self._follow_samples)
        end = time.monotonic()
        self._next_update = end + (end - begin) / MAX_BUSY_SHARE

    def _check_ending(self) -> None:
        if self._ending:
            raise ExternalShutdownException

    def _follow_samples(self) -> None:
        """Keep, record and report after the samples were made."""
        if self._report.trouble:
            self._samples.keep()  # the disk may have space again
        self._recording.follow(self._settings.get("record"))
        for event in self._cameras.take_events():
            self._report.say(event)
        self._report.update_warnings(
            [
                *self._samples.warnings(),
                *self._calibrator.warnings(),
                *self._cameras.warnings(),
            ]
        )

    def _take(self, model: Model, meanwhile: Callable[[], None]) -> Sample:
        """Return the sample of the present dwell; in the thread of a campaign."""
        call = partial(run_in_spin_thread, self, meanwhile=meanwhile)
        self._samples.refresh_beside(call, meanwhile)
        return call(self._samples.take, model)

    def _publish_diagnostics(self) -> None:
        for event in self._input.follow_publishers():
            self._report.say(event)
        name = self.get_fully_qualified_name()
        self._report.publish_diagnostics(
            self._campaigning.diagnosis(name),
            *self._queue.diagnoses(name),
            *self._cameras.diagnoses(name),
        )

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._calibrator.cancel()
        return super().on_deactivate(state)

    def end_work(self) -> None:
        """Keep what came in last, however the node ends, and stop the work in progress."""
        self._ending = True
        self._input.end()
        self._samples.finish()
        self._recording.stop()
        self._calibrator.stop()

    def destroy_node(self) -> None:
        self._campaigning.action.close()
        self._calibrator.close()
        super().destroy_node()


def main(args: list[str] | None = None) -> int:
    """`ros2 run parallel_cal calibration_node --ros-args -p model_file:=robot.yaml`."""
    return run(CalibrationNode, args)
