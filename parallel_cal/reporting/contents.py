"""The parts of a report's document that a diagnosis does not write down itself."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from parallel_cal.base.documents import plain
from parallel_cal.diagnosis.diagnose import Diagnosis
from parallel_cal.diagnosis.field import Field
from parallel_cal.diagnosis.lack_of_fit import regressors
from parallel_cal.diagnosis.scene import Scene
from parallel_cal.diagnosis.search import Trial
from parallel_cal.identification.doubts import finite_or_none
from parallel_cal.identification.fit import Result
from parallel_cal.identification.prediction_errors import ERRORS
from parallel_cal.model.configuration import Configuration
from parallel_cal.model.effect import CONDITIONS
from parallel_cal.model.mechanism import POSE
from parallel_cal.model.words import describe, direction_in_words

STRONG = 0.98  # correlation of two parameters that the data hardly tell apart


def errors(diagnosis: Diagnosis) -> dict[str, Any]:
    """E at poses left out: before any calibration, now, with the effects found; noise alone."""
    base, best = diagnosis.base.fitted, diagnosis.best.fitted
    steps = _judged(diagnosis)
    return {
        "before": steps[0]["held_out"]["before"] if steps else base.held_out_before.document(),
        "now": base.held_out.document(),
        "found": best.held_out.document() if diagnosis.effects else None,
        "noise": best.noise.document(),
    }


def _judged(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Steps of the model's history with errors at poses left out: no published tables."""
    past = (entry for entry in diagnosis.model.history if isinstance(entry.get("held_out"), dict))
    return [entry for entry in past if {"before", "after"} <= entry["held_out"].keys()]


def history(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """One row a step: its name, E at poses left out, and the data it was judged on."""
    four, data = errors(diagnosis), diagnosis.dataset
    here = {"samples": len(data), "sha256": data.sha256}
    steps = [_step(entry) for entry in _judged(diagnosis)]
    rows = [(steps[0] if steps else here) | {"name": "before", "error": four["before"]}, *steps]
    if not (steps and _same(steps[-1]["error"], four["now"])):  # else the last step is now
        rows.append({"name": "now", "error": four["now"], **here})
    if four["found"]:
        name = f"with {' and '.join(diagnosis.effects)}"
        rows.append({"name": name, "error": four["found"], **here})
    return rows


def _same(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether errors are those of one fit, written and identified again."""
    return all(
        np.isclose(one.get(key) or 0.0, value or 0.0, rtol=1e-4, atol=0.0)
        for key, value in other.items()
    )


def _step(entry: Mapping[str, Any]) -> dict[str, Any]:
    """A row of the history from an entry in the model file."""
    return {
        "name": " ".join(str(entry[key]) for key in ("step", "effect") if key in entry),
        "error": entry["held_out"]["after"],
        "samples": entry.get("samples"),
        "sha256": (entry.get("dataset") or {}).get("sha256", ""),
    }


def residuals(diagnosis: Diagnosis, field: Field) -> dict[str, Any]:
    """What the fit leaves, a row a sample: where (m, or the platform's axis), measured minus
    predicted (m or rad) as it is and with the effects diagnosis, noise units, what may matter."""
    scene = diagnosis.base.scene
    return {
        "kind": field.kind,
        "components": _components(field),
        "sample": [int(i) for i in diagnosis.dataset.numbers],
        "place": places(scene, field.kind).tolist(),
        "now": field.vectors.tolist(),
        "found": diagnosis.field.vectors.tolist() if diagnosis.effects else None,
        "noise_units": _used(field).tolist(),
        "regressors": {name: np.asarray(v).tolist() for name, v in regressors(scene)},
        "units": dict(_units(scene)),
    }


def _used(field: Field) -> np.ndarray:
    return np.asarray(field.noise_units[:, np.any(field.noise_units != 0, axis=0)])


def _components(field: Field) -> list[str]:
    """Names of the columns of `noise_units` that hold anything."""
    used = np.flatnonzero(np.any(field.noise_units != 0, axis=0))
    pose = field.measured.any()
    return [POSE[k] if pose else f"equation {k + 1}" for k in used]


def places(scene: Scene, kind: str | None) -> np.ndarray:
    """Predicted positions (N, 3), or where only the orientation is known the
    platform's z axis."""
    predicted = Configuration.from_rows(scene.x)
    return predicted.R[:, :, 2] if kind == "orientation" else predicted.r


def _units(scene: Scene) -> Iterator[tuple[str, str]]:
    """SI unit of every regressor; empty where nobody states one."""
    m = scene.model.mechanism
    own = dict(zip(m.joints, m.joint_units, strict=True)) | dict.fromkeys("xyz", "m")
    for name, _ in regressors(scene):
        kind, _, joint = name.partition(".")
        stated = CONDITIONS[kind][0] if kind in CONDITIONS else ""
        # A condition of a joint is stated for turns.
        yield name, own.get(name) or stated.replace("rad", own.get(joint, "rad"))


def samples(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """A row a sample, worst first: where it was, its errors at a fit that left it out, and how
    many sigmas the fit on all samples leaves."""
    best, data = diagnosis.best.fitted, diagnosis.dataset
    odd = {one.sample: one.word for one in diagnosis.odd_samples}
    now, with_effects = _each(diagnosis.base), _each(diagnosis.best)
    rows = [
        {
            "sample": int(number),
            "time": finite_or_none(data.time[i]),
            "joints": best.observations.x[i, : len(best.model.joints)].tolist(),
            "position": [finite_or_none(v) for v in _measured(diagnosis, i)],
            "now": now[i],
            "found": with_effects[i] if diagnosis.effects else None,
            "odd": odd.get(int(number), ""),
        }
        for i, number in enumerate(data.numbers)
    ]
    return [rows[i] for i in np.argsort(-diagnosis.base.scene.sigmas, kind="stable")]


def _measured(diagnosis: Diagnosis, i: int) -> np.ndarray:
    return np.where(diagnosis.dataset.measured[i, :3], diagnosis.dataset.r[i], np.nan)


def _each(trial: Trial) -> list[dict[str, float | None]]:
    """Norms of every sample's errors at a fit that left it out, and its sigmas at one on all."""
    norms = {kind: trial.fitted.held_out.norms(kind) for kind in ERRORS}
    columns = norms | {"sigmas": trial.scene.sigmas}
    return [
        {key: finite_or_none(column[i]) for key, column in columns.items()}
        for i in range(trial.fitted.samples)
    ]


def parameters(result: Result) -> dict[str, dict[str, Any]]:
    """Value, sigma and nominal (SI); how far it moved and its sigma in tolerances; in words."""
    tolerance = dict(zip(result.model.table.names, result.model.table.tolerance, strict=True))
    return {
        name: plain(p)
        | {
            "words": describe(name, result.model.table),
            "sigma_tolerances": None if p.sigma is None else p.sigma / tolerance[name],
        }
        for name, p in result.parameters().items()
    }


def combinations(result: Result) -> dict[str, list[dict[str, Any]]]:
    """What the data cannot tell at all, and what they tell worse than the tolerances do."""
    seen, table = result.estimate.spectrum, result.model.table
    return {
        key: [{"text": direction_in_words(c, table), "parameters": c} for c in directions]
        for key, directions in (("unidentifiable", seen.unidentifiable), ("weak", seen.weak))
    }


def correlated(result: Result, most: int = 10) -> list[dict[str, Any]]:
    """The strongest correlations of two free parameters, where they are worth a word."""
    names = [n for n, free in zip(result.model.table.names, result.free, strict=True) if free]
    with np.errstate(invalid="ignore", divide="ignore"):  # unidentified ones have no sigma
        C = np.triu(np.nan_to_num(result.correlations()), 1)
    pairs = sorted(np.argwhere(np.abs(C) > STRONG).tolist(), key=lambda ij: -abs(C[tuple(ij)]))
    return [{"parameters": [names[i], names[j]], "value": float(C[i, j])} for i, j in pairs[:most]]


def smooth_map(diagnosis: Diagnosis) -> dict[str, Any]:
    """The smooth picture of what is left: where and how large (m or rad)."""
    drawn = diagnosis.structure.map
    return drawn.document() | {"places": drawn.places.tolist(), "field": drawn.field.tolist()}
