"""Goals of the calibration node, without ROS: identify and write the better model, or diagnose.

The long computations are functions that write nothing and return picklable values, so that they can
run in another process.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from parallel_cal.base.errors import ModelFileError, ParallelCalError
from parallel_cal.base.files import BACKUP_SUFFIX
from parallel_cal.base.progress import never_falling
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.identification.given_model import GivenModel
from parallel_cal.identification.options import FitOptions
from parallel_cal.model.file.modelfile import (
    model_hash,
    model_text,
    parse_model,
    read_model,
    readable_text,
    replace_text,
    write_text,
)
from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.session.steps import add, fitted

UNKNOWN = (math.nan,) * 4
Tell = Callable[[str, float, float], None]  # stage, fraction, mean position error so far in m


@dataclass(frozen=True)
class Request:
    """What to fit, how, and where to write the model. `effect` is the name of an effect to add;
    `force` writes the model even if it is not proven better."""

    model_file: str
    output_file: str
    options: FitOptions = field(default_factory=FitOptions)
    force: bool = False
    effect: str = ""


@dataclass(frozen=True)
class Outcome:
    """Outcome of a goal: a sentence and a document.

    `text` is the new or best model as a model file; `hash` and `path` are set once it is written.
    `means` are mean position errors in m: before, after, and both at held-out poses; NaN if not
    known.
    """

    success: bool
    message: str
    document: dict[str, Any] = field(default_factory=dict)
    text: str = ""
    means: tuple[float, ...] = UNKNOWN
    verdict: str = ""
    hash: str = ""
    path: str = ""

    @property
    def model(self) -> Model | None:
        """The new model, or the best one found."""
        return parse_model(self.text) if self.text else None


def propose_model(request: Request, dataset: Dataset, tell: Tell | None = None) -> Outcome:
    """Fit a model file to samples. `write_proposal` writes a success; a failure is a message."""
    position_error = math.nan

    def report(stage: str, fraction: float) -> None:
        if tell:
            tell(stage, fraction, position_error)

    try:
        report("reading the model file", 0.0)
        model = read_model(request.model_file)
        given = GivenModel.of(model, dataset, request.options.joint_sigma, request.options.insist)
        position_error = _or_nan(given.errors.summary.position_mean)
        # Force the step here: the request decides below whether its model may be written.
        how: dict[str, Any] = {"force": True, "options": request.options, "progress": report}
        if request.effect:
            step = add(model, request.effect, dataset, **how)
        else:
            step = fitted(model, dataset, **how)
        position_error = _or_nan(step.result.after.summary.position_mean)
        report("judging", 1.0)
        reason, found = step.acceptance.against, step.result
        kinds = (found.before, found.after, found.held_out_before, found.held_out)
        means = tuple(_or_nan(kind.summary.position_mean) for kind in kinds)
        text = readable_text(step.model, request.output_file)
        success = not reason or request.force
        if success:
            although = f" (forced although {reason})" if reason else ""
            message = f"{step.acceptance.description}; written to {request.output_file}{although}"
        else:
            message = f"{reason}; nothing was written (use force to write it anyway)"
        return Outcome(success, message, step.document(), text, means)
    except ParallelCalError as error:
        return Outcome(False, str(error))


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


def write_proposal(request: Request, outcome: Outcome) -> Outcome:
    """Write the proposed model and back up the previous file; return a refusal unchanged."""
    if not outcome.success:
        return outcome
    replace_text(request.output_file, outcome.text)
    return replace(outcome, hash=model_hash(outcome.text), path=request.output_file)


def undo_write(path: str) -> str:
    """Exchange a model file with the one that it replaced; return a sentence. ModelFileError if
    there is none, or it is no longer readable."""
    before = path + BACKUP_SUFFIX
    if not Path(before).exists():
        raise ModelFileError(f"{path}: nothing to undo: {before} does not exist")
    text, now = model_text(before), model_text(path)
    parse_model(text, before)
    write_text(path, text)
    write_text(before, now)
    return f"{path}: restored {model_hash(text)[:12]}, replaced {model_hash(now)[:12]}"


def examine(
    model_file: str,
    dataset: Dataset,
    options: FitOptions,
    tell: Callable[[str, float], None],
) -> Outcome:
    """Diagnose a model file on samples and write nothing; a failure is a message."""
    report = never_falling(tell)  # a search that starts again must not lower the progress
    try:
        report("reading the model file", 0.0)
        found = diagnose(read_model(model_file), dataset, options=options, progress=report)
        best = found.best.fitted
        text = "" if best.implausible else readable_text(best.model, "the best model found")
    except ParallelCalError as error:
        return Outcome(False, str(error))
    word = found.verdict.word
    message = f"{word}: {found.verdict.text}"
    return Outcome(True, message, found.document(), text, verdict=word)
