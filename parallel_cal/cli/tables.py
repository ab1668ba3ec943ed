"""Many direct or inverse problems at once: a CSV table in, a CSV table out."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import SolveError
from parallel_cal.base.rotation import quaternion_to_matrix
from parallel_cal.kinematics.answers import status_text
from parallel_cal.kinematics.kinematics import Solutions, Status
from parallel_cal.kinematics.solving import Conditions, direct, inverse
from parallel_cal.model.model import Model

POSITION = ("x", "y", "z")
QUATERNION = ("qx", "qy", "qz", "qw")


@dataclass(frozen=True)
class Table:
    """A CSV table: header, cells as text, and the wanted columns as numbers, NaN where bad."""

    header: list[str]
    cells: list[list[str]]
    numbers: dict[str, np.ndarray]


def read_table(path: Path, wanted: Sequence[str], optional: Sequence[str] = ()) -> Table:
    """The table in a file; SolveError where it is not one with the wanted columns."""
    rows = _rows(path)
    header = [name.strip() for name in rows[0]]
    missing = [name for name in wanted if name not in header]
    known = {*wanted, *optional}
    strange = [name for name in header if name not in known]
    if missing or strange or len(set(header)) < len(header):
        also = f" (and may have {', '.join(optional)})" if optional else ""
        raise SolveError(
            f"{path}:1: header '{','.join(header)}'; expected the columns {','.join(wanted)}{also}"
        )
    cells = [row for row in rows[1:] if row]
    numbers = {
        name: np.array([_number(row, k, len(header)) for row in cells], dtype=float)
        for k, name in enumerate(header)
    }
    return Table(header, cells, numbers)


def _rows(path: Path) -> list[list[str]]:
    try:
        rows = list(csv.reader(io.StringIO(path.read_text(encoding="utf-8-sig")), strict=True))
    except OSError as error:
        raise SolveError(f"{path}: cannot be read: {error.strerror}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise SolveError(f"{path}: not a CSV table: {error}") from None
    if not rows or not any(rows[0]):
        raise SolveError(f"{path}:1: empty; expected a header line")
    return rows


def _number(row: list[str], column: int, width: int) -> float:
    """NaN for anything but a number: the row gets a status, the others go on."""
    try:
        return float(row[column]) if len(row) == width else np.nan
    except ValueError:
        return np.nan


def direct_table(model: Model, path: Path, at: Conditions, solver: str) -> tuple[str, Solutions]:
    """Poses for a table of joints: the CSV text and the solutions."""
    table = read_table(path, model.joints, model.conditions)
    q = np.column_stack([table.numbers[name] for name in model.joints])
    conditions = _conditions(model, table, at)
    good = _good(q, conditions)
    found = _filled(model, good)
    if good.any():
        some = direct(model, q[good], _those(conditions, good), solver=solver)
        found = _put(found, some, good)
    names = (*POSITION, *QUATERNION)
    return _text(table, names, np.hstack([found.position, found.quaternion]), found), found


def inverse_table(model: Model, path: Path, at: Conditions, solver: str) -> tuple[str, Solutions]:
    """Joints for a table of poses: the CSV text and the solutions."""
    table = _pose_table(model, path)
    n = len(table.cells)
    r = np.tile(model.mechanism.home.position, (n, 1))
    if "x" in table.numbers:
        r = np.column_stack([table.numbers[name] for name in POSITION])
    R = _rotations(table) if "qw" in table.numbers else None
    conditions = _conditions(model, table, at)
    good = _good(r if R is None else np.hstack([r, R.reshape(n, 9)]), conditions)
    found = _filled(model, good)
    if good.any():
        turned = None if R is None else R[good]
        some = inverse(model, r[good], turned, _those(conditions, good), solver=solver)
        found = _put(found, some, good)
    return _text(table, model.joints, found.joints, found), found


def _pose_table(model: Model, path: Path) -> Table:
    """A table of positions, orientations or both, as its header and the mechanism have it."""
    header = {name.strip() for name in _rows(path)[0]}
    turned = bool(header & {*QUATERNION}) or not {*model.mechanism.controls} & {*POSITION}
    placed = bool(header & {*POSITION}) or not turned
    wanted = (*(POSITION if placed else ()), *(QUATERNION if turned else ()))
    return read_table(path, wanted, model.conditions)


def _good(numbers: np.ndarray, conditions: Conditions) -> np.ndarray:
    """Rows (n,) that hold numbers only."""
    good = np.isfinite(numbers).all(axis=1)
    for column in conditions.values():
        good = good & np.isfinite(column)
    return good


def _filled(model: Model, good: np.ndarray) -> Solutions:
    """An answer for every row, all of them still invalid."""
    n = len(good)
    return Solutions(
        np.full((n, len(model.joints)), np.nan),
        np.full((n, 3), np.nan),
        np.full((n, 3, 3), np.nan),
        np.full(n, np.nan),
        np.full(n, Status.INVALID_INPUT, dtype=np.int8),
    )


def _put(found: Solutions, some: Solutions, good: np.ndarray) -> Solutions:
    for part in ("joints", "position", "rotation", "residual", "status"):
        getattr(found, part)[good] = getattr(some, part)
    return replace(found, message=some.message)


def _rotations(table: Table) -> np.ndarray:
    q = np.column_stack([table.numbers[name] for name in QUATERNION])
    q[np.linalg.norm(q, axis=1) < 1e-9] = np.nan
    return quaternion_to_matrix(q)


def _conditions(model: Model, table: Table, at: Conditions) -> dict[str, np.ndarray]:
    """Those of the command line, overruled by columns of the table."""
    columns = {k: v for k, v in table.numbers.items() if k in model.conditions}
    return {**{name: np.array(value) for name, value in at.items()}, **columns}


def _those(conditions: Conditions, good: np.ndarray) -> dict[str, np.ndarray]:
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
        table.cells, values.tolist(), found.residual.tolist(), found.status, strict=True
    ):
        given = (cells + [""] * width)[:width]
        answer = ["" if v != v else repr(v) for v in (*row, residual)]
        writer.writerow([*given, *answer, status_text(status)])
    return out.getvalue()


def counts(found: Solutions) -> dict[str, int]:
    """How many rows have each status, most frequent first."""
    return dict(Counter(status_text(s) for s in found.status).most_common())
