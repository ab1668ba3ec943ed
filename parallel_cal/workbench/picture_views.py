"""What the page draws of a model: the machine, residuals, patterns and figures, as JSON data."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from parallel_cal.base.documents import to_json_value
from parallel_cal.diagnosis.entries import Entry
from parallel_cal.diagnosis.patterns import ResidualProfile
from parallel_cal.diagnosis.signature import Signature, signature
from parallel_cal.diagnosis.thresholds import LEVELS
from parallel_cal.identification.prediction_errors import Errors, Summary
from parallel_cal.identification.registration import frames_of
from parallel_cal.model.model import Model
from parallel_cal.posterior.scene import Scene
from parallel_cal.reporting import (
    contents,
    joint_panels,
    maps,
    multiples,
    signatures,
)
from parallel_cal.reporting.axes import name_axis
from parallel_cal.reporting.figures import Spec
from parallel_cal.reporting.machine import (
    ErringPart,
    Stage,
    draw_machine,
)
from parallel_cal.reporting.names import title_of
from parallel_cal.reporting.readable import (
    error_unit,
    number,
    value_unit,
)
from parallel_cal.reporting.report import Report

View = dict[str, Any]


def view_field(residuals: contents.Residuals) -> View | None:
    """Return the residuals in space, in which branches are compared."""
    if residuals.kind is None:
        return None
    field = {
        "kind": residuals.kind,
        "places": residuals.place,
        "vectors": residuals.now,
        "numbers": residuals.sample,
    }
    return to_json_value(field)


class MachineStage(NamedTuple):
    """A stage of the machine's slider: a model's errors, and their rms at the same samples."""

    name: str
    errors: Errors
    summary: Summary


def view_machine_of(
    found: Report, residuals: contents.Residuals, erring: Sequence[ErringPart]
) -> View | None:
    """Draw the machine with its errors at held-out poses: nominal, fitted, with what was found."""
    diagnosis, errors = found.diagnosis, found.errors
    base, best = diagnosis.base.fitted, diagnosis.best.fitted
    before = contents.errors_before(diagnosis)
    stages = [
        MachineStage("nominal", before, errors.before),
        MachineStage("fitted", base.held_out, errors.now),
    ]
    if errors.found is not None:
        names = " + ".join(map(title_of, diagnosis.effects))
        stages.append(MachineStage(f"+ {names}", best.held_out, errors.found))
    return view_machine(diagnosis.model, diagnosis.base.scene, residuals, stages, erring)


def view_machine(
    model: Model,
    scene: Scene,
    residuals: contents.Residuals,
    stages: Sequence[MachineStage],
    erring: Sequence[ErringPart] = (),
) -> View | None:
    """Draw the machine; errors are drawn only where positions were measured."""
    if residuals.kind != "position":
        return to_json_value(draw_machine(model))
    shown = np.isin(scene.dataset.numbers, residuals.sample)
    frame = frames_of(scene.model).F
    unit, factor = error_unit("m")
    drawn = [
        Stage(
            one.name,
            one.errors.position[shown] @ frame.T,
            f"{number(one.summary.position_rms, factor)} {unit}",
        )
        for one in stages
        if one.summary.position_rms is not None
    ]
    machine = draw_machine(scene.model, residuals.place, drawn, residuals.sample, erring)
    if machine is not None and not shown.all():
        machine["share"] = f"{np.count_nonzero(shown)} of {len(shown)} samples"
    return to_json_value(machine)


def list_pictures(
    residuals: contents.Residuals, scene: Scene, laid: Signature | None
) -> Iterator[View]:
    """Make the figures of the tabs, each with a name and a description."""
    own = contents.JointResiduals.of(scene)
    over = f", with the pattern of {laid.effect}" if laid else ""
    words = "encoder reading minus inverse kinematics of the measured pose"
    if own.joints:
        yield view_picture(
            "joints",
            f"{words}, against the reading{over}",
            joint_panels.flat_panels(own, laid, residuals.sample),
        )
        if polar := joint_panels.polar_panels(own, laid, residuals.sample):
            yield view_picture("joints, round", f"{words}, as a polar plot{over}", polar)
    if residuals.kind is not None:
        flat, scale = maps.residuals(
            residuals.place, [residuals.now], residuals.kind, residuals.sample
        )
        yield view_picture(
            "sides",
            f"residuals from three sides, in the frame of the base, magnified {scale:g} times",
            flat,
        )
    if (spread := maps.PositionUncertainty.of(scene.model)) is not None:
        known, scale = maps.workspace(spread)
        words = f"model uncertainty: 1-sigma ellipses, magnified {scale:g} times"
        if spread.validity:
            words += f", {spread.validity}"
        yield view_picture("uncertainty", words, known)


def view_picture(name: str, words: str, figure: Spec) -> View:
    return {"name": name, "words": words, "figure": to_json_value(figure)}


def view_residuals(residuals: contents.Residuals, striking: Sequence[ResidualProfile]) -> View:
    """Return residuals in sigmas (N, k) by component, and the quantities (N,) that they may depend
    on, the strongest dependence first. Quantities that do not vary are omitted."""
    along = {}
    for one in residuals.select_informative(striking):
        values = residuals.regressors[one.name]
        unit, factor = value_unit(residuals.units[one.name])
        along[one.name] = {
            "values": np.round(values * factor, 5),
            "unit": unit,
            "at": np.round(one.at * factor, 5),
            "means": np.round(one.mean[:, np.any(one.mean != 0, axis=0)], 3),
            "band": np.round(one.band, 3),
            "rolls": len(np.unique(values)) > LEVELS,
        }
    return to_json_value(
        {
            "components": residuals.components,
            "colours": [multiples.colour(name, k) for k, name in enumerate(residuals.components)],
            "sigmas": np.round(residuals.noise_units, 3),
            "along": along,
            "place": np.round(
                (1.0 if residuals.kind == "orientation" else 1e3) * residuals.place, 4
            ),
            "where": name_axis("{}", residuals.kind or "position"),
        }
    )


def view_pattern(entry: Entry, model: Model, shown: np.ndarray) -> View | None:
    """Draw the candidate's pattern over the residuals of the samples whose numbers are `shown`;
    None if it was not tested."""
    if entry.candidate.score is None:
        return None
    laid, mechanism = signature(entry.candidate), model.mechanism
    return view_picture(
        entry.name,
        signatures.describe_signature(laid, mechanism),
        signatures.figure(laid, mechanism, shown),
    )
