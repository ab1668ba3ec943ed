"""Many direct or inverse problems at once: a CSV table in, a CSV table out."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import SolveError
from parallel_cal.base.rotation import quaternion_to_matrix
from parallel_cal.kinematics.answers import status_text
from parallel_cal.kinematics.kinematics import Solutions, Status
from parallel_cal.kinematics.solving import Conditions, direct, inverse
from parallel_cal.model.model import Model
from parallel_cal.recordings.table import Table, read_table

POSITION = ("x", "y", "z")
QUATERNION = ("qx", "qy", "qz", "qw")


def _check_columns(table: Table, wanted: Sequence[str], optional: Sequence[str]) -> Table:
    """SolveError where the table has not the wanted columns, or others than the optional ones."""
    known, header = {*wanted, *optional}, table.header
    if not {*wanted} <= {*header} <= known or len(set(header)) < len(header):
        also = f" (and may have {', '.join(optional)})" if optional else ""
        raise SolveError(
            f"{table.path}:1: header '{','.join(header)}'; expected the columns "
            f"{','.join(wanted)}{also}"
        )
    return table


def _columns(table: Table, names: Sequence[str]) -> np.ndarray:
    """(N, len(names)), NaN where a cell is no number: its row gets a status, others go on."""
    return np.column_stack([table.column(name) for name in names])


def direct_table(model: Model, path: Path, at: Conditions, solver: str) -> tuple[str, Solutions]:
    """Poses for a table of joints: the CSV text and the solutions."""
    table = _check_columns(read_table(path), model.joints, model.conditions)
    q = _columns(table, model.joints)
    conditions = _conditions(model, table, at)
    good = _find_finite_rows(q, conditions)
    found = _make_invalid_solutions(model, good)
    if good.any():
        some = direct(model, q[good], _select_rows(conditions, good), solver=solver)
        found = _insert_solutions(found, some, good)
    names = (*POSITION, *QUATERNION)
    return _text(table, names, np.hstack([found.position, found.quaternion]), found), found


def inverse_table(model: Model, path: Path, at: Conditions, solver: str) -> tuple[str, Solutions]:
    """Joints for a table of poses: the CSV text and the solutions."""
    table = _pose_table(model, path)
    n = len(table.rows)
    r = np.tile(model.mechanism.home.position, (n, 1))
    if "x" in table.header:
        r = _columns(table, POSITION)
    R = _rotations(table) if "qw" in table.header else None
    conditions = _conditions(model, table, at)
    good = _find_finite_rows(r if R is None else np.hstack([r, R.reshape(n, 9)]), conditions)
    found = _make_invalid_solutions(model, good)
    if good.any():
        turned = None if R is None else R[good]
        some = inverse(model, r[good], turned, _select_rows(conditions, good), solver=solver)
        found = _insert_solutions(found, some, good)
    return _text(table, model.joints, found.joints, found), found


def _pose_table(model: Model, path: Path) -> Table:
    """A table of positions, orientations or both, as its header and the mechanism have it."""
    table = read_table(path)
    header = {*table.header}
    turned = bool(header & {*QUATERNION}) or not {*model.mechanism.controls} & {*POSITION}
    placed = bool(header & {*POSITION}) or not turned
    wanted = (*(POSITION if placed else ()), *(QUATERNION if turned else ()))
    return _check_columns(table, wanted, model.conditions)


def _find_finite_rows(numbers: np.ndarray, conditions: Conditions) -> np.ndarray:
    """Rows (n,) that hold numbers only."""
    good = np.isfinite(numbers).all(axis=1)
    for column in conditions.values():
        good = good & np.isfinite(column)
    return good


def _make_invalid_solutions(model: Model, good: np.ndarray) -> Solutions:
    """An answer for every row, all of them still invalid."""
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


def _rotations(table: Table) -> np.ndarray:
    q = _columns(table, QUATERNION)
    q[np.linalg.norm(q, axis=1) < 1e-9] = np.nan
    return quaternion_to_matrix(q)


def _conditions(model: Model, table: Table, at: Conditions) -> dict[str, np.ndarray]:
    """Those of the command line, overruled by columns of the table."""
    columns = {k: table.column(k) for k in table.header if k in model.conditions}
    return {**{name: np.array(value) for name, value in at.items()}, **columns}


def _select_rows(conditions: Conditions, good: np.ndarray) -> dict[str, np.ndarray]:
    return {
        name: column[good] if np.ndim(column) else column for name, column in conditions.items()
    }


def _text(table: Table, names: Sequence[str], values: np.ndarray, found: Solutions) -> str:
    """The given cells, the answer, residual (m) and status; a bad row keeps its cells."""
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
    """How many rows have each status, most frequent first."""
    return dict(Counter(status_text(s) for s in found.status).most_common())
