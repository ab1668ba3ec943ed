"""The diagnose action: which physical effect the model lacks; it writes no file."""

from __future__ import annotations

from collections.abc import Callable

from parallel_cal_msgs.action import Diagnose

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.nodes.action_work import Finished, Job, Prepare
from parallel_cal.nodes.calibration_messages import json_text, number_samples
from parallel_cal.nodes.collector import Collection
from parallel_cal.session.recalibration import Cancel, Outcome


def diagnose_job(prepare: Prepare, finished: Finished) -> Job:
    """`~/diagnose`."""
    running = "a diagnosis is running; cancel it or wait"
    return Job("diagnose", Diagnose, running, prepare, finished, result_message)


def examine(
    model_file: str,
    collection: Collection,
    hold_out: float,
    joint_sigma: float | None,
    tell: Callable[[str, float], None],
    cancel: Cancel,
) -> Outcome:
    """Diagnose a model file on samples; a failure is a message.

    The outcome's model is the best one found. Cancelled comes through at the next step.
    """
    done = 0.0

    def report(stage: str, fraction: float) -> None:
        nonlocal done
        cancel.check()
        done = max(done, fraction)  # a search that begins anew does not take anything back
        tell(stage, done)

    try:
        report("reading the model file", 0.0)
        found = diagnose(
            read_model(model_file), collection.dataset,
            hold_out=hold_out, joint_sigma=joint_sigma, progress=report,
        )  # fmt: skip
    except ParallelCalError as error:
        return Outcome(False, str(error))
    document = found.document()
    number_samples(document["odd_samples"], collection)
    message = f"{document['verdict']}: {document['summary']}"
    return Outcome(True, message, document, model=found.best.fitted.model)


def result_message(outcome: Outcome) -> Diagnose.Result:
    """Success means that there is a verdict, whichever it is."""
    return Diagnose.Result(
        success=outcome.success,
        message=outcome.message,
        verdict=outcome.document.get("verdict", ""),
        json=json_text(outcome.document) if outcome.document else "",
    )
