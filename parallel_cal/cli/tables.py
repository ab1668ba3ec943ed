"""Forward and inverse kinematics of the rows of a CSV table."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from parallel_cal.base.errors import ModelError, SolveError
from parallel_cal.base.rotation import quaternion_to_matrix
from parallel_cal.kinematics.answers import (
    direct_covariances,
    explained_residuals,
    inverse_covariances,
    named_conditions,
    select_rows,
    status_text,
)
from parallel_cal.kinematics.kinematics import Solutions, Status
from parallel_cal.kinematics.solving import Conditions, direct, inverse
from parallel_cal.model.mechanism import POSE
from parallel_cal.model.model import Model
from parallel_cal.recordings.table import Table, read_table

POSITION = ("x", "y", "z")
QUATERNION = ("qx", "qy", "qz", "qw")


def _check_columns(
    table: Table, wanted: Sequence[str], optional: Sequence[str], model: Model
) -> Table:
    """Raise SolveError if wanted columns are missing, or others than the optional ones exist.

    Conditions that the model does not depend on may stand in the table: they change nothing.
    """
    header = table.header
    known = {*wanted, *optional, *(name for name in header if _is_condition(model, name))}
    if not {*wanted} <= {*header} <= known or len(set(header)) < len(header):
        also = f" (and may have {', '.join(optional)})" if optional else ""
        raise SolveError(
            f"{table.path}:1: header '{','.join(header)}'; expected the columns "
            f"{','.join(wanted)}{also}, in SI units"
        )
    return table


def _is_condition(model: Model, name: str) -> bool:
    """Whether a column is a condition that a robot with these joints may have."""
    try:
        named_conditions(model, [(name, 0.0)])
    except ModelError:
        return False
    return True


def _columns(table: Table, names: Sequence[str]) -> np.ndarray:
    """Return the columns (N, len(names)), NaN for cells that are not numbers.

    A row with such a cell gets a status; the other rows are solved.
    """
    return np.column_stack([table.column(name) for name in names])


class Answer(NamedTuple):
    """The solutions of a table: as CSV, as numbers with their covariances (N, n, n) if these were
    asked for, the conditions of its rows, and the explained residuals (N,) of a robot with more
    joints than freedoms."""

    text: str
    found: Solutions
    covariances: np.ndarray | None
    conditions: Conditions
    explained: np.ndarray | None = None


def direct_table(
    model: Model, path: Path, at: Conditions, solver: str, covariance: bool = False
) -> Answer:
    """Solve a table of joint readings."""
    table = _check_columns(read_table(path), model.joints, model.conditions, model)
    q = _columns(table, model.joints)
    conditions = _conditions(model, table, at)
    good = _find_finite_rows(q, conditions)
    found = _make_invalid_solutions(model, good)
    if good.any():
        some = direct(model, q[good], select_rows(conditions, good), solver=solver)
        found = _insert_solutions(found, some, good)
    known = direct_covariances(model, found, conditions) if covariance else None
    names, values = (*POSITION, *QUATERNION), np.hstack([found.position, found.quaternion])
    explained = explained_residuals(model, found, conditions)
    text = _text(table, names, values, found, POSE, known, explained)
    return Answer(text, found, known, conditions, explained)


def inverse_table(
    model: Model, path: Path, at: Conditions, solver: str, covariance: bool = False
) -> Answer:
    """Solve a table of positions, orientations or both, according to header and mechanism."""
    table = read_table(path)
    header = {*table.header}
    has_turns = bool(header & {*QUATERNION}) or not {*model.mechanism.controls} & {*POSITION}
    has_places = bool(header & {*POSITION}) or not has_turns
    wanted = (*(POSITION if has_places else ()), *(QUATERNION if has_turns else ()))
    table = _check_columns(table, wanted, model.conditions, model)
    n = len(table.rows)
    r = np.tile(model.mechanism.home.position, (n, 1))
    if "x" in table.header:
        r = _columns(table, POSITION)
    R = None
    if "qw" in table.header:
        q = _columns(table, QUATERNION)
        q[np.linalg.norm(q, axis=1) < 1e-9] = np.nan  # no rotation: the row gets a status
        R = quaternion_to_matrix(q)
    conditions = _conditions(model, table, at)
    good = _find_finite_rows(r if R is None else np.hstack([r, R.reshape(n, 9)]), conditions)
    found = _make_invalid_solutions(model, good)
    if good.any():
        turned = None if R is None else R[good]
        some = inverse(model, r[good], turned, select_rows(conditions, good), solver=solver)
        found = _insert_solutions(found, some, good)
    known = inverse_covariances(model, found, conditions) if covariance else None
    text = _text(table, model.joints, found.joints, found, model.joints, known)
    return Answer(text, found, known, conditions)


def _find_finite_rows(numbers: np.ndarray, conditions: Conditions) -> np.ndarray:
    """Return a mask (n,) of the rows that contain numbers only."""
    good = np.isfinite(numbers).all(axis=1)
    for column in conditions.values():
        good = good & np.isfinite(column)
    return good


def _make_invalid_solutions(model: Model, good: np.ndarray) -> Solutions:
    """Make an invalid solution for every row."""
    n = len(good)
    return Solutions(
        np.full((n, len(model.joints)), np.nan),
        np.full((n, 3), np.nan),
        np.full((n, 3, 3), np.nan),
        np.full(n, np.nan),
        np.full(n, Status.INVALID_INPUT, dtype=np.int8),
    )


def _insert_solutions(found: Solutions, some: Solutions, good: np.ndarray) -> Solutions:
    for part in ("joints", "position", "rotation", "residual", "status"):
        getattr(found, part)[good] = getattr(some, part)
    return replace(found, message=some.message)


def _conditions(model: Model, table: Table, at: Conditions) -> dict[str, np.ndarray]:
    """Return the conditions; columns of the table override values from the command line."""
    columns = {k: table.column(k) for k in table.header if k in model.conditions}
    return {**{name: np.array(value) for name, value in at.items()}, **columns}


def _text(
    table: Table,
    names: Sequence[str],
    values: np.ndarray,
    found: Solutions,
    uncertain: Sequence[str],
    covariances: np.ndarray | None,
    explained: np.ndarray | None = None,
) -> str:
    """Format the given cells, the solution, the standard deviations of the `uncertain` numbers
    (`sigma.x`) and the explained residual (m) if they are known, the residual (m) and the status as
    CSV.

    A row that is not solved keeps its cells.
    """
    if covariances is not None:
        names = [*names, *(f"sigma.{name}" for name in uncertain)]
        variances = np.diagonal(covariances, axis1=1, axis2=2)
        values = np.hstack([values, np.sqrt(variances)])
    if explained is not None:
        names = [*names, "explained_residual"]
        values = np.column_stack([values, explained])
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([*table.header, *names, "residual", "status"])
    width = len(table.header)
    for cells, row, residual, status in zip(
        table.rows, values.tolist(), found.residual.tolist(), found.status, strict=True
    ):
        given = (cells + [""] * width)[:width]
        answer = ["" if v != v else repr(v) for v in (*row, residual)]
        writer.writerow([*given, *answer, status_text(status)])
    return out.getvalue()


def counts(found: Solutions) -> dict[str, int]:
    """Count the rows with each status, most frequent first."""
    return dict(Counter(status_text(s) for s in found.status).most_common())
