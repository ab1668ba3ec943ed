"""Goals of the calibration node, ROS-free: identify and write the better model, or diagnose."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import Any

from parallel_cal.base.errors import ModelFileError, ParallelCalError
from parallel_cal.base.files import write_atomically
from parallel_cal.diagnosis.diagnose import Diagnosis, diagnose
from parallel_cal.identification.observations import observe
from parallel_cal.identification.options import FitOptions
from parallel_cal.identification.prediction_errors import errors
from parallel_cal.model.file.modelfile import (
    model_hash,
    model_text,
    parse_model,
    read_model,
    write_model,
)
from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.session.steps import Step, added, fitted

PREVIOUS = ".previous"  # behind the name of a model file that was replaced
Tell = Callable[[str, float, float], None]  # stage, fraction, mean position error so far in m


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
    """What to identify and how, with one more `effect` if one is named, and where the better model
    goes; `force` writes one that is not proven better, too."""

    model_file: str
    output_file: str
    options: FitOptions = field(default_factory=FitOptions)
    force: bool = False
    effect: str = ""


@dataclass(frozen=True)
class Outcome:
    """What came of it: a sentence, a document and what it is made of; a hash if a file was
    written."""

    success: bool
    message: str
    document: dict[str, Any] = field(default_factory=dict)
    hash: str = ""
    step: Step | None = None
    diagnosis: Diagnosis | None = None
    path: str = ""

    @property
    def model(self) -> Model | None:
        """The new model, or the best one found."""
        if self.diagnosis is not None:
            return self.diagnosis.best.fitted.model
        return None if self.step is None else self.step.model


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
        report("reading the model file", 0.0)
        model = read_model(request.model_file)
        seen = observe(model, dataset, request.options.joint_sigma)
        position_error = _or_nan(errors(model, seen).summary.position_mean)
        # Whether it may be written is judged later, as a message.
        how: dict[str, Any] = {"force": True, "options": request.options, "progress": report}
        if request.effect:
            step = added(model, request.effect, dataset, **how)
        else:
            step = fitted(model, dataset, **how)
        position_error = _or_nan(step.result.after.summary.position_mean)
        report("judging", 1.0)
        return _written(request, step, cancel)
    except ParallelCalError as error:
        return Outcome(False, str(error))


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


def _written(request: Request, step: Step, cancel: Cancel) -> Outcome:
    reason, document = step.acceptance.against, step.document()
    if reason and not request.force:
        message = f"{reason}; nothing was written (force writes it all the same)"
        return Outcome(False, message, document, step=step)
    cancel.commit()
    _keep_previous(request.output_file)
    write_model(step.model, request.output_file)
    although = f" by force although {reason}" if reason else ""
    message = f"{step.acceptance.errors}; written to {request.output_file}{although}"
    hash = model_hash(step.model)
    return Outcome(True, message, document, hash, step, path=request.output_file)


def _keep_previous(path: str) -> None:
    """Lay a model file that is about to be replaced aside, beside itself."""
    if Path(path).exists():
        _write(path + PREVIOUS, model_text(path))


def undone(path: str) -> str:
    """Exchange a model file with the one that it replaced; a sentence. ModelFileError where there
    is none, or it can no longer be read."""
    before = path + PREVIOUS
    if not Path(before).exists():
        raise ModelFileError(f"{path}: nothing to undo, there is no {before}")
    text, now = model_text(before), model_text(path)
    parse_model(text, before)
    _write(path, text)
    _write(before, now)
    return f"{path}: {model_hash(text)[:12]} again, was {model_hash(now)[:12]}"


def _write(path: str, text: str) -> None:
    try:
        write_atomically(path, text)
    except OSError as error:
        raise ModelFileError(f"{path}: cannot be written: {error.strerror}") from None


def examine(
    model_file: str,
    dataset: Dataset,
    options: FitOptions,
    tell: Callable[[str, float], None],
    cancel: Cancel,
) -> Outcome:
    """Diagnose a model file on samples; it writes nothing, and a failure is a message.

    Cancelled comes through at the next step.
    """
    done = 0.0

    def report(stage: str, fraction: float) -> None:
        nonlocal done
        cancel.check()
        done = max(done, fraction)  # a search that begins anew does not take anything back
        tell(stage, done)

    try:
        report("reading the model file", 0.0)
        found = diagnose(read_model(model_file), dataset, options=options, progress=report)
    except ParallelCalError as error:
        return Outcome(False, str(error))
    message = f"{found.verdict.word}: {found.verdict.summary}"
    return Outcome(True, message, found.document(), diagnosis=found)
