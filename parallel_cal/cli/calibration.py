"""Commands that compare, fit, and add or remove effects."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from parallel_cal.cli.arguments import (
    FIT,
    AddedEffects,
    Bags,
    Data,
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
    options: Annotated[FitOptions, ("method", *FIT, "refit")],
    data: Data = None,
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
    _finish(step, bags, output, as_json)


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
    as_json: Json = False,
) -> None:
    """Add an effect and fit again. The model is written to the file of -o if the validation error
    falls."""
    from parallel_cal.session.steps import add

    start, dataset = read_model_and_data(model, bags, data)
    options = replace(options, insist=force)
    step = add(start, effect, dataset, force, options=options, progress=console.progress)
    _finish(step, bags, output, as_json)


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
    as_json: Json = False,
) -> None:
    """Remove an effect and fit again. The model is written to the file of -o, unless the validation
    error rises by 1 % or more."""
    from parallel_cal.session.steps import remove

    start, dataset = read_model_and_data(model, bags, data)
    options = replace(options, insist=force)
    step = remove(start, effect, dataset, force, options=options, progress=console.progress)
    _finish(step, bags, output, as_json)


def read_model_and_data(
    path: Path, bags: list[Path], data: list[str] | None
) -> tuple[Model, Dataset]:
    from parallel_cal.model.file.modelfile import read_model
    from parallel_cal.recordings.loading import load_sessions

    model, options = read_model(path), data_options(data)
    return model, load_sessions(bags, options, console.progress, mechanism=model.mechanism)


def _finish(step: Step, bags: list[Path], output: Path | None, as_json: bool) -> None:
    """Write the model, then print the result, so that a failed write prints no success."""
    from parallel_cal.model.file.modelfile import model_hash, replace_model

    written = {}
    if output is not None:
        # `export` finds the touches of a printer's bed again by the paths of the recordings.
        *earlier, last = step.model.history
        dataset = last["dataset"] | {"files": [path.as_posix() for path in bags]}
        model = replace(step.model, history=(*earlier, last | {"dataset": dataset}))
        replace_model(model, output)
        written = {"output": str(output), "hash": model_hash(model)}
    console.progress("", 1.0)
    console.warn(step.warnings)
    if as_json:
        return console.emit(step.document() | written)
    from parallel_cal.reporting import text

    console.say(text.show(step))
    if written:
        console.say(f"written: {output} (sha256 {written['hash'][:12]})")


def compare(
    model: ModelFile,
    bags: Bags,
    joint_sigma: JointSigma = None,
    data: Data = None,
    as_json: Json = False,
) -> None:
    """Show the errors of a model at every sample. The worst sample comes first. No parameter of the
    robot is fitted. Only the registration of the device is estimated, if it is needed."""
    from parallel_cal.diagnosis import comparison

    judged, dataset = read_model_and_data(model, bags, data)
    compared = comparison.compare(judged, dataset, joint_sigma)
    console.progress("", 1.0)
    console.warn(compared.dataset.warnings)
    if as_json:
        return console.emit(compared.document())
    from parallel_cal.reporting import text

    console.say(text.show(compared))
