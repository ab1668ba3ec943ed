"""Comparing, identifying, adding and removing effects."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

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
from parallel_cal.cli.recordings import bag_progress, data_options
from parallel_cal.identification.options import FitOptions
from parallel_cal.reporting import console

if TYPE_CHECKING:
    from parallel_cal.model.model import Model
    from parallel_cal.recordings.dataset import Dataset
    from parallel_cal.session.steps import Step

ARCMIN = 60 * 180 / math.pi
BEYOND_CHANCE = 0.05


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

    asked = replace(options, method=method, refit=patterns(refit))
    start, dataset = model_and_data(model, bags, data)
    force = force or output is None  # where nothing is written nothing is refused
    step = fitted(start, dataset, force, options=asked, progress=console.progress)
    _finish(step, output, as_json)


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
    from parallel_cal.session.steps import added

    start, dataset = model_and_data(model, bags, data)
    asked = replace(options, method=method)
    step = added(start, effect, dataset, force, options=asked, progress=console.progress)
    _finish(step, output, as_json)


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
    from parallel_cal.session.steps import removed

    start, dataset = model_and_data(model, bags, data)
    asked = replace(options, method=method)
    step = removed(start, effect, dataset, force, options=asked, progress=console.progress)
    _finish(step, output, as_json)


def model_and_data(path: Path, bags: list[Path], data: list[str] | None) -> tuple[Model, Dataset]:
    from parallel_cal.model.file.modelfile import read_model
    from parallel_cal.recordings.loading import load_sessions

    model, options = read_model(path), data_options(data)
    return model, load_sessions(bags, options, bag_progress, joints=model.joints)


def _finish(step: Step, output: Path | None, as_json: bool) -> None:
    """Write the model, then say what came out: a file that cannot be written is no success."""
    from parallel_cal.model.file.modelfile import model_hash, write_model

    document = step.document()
    if output is not None:
        write_model(step.model, output)
        document = document | {"output": str(output), "hash": model_hash(step.model)}
    console.progress("", 1.0)
    console.warn(step.warnings)
    if as_json:
        return console.emit(document)
    _show_fit(document, step.model)


def _show_fit(document: dict[str, Any], model: Model) -> None:
    held = document["held_out"]
    columns = {"before": document["before"], "after": document["after"]}
    without = document.get("held_out_without_effect")  # judged like the new model
    columns["left out, without it" if without else "left out, before"] = without or held["before"]
    columns["left out, after"] = held["after"]
    console.say(
        f"{document['samples']} samples, {document['rank']} of {document['free']} free parameters "
        f"identified, chi2/dof {console.number(document['chi2_per_dof'])}"
    )
    show_errors(columns, document["noise_floor"], model)
    rows = []
    for name, p in document["parameters"].items():
        if not p["fixed"]:
            value, unit = console.readable(p["value"], p["unit"], 4)
            change = console.readable(p["value"] - p["nominal"], p["unit"], 4)[0]
            sigma = console.readable(p["sigma"], p["unit"], 4)[0]
            rows.append((name, value, change, sigma, unit))
    console.table(("parameter", "value", "from nominal", "sigma", "unit"), rows)
    if "output" in document:
        console.say(f"written: {document['output']} (sha256 {document['hash'][:12]})")


def show_errors(
    columns: dict[str, dict[str, Any]], floor: dict[str, float | None], model: Model
) -> None:
    """Errors beside those of noise alone, where somebody knows the noise."""
    if any(v is not None for v in floor.values()):
        columns = columns | {"noise alone": floor}
    redundant = model.structure.phi.shape[0] > len(model.mechanism.moved)
    console.errors_table(columns, model.mechanism.joint_units, closure=redundant)


def compare(
    model: ModelFile,
    bags: Bags,
    joint_sigma: JointSigma = None,
    data: Data = None,
    as_json: Json = False,
) -> None:
    """Errors of a model at every sample of a recording, worst first; fits nothing."""
    from parallel_cal.diagnosis import comparison

    judged, dataset = model_and_data(model, bags, data)
    document = comparison.compare(judged, dataset, joint_sigma).document()
    console.progress("", 1.0)
    console.warn(dataset.warnings)
    if as_json:
        return console.emit(document)
    console.say(f"{document['samples']} samples")
    show_errors({"error": document}, document["noise_floor"], judged)
    console.say("worst samples:")
    _show_rows(document["rows"][:10], document["channels"])
    _show_where(document["where"])


def _show_rows(rows: list[dict[str, Any]], channels: list[str]) -> None:
    header = ("sample", "time [s]", "at [mm]", "error [um]", "|error| [um]", "turned [arcmin]")
    console.table(
        header + tuple(f"{channel} [um]" for channel in channels),
        [
            (str(r["sample"]), console.number(r["time"], 1, 1),
             " ".join(console.number(v, 1e3, 1) for v in r["position"]),
             " ".join(console.number(v, 1e6, 0) for v in r["position_error"]),
             console.number(r["position_norm"], 1e6, 0),
             console.number(r["orientation_norm"], ARCMIN, 2),
             *(console.number(v, 1e6, 0) for v in r["reading_error"]))
            for r in rows
        ],
    )  # fmt: skip


def _show_where(where: dict[str, Any]) -> None:
    """What the errors go with, beyond chance, and whether neighbours err alike."""
    rows = [
        (a["name"], console.number(a["strength"], 1, 1), f"{a['p_value']:.2g}")
        for a in where["along"][:5]
        if a["p_value"] < BEYOND_CHANCE
    ]
    if rows:
        console.say("errors go with:")
        console.table(("along", "largest mean [sigma]", "p"), rows)
    else:
        console.say("errors go with nothing recorded, beyond chance")
    worst = where["regions"][0]
    console.say(
        f"worst region: {worst['region']}, {console.number(worst['position_rms'], 1e6, 0)} um rms; "
        f"structure: p = {where['structure']['p_value']:.2g}"
    )
    for row in where["odd_samples"][:5]:
        console.say(f"odd: sample {row['sample']}, {row['sigmas']:.1f} sigmas")
