"""A goal of the calibration node, ROS-free: fit, judge, write the file only if it is better."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from threading import Lock
from typing import Any

from parallel_cal.base.errors import FitError, ParallelCalError
from parallel_cal.identification.fit import Progress, Result
from parallel_cal.identification.observations import observe
from parallel_cal.identification.prediction_errors import Summary, errors, held_out_ratio
from parallel_cal.model.file.modelfile import model_hash, read_model, write_model
from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.session.steps import Step, added, fitted

Tell = Callable[[str, float, float], None]  # stage, fraction, mean position error so far in m
UNITS = {
    "position": (1e6, "um"),
    "orientation": (1e6, "urad"),
    "reading": (1e6, "um"),
    "joint": (1e6, "urad"),
}


class Cancelled(Exception):
    """The goal was cancelled; nothing was written."""


class Cancel:
    """Either the goal is cancelled or the file is written, never both."""

    def __init__(self) -> None:
        self._lock, self._asked, self._committed = Lock(), False, False

    def ask(self) -> bool:
        """Ask the work to stop; False when it is too late."""
        with self._lock:
            self._asked = not self._committed
            return self._asked

    def check(self) -> None:
        """Raise Cancelled if it was asked for."""
        if self._asked:
            raise Cancelled

    def commit(self) -> None:
        """From here on it is too late to cancel; Cancelled if it already was."""
        with self._lock:
            self.check()
            self._committed = True


@dataclass(frozen=True)
class Request:
    """What to identify, and where the better model goes.

    `free` names parameters to identify in addition to those that the model leaves free; with
    `hold_out` 0 the new model is judged at the samples used.
    """

    model_file: str
    output_file: str
    method: str = "implicit"
    hold_out: float = 0.25
    joint_sigma: float | None = None
    free: tuple[str, ...] = ()
    fix: tuple[str, ...] = ()
    force: bool = False
    effect: str = ""


@dataclass(frozen=True)
class Outcome:
    """What came of it: a sentence, fit's document and the model; a hash if a file was written."""

    success: bool
    message: str
    document: dict[str, Any] = field(default_factory=dict)
    hash: str = ""
    model: Model | None = None


def recalibrate(
    request: Request, dataset: Dataset, tell: Tell | None = None, cancel: Cancel | None = None
) -> Outcome:
    """Identify a model file on samples and write the better model; a failure is a message.

    Cancelled comes through at the next step of the work, and then nothing is written.
    """
    cancel, position_error = cancel or Cancel(), math.nan

    def report(stage: str, fraction: float) -> None:
        cancel.check()
        if tell:
            tell(stage, fraction, position_error)

    try:
        check_share(request.hold_out)
        report("reading the model file", 0.0)
        model = read_model(request.model_file)
        position_error = _position_error(model, dataset, request.joint_sigma)
        step = _step(request, model, dataset, report)
        position_error = _or_nan(step.result.after.summary.position_mean)
        report("judging", 1.0)
        return _written(request, step, cancel)
    except ParallelCalError as error:
        return Outcome(False, str(error))


def check_share(hold_out: float) -> None:
    """FitError for a share of the poses that is none; too large ones are refused by the fit."""
    if not hold_out >= 0:
        raise FitError(f"hold_out {hold_out}: expected 0 (no check) to 0.5")


def _position_error(model: Model, dataset: Dataset, joint_sigma: float | None) -> float:
    return _or_nan(errors(model, observe(model, dataset, joint_sigma)).summary.position_mean)


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


def _step(request: Request, model: Model, dataset: Dataset, report: Progress) -> Step:
    options = {
        "method": request.method or "implicit",
        "free": request.free,
        "fix": request.fix,
        "hold_out": request.hold_out,
        "joint_sigma": request.joint_sigma,
        "progress": report,
    }
    if request.effect:  # judged below
        return added(model, request.effect, dataset, force=True, **options)
    return fitted(model, dataset, **options)


def _written(request: Request, step: Step, cancel: Cancel) -> Outcome:
    reason, document = refusal(step, request.hold_out), step.document()
    if reason and not request.force:
        message = f"{reason}; nothing was written (force writes it all the same)"
        return Outcome(False, message, document, model=step.model)
    cancel.commit()
    write_model(step.model, request.output_file)
    although = f" by force although {reason}" if reason else ""
    message = f"{summary(step.result)}; written to {request.output_file}{although}"
    return Outcome(True, message, document, model_hash(step.model), step.model)


def refusal(step: Step, hold_out: float) -> str:
    """Why the new model must not replace the old one; empty when it may.

    Judged at poses that the fit did not see: against the model before, or, for an added effect,
    against the same identification without it. Without a held-out check, at the samples used.
    """
    before, after, where = sides(step.result)
    if hold_out > 0 and where != HELD_OUT:
        return "the error at poses left out is not known: too few poses to leave some out"
    what = "before"
    if step.rival is not None and where == HELD_OUT:
        before, what = step.rival.held_out.summary, "without the effect"
    ratio = held_out_ratio(before, after)
    if ratio is not None and ratio < 1:
        return ""
    return f"the error {where} does not fall: {in_words(before)} {what}, {in_words(after)} now"


HELD_OUT, AT_SAMPLES = "at poses left out", "at the samples used"


def sides(result: Result) -> tuple[Summary, Summary, str]:
    """The errors that count, before and after, and where they were taken."""
    if result.held_out.summary.known:
        return result.held_out_before.summary, result.held_out.summary, HELD_OUT
    return result.before.summary, result.after.summary, AT_SAMPLES


def summary(result: Result) -> str:
    """One sentence: the error before and after, and where it was taken."""
    before, after, where = sides(result)
    return f"mean error {where} {in_words(before)} -> {in_words(after)}"


def in_words(errors: Summary) -> str:
    """The mean error of the first kind that was measured, with its unit."""
    for kind, (scale, unit) in UNITS.items():
        value = errors.mean(kind)
        if value is not None:
            return f"{value * scale:.3g} {unit}"
    return "unknown"
