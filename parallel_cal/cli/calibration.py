"""Commands that compare, fit, and add or remove effects."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Iterable, Mapping, Sequence
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
    from parallel_cal.identification.outliers import Outliers
    from parallel_cal.model.model import Model
    from parallel_cal.recordings.dataset import Dataset
    from parallel_cal.reporting.summary import Line
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
    kept = output if step.acceptance.against and not force else None  # the robot is as it was
    given = Given(model, bags, data, options.update)
    _finish(step, given, None if kept else output, parameters, details, as_json, kept)


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
    _finish(step, Given(model, bags, data, options.update), output, parameters, details, as_json)


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
    _finish(step, Given(model, bags, data, options.update), output, parameters, details, as_json)


def read_model_and_data(
    path: Path, bags: list[Path], data: list[str] | None
) -> tuple[Model, Dataset]:
    from parallel_cal.model.file.modelfile import read_model
    from parallel_cal.recordings.loading import load_sessions

    model, options = read_model(path), data_options(data)
    return model, load_sessions(bags, options, console.progress, mechanism=model.mechanism)


@dataclass(frozen=True)
class Given:
    """What a command was given and the commands that it proposes need, too: the file of the model,
    the recordings, the options of --data, and whether the model is the prior (--update)."""

    path: Path
    bags: list[Path]
    data: list[str] | None = None
    update: bool = False

    @property
    def recording(self) -> list[str]:
        """The recordings as arguments, with all that must be known to read and to fit them."""
        options = [f"--data={item}" for item in self.data or []]
        return [*map(str, self.bags), *options, *(["--update"] if self.update else [])]

    @property
    def without_exclusions(self) -> Given:
        """What was given, but with all samples: none is excluded."""
        kept = [item for item in self.data or [] if not item.startswith("exclude=")]
        return replace(self, data=kept)

    def fill(
        self,
        lines: Iterable[Line],
        model: Model,
        files: Mapping[str, str] | None = None,
        folders: Sequence[Path] = (),
    ) -> list[Line]:
        """Replace the placeholders of lines, such as MODEL and those of further `files`, by the
        files of this run; `folders` have further effects."""
        from parallel_cal.reporting.summary import PROGRAM, name_files

        names = {
            PROGRAM: write_program(model, folders),
            "MODEL": shlex.quote(str(self.path)),
            "RECORDING": shlex.join(self.recording),
        }
        return [name_files(line, {**names, **(files or {})}) for line in lines]


def _finish(
    step: Step,
    given: Given,
    output: Path | None,
    parameters: bool,
    details: bool,
    as_json: bool,
    kept: Path | None = None,
) -> None:
    """Write the model, then print the result, so that a failed write prints no success. A file is
    `kept` as it is if an update decided that the robot has not drifted."""
    from parallel_cal.model.file.modelfile import model_hash, replace_model

    written: dict[str, str | None] = {} if kept is None else {"output": None, "hash": None}
    if output is not None:
        # `export` finds the touches of a printer's bed again by the paths of the recordings.
        *earlier, last = step.model.history
        dataset = last["dataset"] | {"files": [path.as_posix() for path in given.bags]}
        model = replace(step.model, history=(*earlier, last | {"dataset": dataset}))
        replace_model(model, output)
        written = {"output": str(output), "hash": model_hash(model)}
    console.progress("", 1.0)
    console.warn(step.warnings, brief=not details)
    if as_json:
        return console.emit(step.document() | written)
    from parallel_cal.reporting.results import describe

    console.show(describe(step), list_options(details, parameters))
    if output is not None:
        console.say(f"written: {output} (sha256 {model_hash(model)[:12]})")
    if kept is not None:
        console.say(f"not written: {kept}, because the robot is as it was at its last calibration")
    if step.result.outliers is not None:  # the proposed command excludes samples itself
        given = given.without_exclusions
    print_summary(step, step.model, given, _find_next_step(step, given, output))


def _find_next_step(step: Step, given: Given, output: Path | None) -> str:
    """Say what to do after a step whose model was written to a file, or to none."""
    result, drift = step.result, step.result.drift
    if result.outliers is not None:
        return _describe_refit(step, result.outliers, output)
    if step.acceptance.against and (output is None or result.implausible):
        return step.acceptance.cure
    if output is None and drift is not None and not drift.is_shown:
        return drift.cure
    if output is None:
        return "the same command with -o FILE, which writes the model"
    if not given.update:
        return f"parallel-cal diagnose {shlex.quote(str(output))} RECORDING"
    if step.name == "fit":  # the new model knows these samples
        return "parallel-cal diagnose MODEL RECORDING"
    return f"use {output}: it is the last calibration of the next --update"


def _describe_refit(step: Step, odd: Outliers, output: Path | None) -> str:
    """Say how to fit again without the samples that contradict all others: by a command, or by a
    change of the last one if it had options or effects of its own."""
    from parallel_cal.model.words import join_words

    them = "it" if len(odd.numbers) == 1 else "them"
    reason = f"check sample {join_words(odd.titles)}, and fit without {them} if wrong"
    excluded = ",".join(map(str, sorted({*step.result.dataset.excluded, *odd.numbers})))
    options = replace(step.result.options, insist=False)
    if step.name != "fit" or "effect" in step.model.history[-1] or options != FitOptions():
        return f"{reason}: the same command with --data exclude={excluded}"
    file = shlex.quote(str(output or "fitted.yaml"))
    return f"{reason}: parallel-cal fit MODEL RECORDING --data=exclude={excluded} -o {file}"


def list_options(details: bool, parameters: bool = False) -> list[str]:
    """List the options that show details."""
    return [*(["details"] if details else []), *(["parameters"] if parameters else [])]


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


def print_summary(result: object, model: Model, given: Given, step: str) -> None:
    """Print the last lines of a result, and the next step: words, a command, or both."""
    from parallel_cal.reporting.summary import list_step, summarize, summary_table

    lines = given.fill(list_step("next:", step), model)
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
    known = compared.given.fits_of_these_samples
    verb, file = ("diagnose", "") if known else ("fit", " -o fitted.yaml")
    command = f"parallel-cal {verb} MODEL RECORDING{file}"
    print_summary(compared, judged, Given(model, bags, data), command)
