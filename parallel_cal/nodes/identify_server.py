"""The identify action: what a goal asks for, and what it is answered."""

from __future__ import annotations

import math
from typing import Any

from parallel_cal_msgs.action import Identify

from parallel_cal.identification.options import FitOptions
from parallel_cal.nodes.action_work import Finished, Job, Prepare
from parallel_cal.nodes.calibration_messages import json_text
from parallel_cal.session.recalibration import Outcome, Request


def identify_job(prepare: Prepare, finished: Finished) -> Job:
    """`~/identify`."""
    running = "an identification is running; cancel it or wait"
    return Job("identify", Identify, running, prepare, finished, result_message)


def request_of(goal: Identify.Goal, files: dict[str, Any], joint_sigma: float | None) -> Request:
    """What a goal asks for; `joint_sigma` where it names none."""
    return Request(
        **files,
        options=FitOptions(
            method=goal.method or "implicit",
            hold_out=goal.hold_out,
            joint_sigma=goal.joint_sigma or joint_sigma,
            free=tuple(goal.free),
            fix=tuple(goal.fix),
        ),
        force=goal.force,
    )


def result_message(outcome: Outcome) -> Identify.Result:
    """NaN for errors that are not known."""
    document = outcome.document
    held_out = document.get("held_out", {})
    return Identify.Result(
        success=outcome.success,
        message=outcome.message,
        json=json_text(document) if document else "",
        hash=outcome.hash,
        position_before=_mean(document.get("before")),
        position_after=_mean(document.get("after")),
        held_out_before=_mean(held_out.get("before")),
        held_out_after=_mean(held_out.get("after")),
    )


def _mean(errors: dict[str, float | None] | None) -> float:
    value = (errors or {}).get("position_mean")
    return math.nan if value is None else value
