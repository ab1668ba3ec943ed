"""One recording of one robot: identified, diagnosed, and what of it the fleet needs."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache
from typing import Any

import numpy as np

from parallel_cal.base.documents import to_json_value
from parallel_cal.base.threads import single_threaded
from parallel_cal.diagnosis.catalogue import find_missing_conditions, find_new_parameters
from parallel_cal.diagnosis.diagnose import Diagnosis, diagnose
from parallel_cal.diagnosis.scene import Scene, columns
from parallel_cal.fleet.jobs import CASADI_LOCK, FleetOptions, Job, check_version, reason
from parallel_cal.identification.evidence import Evidence
from parallel_cal.model.file.modelfile import model_text, parse_model
from parallel_cal.model.model import Model
from parallel_cal.recordings.loading import load_stamped

Row = dict[str, Any]  # the JSON document of a recording
Page = Callable[[Diagnosis], str]
MIN_ABSOLUTE_TIME_S = 1e9  # s since 1970: what counts from its own beginning is smaller


@single_threaded()
def judge_recording(
    job: Job, asked: FleetOptions, inputs: str, page: Page | None = None
) -> tuple[Row, str]:
    """The row of a recording, and its page where one is wanted; whatever fails is its `reason`.

    FleetError where another version is asked for than is here.
    """
    check_version(asked.version)
    row: Row = {"robot": job.robot, "recording": job.recording, "inputs": inputs}
    start, shown = time.monotonic(), ""
    with CASADI_LOCK:
        try:
            found, when = _diagnosis(job, asked)
            row |= _row(found) | {"time": when, "reason": ""}
            shown = page(found) if page else ""
        except Exception as error:
            row |= {"time": job.time, "reason": reason(error)}
    return to_json_value(row | {"seconds": time.monotonic() - start}), shown


@lru_cache(maxsize=8)
def _model(text: str, name: str) -> Model:
    """Robots of one model file share what was derived of it: half the time of a diagnosis."""
    return parse_model(text, name)


def _diagnosis(job: Job, asked: FleetOptions) -> tuple[Diagnosis, float | None]:
    model = _model(model_text(job.model), str(job.model))
    dataset, start = load_stamped(job.data, asked.data, joints=model.joints)
    found = diagnose(model, dataset, effects=asked.effects, also=asked.also, options=asked.options)
    first = 1e-9 * start or float(dataset.time.min())
    return (
        found,
        job.time if job.time is not None else first if first > MIN_ABSOLUTE_TIME_S else None,
    )


def sort_recordings(rows: Iterable[Row]) -> dict[str, list[Row]]:
    """The recordings of each robot from the first to the last: by time where all have one, else by
    their names."""
    each: dict[str, list[Row]] = {}
    for row in rows:
        each.setdefault(row["robot"], []).append(row)
    timed = {robot for robot, own in each.items() if all(row["time"] is not None for row in own)}
    return {
        robot: sorted(own, key=lambda row: row["time"]) if robot in timed else own
        for robot, own in each.items()
    }


def _row(found: Diagnosis) -> Row:
    base, best = found.base.fitted, found.best.fitted
    table = best.model.table
    return {
        "mechanism": found.model.mechanism.name,
        "samples": len(found.dataset),
        "verdict": found.verdict.word,
        "summary": found.verdict.summary,
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
        "effects_evidence": {name: vars(told) for name, told in _iterate_effect_evidence(found)},
    }


def _iterate_effect_evidence(found: Diagnosis) -> Iterator[tuple[str, Evidence]]:
    """What the data say of the numbers of effects that were not taken, beside those that were."""
    scene = found.best.scene
    for one in found.ranked:
        if one.testable and not one.settings and one.name not in found.effects:
            told = compute_effect_evidence(scene, one.name)
            if told is not None:
                yield one.name, told


def compute_effect_evidence(scene: Scene, name: str) -> Evidence | None:
    """What a scene says of an effect's numbers, linearised about none of it: A = J^T J, g = -J^T r
    with J their columns off the geometry; None where it cannot say."""
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
