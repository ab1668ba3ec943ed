"""Commands that compare, fit, and add or remove effects."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from parallel_cal.cli.arguments import (
    FIT,
    AddedEffects,
    Bags,
    Data,
    Details,
    EffectName,
    EffectsInModel,
    FittingByMethod,
    ForceAdd,
    ForceFit,
    ForceRemove,
    JointSigma,
    Json,
    ModelFile,
    OptionalOut,
    Parameters,
    with_options,
)
from parallel_cal.cli.recordings import data_options
from parallel_cal.identification.options import FitOptions
from parallel_cal.reporting import console

if TYPE_CHECKING:
    from parallel_cal.model.model import Model
    from parallel_cal.recordings.dataset import Dataset
    from parallel_cal.session.steps import Step


@with_options
def fit(
    model: ModelFile,
    bags: Bags,
    *,
    effect: AddedEffects = None,
    output: OptionalOut = None,
    force: ForceFit = False,
    options: Annotated[FitOptions, ("method", *FIT, "refit", "update")],
    data: Data = None,
    parameters: Parameters = False,
    details: Details = False,
    as_json: Json = False,
) -> None:
    """Identify the free parameters and show the errors. The model is written to the file of -o if
    the validation error falls."""
    from parallel_cal.session.steps import fitted

    options = replace(options, insist=force)
    start, dataset = read_model_and_data(model, bags, data)
    force = force or output is None  # without an output there is nothing to refuse
    step = fitted(
        start, dataset, force, options=options, progress=console.progress, effects=effect or ()
    )
    _finish(step, _Run(model, bags, data, output, parameters, details), as_json)


@with_options
def add(
    model: ModelFile,
    effect: EffectName,
    bags: Bags,
    *,
    output: OptionalOut = None,
    force: ForceAdd = False,
    options: FittingByMethod,
    data: Data = None,
    parameters: Parameters = False,
    details: Details = False,
    as_json: Json = False,
) -> None:
    """Add an effect and fit again. The model is written to the file of -o if the validation error
    falls."""
    from parallel_cal.session.steps import add

    start, dataset = read_model_and_data(model, bags, data)
    options = replace(options, insist=force)
    step = add(start, effect, dataset, force, options=options, progress=console.progress)
    _finish(step, _Run(model, bags, data, output, parameters, details), as_json)


@with_options
def remove(
    model: ModelFile,
    effect: EffectsInModel,
    bags: Bags,
    *,
    output: OptionalOut = None,
    force: ForceRemove = False,
    options: FittingByMethod,
    data: Data = None,
    parameters: Parameters = False,
    details: Details = False,
    as_json: Json = False,
) -> None:
    """Remove an effect and fit again. The model is written to the file of -o, unless the validation
    error rises by 1 % or more."""
    from parallel_cal.session.steps import remove

    start, dataset = read_model_and_data(model, bags, data)
    options = replace(options, insist=force)
    step = remove(start, effect, dataset, force, options=options, progress=console.progress)
    _finish(step, _Run(model, bags, data, output, parameters, details), as_json)


def read_model_and_data(
    path: Path, bags: list[Path], data: list[str] | None
) -> tuple[Model, Dataset]:
    from parallel_cal.model.file.modelfile import read_model
    from parallel_cal.recordings.loading import load_sessions

    model, options = read_model(path), data_options(data)
    return model, load_sessions(bags, options, console.progress, mechanism=model.mechanism)


@dataclass(frozen=True)
class _Run:
    """What a command was given, and what it shall print."""

    model: Path
    bags: list[Path]
    data: list[str] | None
    output: Path | None
    parameters: bool
    details: bool


def _finish(step: Step, run: _Run, as_json: bool) -> None:
    """Write the model, then print the result, so that a failed write prints no success."""
    from parallel_cal.model.file.modelfile import model_hash, replace_model

    output = run.output
    written = {}
    following = _say_what_follows(step, run.model)
    if output is not None:
        # `export` finds the touches of a printer's bed again by the paths of the recordings.
        *earlier, last = step.model.history
        dataset = last["dataset"] | {"files": [path.as_posix() for path in run.bags]}
        model = replace(step.model, history=(*earlier, last | {"dataset": dataset}))
        replace_model(model, output)
        written = {"output": str(output), "hash": model_hash(model)}
        following = command_line(["diagnose", output], model, run.bags, run.data)
    updates = ["--update"] if step.result.options.update else []
    if written and updates and step.name == "fit":  # the new model knows these samples
        following = command_line(["diagnose", run.model], model, run.bags, run.data, *updates)
    if implausible := bool(step.result.implausible):
        following = command_line(["diagnose", run.model], step.model, run.bags, run.data, *updates)
    is_command, reason = bool(written) or implausible, ""
    if (odd := step.result.outliers) is not None:
        from parallel_cal.model.words import join_words

        them = "it" if len(odd.numbers) == 1 else "them"
        reason = f"check sample {join_words(odd.titles)}, and fit without {them} if wrong"
        following, is_command = _write_refit(step, run, odd.numbers)
    console.progress("", 1.0)
    console.warn(step.warnings, brief=not run.details)
    if as_json:
        return console.emit(step.document() | written)
    from parallel_cal.reporting.results import describe

    console.show(describe(step), list_options(run.details, run.parameters))
    if written:
        console.say(f"written: {output} (sha256 {written['hash'][:12]})")
    print_summary(step, following, is_command, reason)


def _write_refit(step: Step, run: _Run, wrong: Sequence[int]) -> tuple[str, bool]:
    """Write the command that fits again without some samples, or say how to change the last one if
    it had options or effects of its own, and whether it is a command."""
    excluded = ",".join(map(str, sorted({*step.result.dataset.excluded, *wrong})))
    options = replace(step.result.options, insist=False)
    if step.name != "fit" or "effect" in step.model.history[-1] or options != FitOptions():
        return f"the same command with --data exclude={excluded}", False
    data = [item for item in run.data or [] if not item.startswith("exclude=")]
    data.append(f"exclude={excluded}")
    output = str(run.output or "fitted.yaml")
    return command_line(["fit", run.model], step.model, run.bags, data, "-o", output), True


def _say_what_follows(step: Step, model: Path) -> str:
    """Say what to do after a command without -o."""
    from parallel_cal.identification.recheck import UNDECIDED

    drift = step.result.drift
    if drift is not None and not drift.is_shown:
        decided = drift.verdict != UNDECIDED
        more = "" if decided else "measure more of the planned poses; until then, "
        return f"{more}keep {model}"
    return "the same command with -o FILE, which writes the model"


def list_options(details: bool, parameters: bool = False) -> list[str]:
    """List the options that show details."""
    return [*(["details"] if details else []), *(["parameters"] if parameters else [])]


def command_line(
    words: Sequence[str | Path],
    model: Model,
    bags: list[Path],
    data: list[str] | None,
    *others: str,
    folders: Sequence[Path] = (),
) -> str:
    """Write a command that continues with these recordings: `words` before them, `others` behind
    them. `folders` have further effects."""
    options = [f"--data={item}" for item in data or []]
    whole = shlex.join([*map(str, words), *map(str, bags), *options, *others])
    return f"{write_program(model, folders)} {whole}"


def write_program(model: Model, folders: Sequence[Path] = ()) -> str:
    """Write the name of the program, with folders of effects, and those of the model's own that
    PYTHONPATH names."""
    named = {
        Path(folder).resolve() for folder in os.environ.get("PYTHONPATH", "").split(os.pathsep)
    }
    found = [*folders]
    for effect in model.effects:
        module = type(effect).__module__
        folder = Path(sys.modules[module].__file__ or "").resolve().parents[module.count(".")]
        if not module.startswith("parallel_cal.") and folder in named:
            found.append(folder)
    path = os.pathsep.join(dict.fromkeys(os.path.relpath(folder) for folder in found))
    return f"PYTHONPATH={shlex.quote(path)} parallel-cal" if path else "parallel-cal"


def print_summary(result: object, following: str, is_command: bool, reason: str = "") -> None:
    """Print the last lines of a result, and what to do next, for a `reason`."""
    from parallel_cal.reporting.readable import COMMAND
    from parallel_cal.reporting.summary import Line, summarize, summary_table

    mark = COMMAND if is_command else ""
    lines = [Line("next:", following, mark)]
    if reason:
        lines = [Line("next:", reason), Line("", following, mark)]
    console.show([summary_table([*summarize(result), *lines])])


def compare(
    model: ModelFile,
    bags: Bags,
    joint_sigma: JointSigma = None,
    data: Data = None,
    details: Details = False,
    as_json: Json = False,
) -> None:
    """Show the errors of a model at every sample. The worst sample comes first. No parameter of the
    robot is fitted. Only the registration of the device is estimated, if it is needed."""
    from parallel_cal.diagnosis import comparison

    judged, dataset = read_model_and_data(model, bags, data)
    compared = comparison.compare(judged, dataset, joint_sigma)
    console.progress("", 1.0)
    console.warn(compared.dataset.warnings, brief=not details)
    if as_json:
        return console.emit(compared.document())
    from parallel_cal.reporting.results import describe

    console.show(describe(compared), list_options(details))
    if compared.given.fits_of_these_samples:
        command = command_line(["diagnose", model], judged, bags, data)
    else:
        command = command_line(["fit", model], judged, bags, data, "-o", "fitted.yaml")
    print_summary(compared, command, is_command=True)
