"""Fit and diagnose one recording of one robot, and collect what the fleet needs of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import Any

import numpy as np

from parallel_cal.base.documents import to_json_value
from parallel_cal.base.threads import single_threaded
from parallel_cal.causes.effects import find_missing_conditions, find_new_parameters
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.diagnosis.result import Diagnosis
from parallel_cal.fleet.jobs import CASADI_LOCK, FleetOptions, Job, check_version, reason
from parallel_cal.identification.evidence import Evidence
from parallel_cal.model.file.modelfile import model_text, parse_model
from parallel_cal.model.model import Model
from parallel_cal.posterior.scene import Scene, columns
from parallel_cal.recordings.loading import find_start_time, load_stamped

Row = dict[str, Any]  # the JSON document of a recording
Page = Callable[[Diagnosis], str]


@single_threaded()
def judge_recording(
    job: Job, asked: FleetOptions, inputs: str, page: Page | None = None
) -> tuple[Row, str]:
    """Return the row of a recording and its page, if wanted; `reason` names any failure.

    Raises FleetError if another version is requested than this worker has.
    """
    check_version(asked.version)
    row: Row = {"robot": job.robot, "recording": job.recording, "inputs": inputs}
    start, shown = time.monotonic(), ""
    with CASADI_LOCK:
        try:
            model = _parse_model_once(model_text(job.model), str(job.model))
            dataset, start_ns = load_stamped(job.data, asked.data, mechanism=model.mechanism)
            found = diagnose(
                model, dataset, effects=asked.effects, also=asked.also, options=asked.options
            )
            when = job.time
            if when is None:
                when = find_start_time(dataset, start_ns)
            row |= _make_row(found) | {"time": when, "reason": ""}
            shown = page(found) if page else ""
        except Exception as error:
            row |= {"time": job.time, "reason": reason(error)}
    return to_json_value(row | {"seconds": time.monotonic() - start}), shown


@lru_cache(maxsize=8)
def _parse_model_once(text: str, name: str) -> Model:
    """Parse a model, or return the one parsed before: the expressions derived from a model take
    half the time of a diagnosis, and robots of one model file share them."""
    return parse_model(text, name)


def sort_recordings(rows: Iterable[Row]) -> dict[str, list[Row]]:
    """Sort the recordings of each robot: by time if all have one, else as given (by name)."""
    each: dict[str, list[Row]] = {}
    for row in rows:
        each.setdefault(row["robot"], []).append(row)
    timed = {robot for robot, own in each.items() if all(row["time"] is not None for row in own)}
    return {
        robot: sorted(own, key=lambda row: row["time"]) if robot in timed else own
        for robot, own in each.items()
    }


def _make_row(found: Diagnosis) -> Row:
    base, best = found.base.fitted, found.best.fitted
    table = best.plausible_model.table
    return {
        "mechanism": found.model.mechanism.name,
        "samples": len(found.dataset),
        "verdict": found.verdict.word,
        "summary": found.verdict.text,
        "effects": found.effects,
        "robot_or_device": found.robot_or_device,
        "before": base.held_out_before.summary,
        "identified": base.held_out.summary,
        "after": best.held_out.summary,
        "noise": best.noise_floor,
        "chi2_per_dof": best.estimate.chi2_per_dof,
        "parameters": {
            name: {"value": one.value, "sigma": one.sigma, "unit": one.unit}
            for (name, one), free in zip(best.parameters().items(), best.free, strict=True)
            if free
        },
        "evidence": vars(
            Evidence.of(best).marginalise(p.name for p in table if p.group != "sensor")
        ),
        # of the effects that the best model does not have
        "effects_evidence": {
            one.name: vars(evidence)
            for one in found.ranked
            if one.testable and not one.settings and one.name not in found.effects
            if (evidence := compute_effect_evidence(found.best.scene, one.name)) is not None
        },
    }


def compute_effect_evidence(scene: Scene, name: str) -> Evidence | None:
    """Return a scene's evidence of an effect's coefficients, linearised about no effect.

    A = J^T J and g = -J^T r, with J the columns of the coefficients projected off the geometry.
    None if the effect changes the mechanism or if its conditions were not recorded."""
    extended = scene.model.with_effect(name)
    if extended.mechanism is not scene.model.mechanism or find_missing_conditions(
        extended, scene.dataset
    ):
        return None
    new = find_new_parameters(scene.model, extended)
    J = scene.project_off_geometry(columns(extended, scene, new)) / extended.table.tolerance[new]
    birge = np.fmax(scene.chi2_per_dof, 1.0)
    names = tuple(np.array(extended.table.names)[new].tolist())
    return Evidence(names, np.zeros(len(names)), J.T @ J / birge, -J.T @ scene.residual / birge)
