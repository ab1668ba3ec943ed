"""Forward and inverse kinematics of the rows of a CSV table."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from parallel_cal.base.errors import ModelError, SolveError, format_suggestion
from parallel_cal.base.rotation import quaternion_to_matrix, rotation_matrix, rotation_vector
from parallel_cal.base.units import CONDITION_UNITS, UNITS
from parallel_cal.kinematics.answers import (
    Differences,
    direct_covariances,
    explained_residuals,
    inverse_covariances,
    named_conditions,
    select_rows,
    status_text,
)
from parallel_cal.kinematics.kinematics import Solutions, Status
from parallel_cal.kinematics.solutions import replace_rows
from parallel_cal.kinematics.solving import Conditions, direct, inverse
from parallel_cal.model.effect import CONDITIONS, list_substitutes
from parallel_cal.model.mechanism import POSE, Mechanism
from parallel_cal.model.model import Model
from parallel_cal.recordings.columns import si_unit
from parallel_cal.recordings.header_names import index_names
from parallel_cal.recordings.joint_names import match_numbered_names
from parallel_cal.recordings.table import Table, read_table, split_condition, split_unit

POSITION = ("x", "y", "z")
TURNS = ("rx", "ry", "rz")
QUATERNION = ("qx", "qy", "qz", "qw")


@dataclass(frozen=True)
class _SiTable:
    """A table whose columns have the names and SI units of a model's quantities.

    `header` (without units), `factors` and `offsets` are in the order of the table's columns;
    `numbered` are the columns that were taken for joints by their numbers.
    """

    table: Table
    header: tuple[str, ...]
    factors: tuple[float, ...]
    offsets: tuple[float, ...]
    numbered: Mapping[str, str]

    @classmethod
    def of(
        cls, table: Table, model: Model, units: Mapping[str, str], any_case: Sequence[str] = ()
    ) -> _SiTable:
        """Read the units in a header, `leg1 [mm]`; columns without a unit are in SI units.

        `units` are the SI units of the quantities that are no conditions. Names in `any_case` may
        be in capitals; joints that a table does not name are taken by their numbers. SolveError for
        a unit of another quantity.
        """
        words = [split_unit(word)[0] for word in table.header]
        given = index_names(words)
        meant = {given[name]: name for name in any_case if name in given}
        joints = [joint for joint in model.joints if joint in units]
        lacking = not {*joints} & {*words}
        alike = match_numbered_names(joints, words) if lacking else {}
        meant |= {word: joint for joint, word in alike.items()}
        columns = [_read_word(table, word, model, units, meant) for word in table.header]
        header, factors, offsets = zip(*columns, strict=True)
        return cls(table, header, factors, offsets, alike)

    def column(self, name: str) -> np.ndarray:
        """Return a column (N,) in its SI unit, NaN for a cell that is not a number."""
        k = self.header.index(name)
        return self.table.column(self.table.header[k]) * self.factors[k] + self.offsets[k]

    def columns(self, names: Sequence[str]) -> np.ndarray:
        """Return columns (N, len(names)); NaN gives its row a status, other rows are solved."""
        return np.column_stack([self.column(name) for name in names])

    def check(self, wanted: Sequence[str], optional: Sequence[str], model: Model) -> _SiTable:
        """Return self; SolveError if wanted columns are missing, or if one that is read occurs
        twice."""
        header = self.header
        read = {*wanted, *optional, *(name for name in header if _is_condition(model, name))}
        faults = {
            "missing": [name for name in wanted if name not in header],
            "repeated": [name for name, n in Counter(header).items() if n > 1 and name in read],
        }
        if any(faults.values()):
            faults["unknown"] = [name for name in header if name not in read]
            also = f" (and may have {', '.join(optional)})" if optional else ""
            what = "; ".join(f"{kind}: {','.join(one)}" for kind, one in faults.items() if one)
            raise SolveError(
                f"{self.table.path}:1: header '{','.join(self.table.header)}' ({what}); expected "
                f"the columns {','.join(wanted)}{also}, in SI units or with a unit in brackets, "
                "such as [mm] or [deg]"
            )
        return self

    def list_warnings(self, model: Model, used: Collection[str]) -> Iterator[str]:
        """Yield which columns were taken for joints, which change nothing, and which cells are no
        numbers, so that their rows have no solution."""
        read = {*used, *model.conditions}
        pairs = [*zip(self.table.header, self.header, strict=True)]
        unused = [word for word, name in pairs if name not in read and _is_condition(model, name)]
        unread = [word for word, name in pairs if name not in {*read, *unused} and word]
        near = "".join(format_suggestion(word, [*model.conditions]) for word in unread)
        if taken := ", ".join(f"{word} for {joint}" for joint, word in self.numbered.items()):
            yield f"joints were matched by their numbers: {taken}. If this is wrong, rename them"
        if unread:
            yield f"columns that are not read: {', '.join(unread)}{near}"
        if unused:
            yield f"no effect of the model depends on {', '.join(unused)}"
        if bad := self.table.describe_bad_cells([word for word, name in pairs if name in read]):
            yield f"{bad}. A row without a number has no solution"


def _list_unstated(model: Model, conditions: Conditions) -> Iterator[str]:
    """Yield which conditions the model depends on, and nobody stated: without them, it is no better
    than without their effects."""
    names = [
        name
        for name in model.conditions
        if conditions.keys().isdisjoint((name, *list_substitutes(name)))
    ]
    if names:
        yield (
            f"effects of the model depend on {', '.join(names)}, of which neither a column nor "
            "--at has values: these effects count as zero"
        )


def _read_word(
    table: Table, word: str, model: Model, units: Mapping[str, str], meant: Mapping[str, str]
) -> tuple[str, float, float]:
    """Return the name of a column, and the factor and the offset to its SI unit; `meant` has names
    of quantities by those of columns."""
    name, unit = split_unit(word)
    word, name = meant.get(word, word), meant.get(name, name)
    if word not in units and name in units and unit:
        if unit not in UNITS or si_unit(unit) != units[name]:
            raise SolveError(
                f"{table.path}:1: column {word} is in {unit}, but {name} is in {units[name]}"
            )
        return name, UNITS[unit], 0.0
    name, unit = split_condition(word)
    if unit and not _is_condition(model, word) and _is_condition(model, name):
        own = CONDITIONS[name.split(".")[0]][0]
        if unit not in CONDITION_UNITS.get(own, {}):
            raise SolveError(f"{table.path}:1: column {word} is in {unit}, but {name} is in {own}")
        return name, *CONDITION_UNITS[own][unit]
    return word, 1.0, 0.0


def _is_condition(model: Model, name: str) -> bool:
    """Whether a column is a condition that a robot with these joints may have."""
    try:
        named_conditions(model, [(name, 0.0)])
    except ModelError:
        return False
    return True


class Answer(NamedTuple):
    """The solutions of a table: as CSV, as numbers with their covariances (N, n, n) if these were
    asked for, the conditions of its rows, the explained residuals (N,) of a robot with more joints
    than freedoms, the differences of an inverse problem's solutions from the given poses, and what
    to know of the table."""

    text: str
    found: Solutions
    covariances: np.ndarray | None
    conditions: Conditions
    explained: np.ndarray | None = None
    differences: Differences | None = None
    warnings: tuple[str, ...] = ()


def direct_table(
    model: Model, path: Path, at: Conditions, solver: str, covariance: bool = False
) -> Answer:
    """Solve a table of joint readings."""
    units = dict(zip(model.joints, model.mechanism.joint_units, strict=True))
    table = _SiTable.of(read_table(path), model, units)
    q = table.check(model.joints, model.conditions, model).columns(model.joints)
    conditions = _conditions(model, table, at)
    good = _find_finite_rows(q, conditions)
    found = _make_invalid_solutions(model, good)
    if good.any():
        some = direct(model, q[good], select_rows(conditions, good), solver=solver)
        found = _insert_solutions(found, some, good)
    known = direct_covariances(model, found, conditions) if covariance else None
    names, values = (*POSITION, *QUATERNION), np.hstack([found.position, found.quaternion])
    explained = explained_residuals(model, found, conditions)
    more = {} if explained is None else {"explained_residual": explained}
    text = _text(table.table, names, values, found, POSE, known, more)
    warnings = (*table.list_warnings(model, model.joints), *_list_unstated(model, conditions))
    return Answer(text, found, known, conditions, explained, warnings=warnings)


def inverse_table(
    model: Model, path: Path, at: Conditions, solver: str, covariance: bool = False
) -> Answer:
    """Solve a table of positions, orientations or both, according to header and mechanism.

    Orientations are quaternions or rotation vectors (`rx`, `ry`, `rz`). Coordinates that the robot
    does not control need no column.
    """
    m = model.mechanism
    units = {name: "m" if name in POSITION else "rad" for name in POSE}
    table = _SiTable.of(read_table(path), model, units, (*POSE, *QUATERNION))
    given = [i for i, name in enumerate(POSE) if name in table.header]
    wanted, optional = _pose_columns(m, {*table.header})
    table.check(wanted, [*optional, *model.conditions], model)
    n, home = len(table.table.rows), np.array([*m.home.position, *m.home.rotation_vector])
    pose = np.tile(home, (n, 1))
    if given:
        pose[:, given] = table.columns([POSE[i] for i in given])
    r, R = pose[:, :3], None
    if "qw" in table.header:
        q = table.columns(QUATERNION)
        q[np.linalg.norm(q, axis=1) < 1e-9] = np.nan  # no rotation: the row gets a status
        R = quaternion_to_matrix(q)
    elif any(i >= 3 for i in given):
        R = rotation_matrix(pose[:, 3:])
    conditions = _conditions(model, table, at)
    good = _find_finite_rows(r if R is None else np.hstack([r, R.reshape(n, 9)]), conditions)
    found = _make_invalid_solutions(model, good)
    if good.any():
        turned = None if R is None else R[good]
        some = inverse(model, r[good], turned, select_rows(conditions, good), solver=solver)
        found = _insert_solutions(found, some, good)
    known = inverse_covariances(model, found, conditions) if covariance else None
    # A coordinate without a column was not asked for: that of the solution is no difference.
    asked = np.hstack([found.position, rotation_vector(found.rotation)])
    asked[:, given] = pose[:, given]
    if R is not None and "qw" not in table.header:
        R = rotation_matrix(asked[:, 3:])
    has_places = bool({*POSITION} & {*table.header})
    differences = Differences.of(found, asked[:, :3] if has_places else None, R)
    more = {f"{kind}_difference": size for kind, size in differences.uncontrolled(m).items()}
    text = _text(table.table, model.joints, found.joints, found, model.joints, known, more)
    read = (*wanted, *optional)
    warnings = (*table.list_warnings(model, read), *_list_unstated(model, conditions))
    return Answer(text, found, known, conditions, differences=differences, warnings=warnings)


def _pose_columns(m: Mechanism, header: set[str]) -> tuple[list[str], list[str]]:
    """Return the columns of the pose that a table with this header must have, and those that it may
    have."""
    has_quaternion = bool(header & {*QUATERNION})
    has_vector = bool(header & {*TURNS}) and not has_quaternion
    has_turns = has_quaternion or has_vector or not {*m.controls} & {*POSITION}
    has_places = bool(header & {*POSITION}) or not has_turns
    names = (POSITION if has_places else ()) + (TURNS if has_vector else ())
    wanted = [name for name in names if name in m.controls]
    optional = [name for name in names if name not in m.controls]
    if has_turns and not has_vector:
        wanted += QUATERNION
    return wanted, optional


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
        passive=np.full((n, len(model.mechanism.passive)), np.nan),
    )


def _insert_solutions(found: Solutions, some: Solutions, good: np.ndarray) -> Solutions:
    return replace(replace_rows(found, good, some), message=some.message)


def _conditions(model: Model, table: _SiTable, at: Conditions) -> dict[str, np.ndarray]:
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
    more: Mapping[str, np.ndarray],
) -> str:
    """Format the given cells, the solution, the standard deviations of the `uncertain` numbers
    (`sigma.x`) if they are known, `more` columns (N,), the residual (m) and the status as CSV.

    A row that is not solved keeps its cells. An answer whose name the table has already is
    `solved.NAME`.
    """
    if covariances is not None:
        names = [*names, *(f"sigma.{name}" for name in uncertain)]
        variances = np.diagonal(covariances, axis1=1, axis2=2)
        values = np.hstack([values, np.sqrt(variances)])
    names, values = [*names, *more, "residual", "status"], np.column_stack([values, *more.values()])
    taken = {part for word in table.header for part in (word, split_unit(word)[0])}
    added = list[str]()
    for name in names:
        while name in taken:
            name = f"solved.{name}"
        added.append(name)
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([*table.header, *added])
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
