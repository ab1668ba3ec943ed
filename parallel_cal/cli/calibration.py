"""Comparing, identifying, adding and removing effects."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from parallel_cal.cli.arguments import (
    Bags,
    Data,
    EffectName,
    Force,
    JointSigma,
    Json,
    Method,
    ModelFile,
    OptionalOut,
    patterns,
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
    output: OptionalOut = None,
    force: Force = False,
    method: Method = "implicit",
    options: FitOptions,
    refit: Annotated[
        list[str] | None,
        typer.Option(
            help="identify parameters like PATTERN alone, keep the rest with its covariance"
        ),
    ] = None,
    data: Data = None,
    as_json: Json = False,
) -> None:
    """Identify the model's free parameters; show errors before, after and at poses left out,
    where they must fall for the model to be written."""
    from parallel_cal.session.steps import fitted

    asked = replace(options, method=method, refit=patterns(refit), insist=force)
    start, dataset = read_model_and_data(model, bags, data)
    force = force or output is None  # where nothing is written nothing is refused
    step = fitted(start, dataset, force, options=asked, progress=console.progress)
    _finish(step, bags, output, as_json)


@with_options
def add(
    model: ModelFile,
    effect: EffectName,
    bags: Bags,
    *,
    output: OptionalOut = None,
    force: Force = False,
    method: Method = "implicit",
    options: FitOptions,
    data: Data = None,
    as_json: Json = False,
) -> None:
    """Add an effect and identify anew; refused when the error at poses left out does not fall."""
    from parallel_cal.session.steps import add

    start, dataset = read_model_and_data(model, bags, data)
    asked = replace(options, method=method, insist=force)
    step = add(start, effect, dataset, force, options=asked, progress=console.progress)
    _finish(step, bags, output, as_json)


@with_options
def remove(
    model: ModelFile,
    effect: EffectName,
    bags: Bags,
    *,
    output: OptionalOut = None,
    force: Force = False,
    method: Method = "implicit",
    options: FitOptions,
    data: Data = None,
    as_json: Json = False,
) -> None:
    """Remove an effect and identify anew; refused when the error at poses left out rises."""
    from parallel_cal.session.steps import remove

    start, dataset = read_model_and_data(model, bags, data)
    asked = replace(options, method=method, insist=force)
    step = remove(start, effect, dataset, force, options=asked, progress=console.progress)
    _finish(step, bags, output, as_json)


def read_model_and_data(
    path: Path, bags: list[Path], data: list[str] | None
) -> tuple[Model, Dataset]:
    from parallel_cal.model.file.modelfile import read_model
    from parallel_cal.recordings.loading import load_sessions

    model, options = read_model(path), data_options(data)
    return model, load_sessions(bags, options, console.progress, joints=model.joints)


def _finish(step: Step, bags: list[Path], output: Path | None, as_json: bool) -> None:
    """Write the model, then say what came out: a file that cannot be written is no success."""
    from parallel_cal.model.file.modelfile import model_hash, replace_model

    written = {}
    if output is not None:
        model = _with_files(step.model, bags)
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


def _with_files(model: Model, bags: list[Path]) -> Model:
    """With the names of the recordings in the last step of its history, for who needs them again
    (`export` judges a printer's bed by its touches)."""
    *earlier, last = model.history
    dataset = last["dataset"] | {"files": [path.as_posix() for path in bags]}
    return replace(model, history=(*earlier, last | {"dataset": dataset}))


def compare(
    model: ModelFile,
    bags: Bags,
    joint_sigma: JointSigma = None,
    data: Data = None,
    as_json: Json = False,
) -> None:
    """Errors of a model at every sample of a recording, worst first; fits nothing."""
    from parallel_cal.diagnosis import comparison

    judged, dataset = read_model_and_data(model, bags, data)
    compared = comparison.compare(judged, dataset, joint_sigma)
    console.progress("", 1.0)
    console.warn(compared.dataset.warnings)
    if as_json:
        return console.emit(compared.document())
    from parallel_cal.reporting import text

    console.say(text.show(compared))
