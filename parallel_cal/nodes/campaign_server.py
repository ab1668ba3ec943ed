"""The action `~/calibrate`: a campaign with the robot on this node's topics."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from parallel_cal_msgs.action import Calibrate
from parallel_cal_msgs.msg import CalibrationStatus, Question
from rclpy.callback_groups import CallbackGroup
from std_msgs.msg import String
from std_srvs.srv import Trigger

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.worker import WorkCancelled, Worker
from parallel_cal.campaign.campaign import Campaign
from parallel_cal.campaign.cell import Control, Sample
from parallel_cal.campaign.goal import Goal
from parallel_cal.campaign.journal import find_unfinished
from parallel_cal.campaign.status import Curve, Outcome, Status, write_improved_model
from parallel_cal.identification.recheck import CERTAINTY
from parallel_cal.model.file.modelfile import model_text, parse_model
from parallel_cal.model.mechanism import Box
from parallel_cal.model.model import Model
from parallel_cal.nodes.calibration_messages import json_message, json_text
from parallel_cal.nodes.inflow import Inflow
from parallel_cal.nodes.jobs import Job, JobServer, Say, ThreadWork, WorkSlot
from parallel_cal.nodes.managed_node import ManagedNode
from parallel_cal.nodes.motion import Motion
from parallel_cal.nodes.parameters import LATCHED
from parallel_cal.nodes.robot_cell import RobotCell
from parallel_cal.nodes.tally import diagnostics
from parallel_cal.session import goals

POSES, UPDATE_POSES, MINUTES = 80, 24, 60.0  # if a goal gives none
LEVELS = {"stopped": b"\x02", "asking": b"\x01", "paused": b"\x01"}


@dataclass(frozen=True)
class NodeAccess:
    """What a campaign needs of the node.

    `files` returns where a goal's model is read and the better one is written. `take` returns the
    sample of the current dwell; it is called in another thread than the one that spins, with a
    function to call while it waits. `folder` contains all campaigns. `options` returns those of a
    fit, `dwell` the time to rest in s. `inflow` counts the device's messages. `motion` sends
    trajectories to the robot.
    """

    files: Callable[[str, str], tuple[str, str]]
    take: Callable[[Model, Callable[[], None]], Sample]
    folder: Path
    options: Callable[[], dict[str, Any]]
    dwell: Callable[[], float]
    inflow: Inflow
    motion: Motion


class CampaignServer:
    """Provides `~/calibrate`, `~/pause`, `~/resume`, `~/continue`; publishes `~/session_status`
    and `~/campaign_curve`."""

    def __init__(
        self,
        node: ManagedNode,
        access: NodeAccess,
        slot: WorkSlot,
        worker: Worker,
        say: Say,
        group: CallbackGroup,
    ):
        self._node, self._access, self._slot = node, access, slot
        self._worker, self._say = worker, say
        self._control: Control | None = None
        self._cell: RobotCell | None = None
        self._status = CalibrationStatus(state="done", reason="idle", error_unseen=math.nan)
        self._status_publisher = node.create_publisher(
            CalibrationStatus, "~/session_status", LATCHED
        )
        self._status_publisher.publish(self._status)
        self._curve_publisher = node.create_publisher(String, "~/campaign_curve", LATCHED)
        self._curve = Curve()
        self._curve_publisher.publish(json_message(asdict(self._curve)))
        job = Job(
            "calibrate",
            Calibrate,
            "a calibration is running; cancel it or wait",
            self._prepare,
            self._on_finished,
            _make_result,
        )
        self.action = JobServer(node, slot, job, say, group)
        for name, work in (
            ("pause", self._pause),
            ("resume", self._resume),
            ("continue", self._continue),
        ):
            node.create_service(Trigger, f"~/{name}", work, callback_group=group)

    def on_joint_state(self, message: Any) -> None:
        """Pass on a joint state; may be called in any thread."""
        if (cell := self._cell) is not None:
            cell.on_joint_state(message)

    def diagnosis(self, name: str) -> Any:
        """Return a DiagnosticStatus with the state of the campaign and its reason."""
        status = self._status
        items = {
            "poses": str(status.poses),
            "error_unseen": f"{status.error_unseen:.3g}",
            "verdict": status.verdict,
            "folder": status.folder,
        }
        level = LEVELS.get(status.state, b"\x00")
        return diagnostics(f"{name}: session", level, f"{status.state}: {status.reason}", items)

    # ------------------------------------------------------------------ one goal

    def _prepare(self, goal: Any) -> tuple[ThreadWork, None]:
        """Turn a goal into a campaign: a new one, or the unfinished one of the same model."""
        model_file, output_file = self._access.files(goal.model_file, goal.output_file)
        text = model_text(model_file)
        wanted = _read_goal(goal, self._access.options())
        cancel = self._slot.cancel
        control = Control(lambda: cancel.asked)
        model = parse_model(text, model_file)

        cell = RobotCell(
            self._access.motion,
            model,
            partial(self._access.take, model),
            self._access.dwell(),
            self._access.inflow,
            self._publish_reason,
        )
        unfinished = (
            None if goal.afresh else find_unfinished(self._access.folder, text, goal.update)
        )
        folder = unfinished or self._access.folder / time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
        self._control, self._cell = control, cell

        def run(tell: Callable[..., None]) -> goals.Outcome:
            return self._run(folder, text, wanted, cell, control, tell)

        def finish(outcome: goals.Outcome) -> goals.Outcome:
            assert isinstance(outcome, Outcome)
            return write_improved_model(outcome, output_file)

        return ThreadWork(run, finish), None

    def _run(
        self,
        folder: Path,
        text: str,
        wanted: Goal,
        cell: RobotCell,
        control: Control,
        tell: Callable[..., None],
    ) -> goals.Outcome:
        """Run the campaign, in a thread of its own."""

        def work(function: Callable[..., Any], *given: Any) -> Any:
            try:
                return self._worker.work(function, *given, wanted=lambda: control.should_continue)
            except WorkCancelled:
                control.check_interrupted()
                raise

        publish = partial(self._publish_status, folder, tell)
        campaign = Campaign(folder, text, wanted, cell, publish, work, control)
        try:
            return campaign.run()
        finally:
            campaign.close()
            self._control, self._cell = None, None

    def _publish_status(self, folder: Path, tell: Callable[..., None], status: Status) -> None:
        """Publish the status of a campaign and send it to the goal's client as feedback."""
        with suppress(Exception):  # a context that ends must not leave a robot moving
            questions = [Question(**vars(question)) for question in status.questions]
            self._status = CalibrationStatus(
                stamp=self._node.get_clock().now().to_msg(),
                state=status.state,
                reason=status.reason,
                poses=status.samples,
                error_unseen=status.unseen,
                verdict=status.verdict,
                folder=str(folder),
                purpose=status.purpose,
                questions=questions,
            )
            self._status_publisher.publish(self._status)
            if status.curve != self._curve:
                self._curve = status.curve
                self._curve_publisher.publish(json_message(asdict(self._curve)))
            tell(
                status.state,
                status.reason,
                status.samples,
                status.unseen,
                status.verdict,
                status.purpose,
                questions,
            )

    def _publish_reason(self, reason: str) -> None:
        """Publish what the current state is waiting for."""
        self._status.reason = reason
        self._status_publisher.publish(self._status)

    def _on_finished(self, outcome: goals.Outcome, collection: Any) -> None:
        self._say(outcome.message)

    # ------------------------------------------------------------------ commands of a person

    def _pause(self, request: Any, response: Any) -> Any:
        return self._control_campaign(
            response, lambda control, cell: control.pause(), "the calibration will pause"
        )

    def _resume(self, request: Any, response: Any) -> Any:
        return self._control_campaign(
            response, lambda control, cell: control.resume(), "the calibration continues"
        )

    def _continue(self, request: Any, response: Any) -> Any:
        if self._status.state != "asking":
            response.message = "the calibration asks for nothing at present"
            return response
        return self._control_campaign(
            response, lambda control, cell: cell.done.set(), "the calibration continues"
        )

    def _control_campaign(self, response: Any, do: Callable[[Any, Any], None], words: str) -> Any:
        control, cell = self._control, self._cell
        response.success = control is not None and cell is not None
        if response.success:
            do(control, cell)
        response.message = words if response.success else "no calibration is running"
        return response


def _read_goal(goal: Any, options: dict[str, Any]) -> Goal:
    """Convert the action's goal; zeros mean the default."""
    if len(goal.keep_out) % 6:
        raise ParallelCalError("keep_out: expected six numbers for each box, x y z x y z in m")
    # The two corners of each box come in any order.
    corners = np.sort(np.reshape(goal.keep_out, (-1, 2, 3)), axis=1).tolist()
    return Goal(
        poses=goal.poses or (UPDATE_POSES if goal.update else POSES),
        minutes=goal.minutes or MINUTES,
        enough=goal.enough,
        effects=tuple(goal.effects),
        keep_out=tuple(Box(tuple(low), tuple(high)) for low, high in corners),
        payload=goal.payload,
        warmer=goal.warmer,
        reach=goal.reach or 1.0,
        update=goal.update,
        certainty=goal.certainty or CERTAINTY,
        **options,
    )


def _make_result(outcome: goals.Outcome) -> Any:
    return Calibrate.Result(
        success=outcome.success,
        message=outcome.message,
        verdict=outcome.verdict,
        json=json_text(outcome.document) if outcome.document else "",
        hash=outcome.hash,
    )
