"""The direct and inverse problem, one at a time or a table of them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.files import write_atomically
from parallel_cal.cli.tables import counts, direct_table, inverse_table
from parallel_cal.kinematics import answers, solving
from parallel_cal.kinematics.kinematics import Solutions
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.model.mechanism import POSE
from parallel_cal.model.model import Model
from parallel_cal.reporting import console


def direct(
    model_file: Path,
    joints: list[float] | None,
    at: list[str],
    every: bool,
    solver: str,
    covariance: bool,
    table: Path | None,
    output: Path | None,
    as_json: bool,
) -> None:
    model, conditions = _model_and_conditions(model_file, at)
    if table is not None:
        return _many(*direct_table(model, table, conditions, solver), output, as_json)
    q = np.array(joints)
    if len(q) != len(model.joints):
        raise ParallelCalError(
            f"--joints: {len(q)} values given, {model.mechanism.name} has {len(model.joints)} "
            f"joints: {', '.join(model.joints)}"
        )
    found = solving.direct(model, q, conditions, every, solver)
    known = answers.direct_covariances(model, found, conditions) if covariance else None
    _one(found, model, known, _pose_sigma, as_json)


def inverse(
    model_file: Path,
    position: list[float] | None,
    quaternion: list[float] | None,
    at: list[str],
    every: bool,
    solver: str,
    covariance: bool,
    table: Path | None,
    output: Path | None,
    as_json: bool,
) -> None:
    model, conditions = _model_and_conditions(model_file, at)
    if table is not None:
        return _many(*inverse_table(model, table, conditions, solver), output, as_json)
    r = np.array(model.mechanism.home.position if position is None else position)
    R = None if quaternion is None else answers.rotation_of(quaternion)
    _warn_of_unused(model, {"position": position, "orientation": quaternion})
    found = solving.inverse(model, r, R, conditions, every, solver)
    known = answers.inverse_covariances(model, found, conditions) if covariance else None
    _one(found, model, known, partial(_joint_sigma, model), as_json)


def _model_and_conditions(model_file: Path, at: list[str]) -> tuple[Model, dict[str, float]]:
    model = read_model(model_file).robot()
    conditions = answers.parse_conditions(model, at)
    unused = [name for name in conditions if name not in model.conditions]
    if unused:
        console.warn([f"no effect of the model depends on {', '.join(unused)}"])
    return model, conditions


def _warn_of_unused(model: Model, given: dict[str, list[float] | None]) -> None:
    """A Delta's orientation, for example, follows from its position."""
    axes = {"position": {*POSE[:3]}, "orientation": {*POSE[3:]}}
    console.warn(
        f"{model.mechanism.name} does not control its {kind}: the given one is not used"
        for kind, values in given.items()
        if values is not None and not axes[kind] & {*model.mechanism.controls}
    )


def _one(
    solutions: Solutions,
    model: Model,
    covariances: list[np.ndarray] | None,
    words: Callable[[np.ndarray], str],
    as_json: bool,
) -> None:
    rows = answers.rows_of(solutions)
    if covariances is not None:
        for row, covariance in zip(rows, covariances, strict=True):
            row["covariance"] = covariance
    if as_json:
        counted = {"count_complex": solutions.count_complex}
        return console.emit(
            {"solutions": rows, **(counted if solutions.count_complex is not None else {})}
        )
    name, factor = _joint_unit(model)
    console.table(
        ("status", "position [mm]", "quaternion x y z w", f"joints [{name}]", "residual [m]"),
        [
            (r["status"], console.vector(r["position"], 1e3, 4),
             console.vector(r["quaternion"], 1, 7), console.vector(r["joints"], factor, 5),
             f"{r['residual']:.1e}" if np.isfinite(r["residual"]) else "-")
            for r in rows
        ],
    )  # fmt: skip
    for covariance in covariances or []:
        sigma = np.sqrt(np.diag(covariance))
        console.say(f"1 sigma from the fit: {words(sigma)}")


def _pose_sigma(sigma: np.ndarray) -> str:
    turned = console.vector(sigma[3:], 60 * 180 / np.pi, 3)
    return f"position {console.vector(sigma[:3], 1e6, 1)} um, orientation {turned} arcmin"


def _joint_sigma(model: Model, sigma: np.ndarray) -> str:
    name, factor = _joint_unit(model)
    return f"joints {console.vector(sigma, factor, 5)} {name}"


def _joint_unit(model: Model) -> tuple[str, float]:
    units = set(model.mechanism.joint_units)
    return console.READABLE[units.pop()] if len(units) == 1 else ("rad|m", 1.0)


def _many(text: str, found: Solutions, output: Path | None, as_json: bool) -> None:
    if output is not None:
        write_atomically(output, text)
    statuses = counts(found)
    summary = ", ".join(f"{n} {status}" for status, n in statuses.items()) or "no rows"
    said = {} if found.message is None else {"message": found.message}
    summary = "; ".join([summary, *said.values()])
    if as_json and output is None:
        console.emit({"solutions": answers.rows_of(found), **said})
    elif as_json:
        console.emit({"output": str(output), "rows": len(found), "statuses": statuses, **said})
    elif output is None:
        console.say(text.rstrip("\n"))
        console.note(summary)
    else:
        console.say(f"{output}: {len(found)} rows, {summary}")
