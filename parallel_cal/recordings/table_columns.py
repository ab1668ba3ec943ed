"""The columns of tables in SI units, as a column map describes them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.rotation import quaternion_to_matrix
from parallel_cal.base.units import (
    CONDITION_UNITS,
    LENGTHS,
    PIXEL,
    SECONDS,
    UNITS,
    find_clock_unit,
)
from parallel_cal.model.effect import CONDITIONS
from parallel_cal.recordings.columns import (
    ColumnMap,
    JointColumn,
    ReadingColumn,
    Term,
    si_unit,
    travel,
)
from parallel_cal.recordings.recording import Array
from parallel_cal.recordings.table import Table, split_condition, split_unit

MAX_QUATERNION_LENGTH_ERROR = 0.05
MAX_MATRIX_ERROR = 0.02  # of an element of R R^T


def name_unused_columns(
    tables: Sequence[Table], wanted: ColumnMap, used: Sequence[str]
) -> list[str]:
    """Return a note for each table with columns that are neither wanted nor `used` otherwise; none
    for an export of a device's program, which always has such columns."""
    notes = []
    for table in tables:
        place = wanted.position
        if table.assumed_unit and place and not place.unit and table.find(place.names[0]):
            notes.append(
                f"{table.path}: it states no unit of lengths, so {', '.join(place.names)} are "
                f"taken to be in {table.assumed_unit}. If they are not, state the unit in the "
                "column map (position: {unit: mm})"
            )
        taken = {table.find(name) for name in (*wanted.columns, *used) if name}
        unused = [word for word in table.header if word and word not in taken]
        if unused and not table.exported:
            notes.append(f"{table.path}: columns that are not used: {', '.join(unused)}")
    return notes


@dataclass(frozen=True)
class Columns:
    """The columns of tables, in SI units; `map` names the requester."""

    tables: Sequence[Table]
    map: str

    def check(self, wanted: ColumnMap, shared: str = "") -> Columns:
        """Return these columns, whose bad cells are named together; DatasetError for a column that
        no table or more than one table has.

        Several tables may have the column `shared`.
        """
        for name in wanted.columns:
            having = [str(table.path) for table in self.tables if table.find(name)]
            if len(having) > 1 and name != shared:
                raise DatasetError(
                    f"column {name} is in {' and '.join(having)}: rename one of them"
                )
            if not having:
                has = "; ".join(", ".join(t.header) for t in self.tables)
                raise DatasetError(
                    f"{', '.join(f'{t.path}:1' for t in self.tables)}: no column {name}, "
                    f"which {self.map} names; the table has {has}"
                )
        tables = []
        for table in self.tables:
            words = [word for name in wanted.number_columns if (word := table.find(name))]
            tables.append(replace(table, needed=tuple(words)))
        return replace(self, tables=tables)

    def require_one_table(self, names: Sequence[str]) -> Table:
        """Return the table that has all these columns; DatasetError if they are in several."""
        having = {str(table.path): table for table, _ in map(self._find_column, names)}
        if len(having) > 1:
            raise DatasetError(
                f"the columns {', '.join(names)} are in {' and '.join(having)}, expected in one "
                "table, because each table has its own times"
            )
        return next(iter(having.values()))

    def si(self, names: Sequence[str], unit: str | None, gaps: bool = False) -> Array:
        """Return columns (N, len(names)) in m or rad; with `gaps`, an empty cell is NaN."""
        return np.column_stack([self._column(name, unit, gaps) for name in names])

    def reading(self, wanted: ReadingColumn) -> Array:
        """Return readings (N,) in m, rad or px; an empty cell is NaN."""
        return self._column(wanted.column, wanted.unit, gaps=True, pixels=True)

    def joint(self, wanted: JointColumn, gaps: bool = False) -> Array:
        """Return (N, 1) readings in m or rad; DatasetError if the units of its columns, per_rev and
        offset do not fit each other."""
        terms = [self._term(name, term, gaps) for name, term in wanted.terms.items()]
        readings = np.sum(terms, axis=0)
        joint_unit = self.joint_unit(wanted)
        if wanted.offset is None:
            return readings
        if si_unit(wanted.offset.split()[1]) != joint_unit:
            table, word = self._find_column(next(iter(wanted.terms)))
            raise DatasetError(
                f"{table.path}:1: column {word} gives a joint in {joint_unit}, but {self.map} has "
                f"the offset {wanted.offset}: state the offset in a unit of the joint"
            )
        return readings + travel(wanted.offset)

    def _term(self, name: str, term: Term, gaps: bool) -> Array:
        """Return (N, 1) what a column contributes to a joint, in m or rad."""
        table, word = self._find_column(name)
        unit = term.unit or split_unit(word)[1]
        if term.per_rev is not None and unit in LENGTHS:
            raise DatasetError(
                f"{table.path}:1: column {word} is in {unit}, but {self.map} has per_rev "
                f"{term.per_rev}, which needs an angle: state the motor's unit (unit: "
                "rev or deg), or remove per_rev"
            )
        return self.si([name], term.unit, gaps) * term.factor * term.per_radian

    def joint_unit(self, wanted: JointColumn) -> str:
        """Return the SI unit of a joint, m or rad; DatasetError if its columns have both."""
        units = dict[str, str]()
        for name, term in wanted.terms.items():
            table, word = self._find_column(name)
            units[word] = term.joint_unit(term.unit or split_unit(word)[1] or "")
        if len({*units.values()}) > 1:
            found = ", ".join(f"{word} in {unit}" for word, unit in units.items())
            raise DatasetError(
                f"{table.path}:1: {self.map} adds lengths and angles to one joint: {found}; state "
                "how far the joint moves per turn of the column that is an angle: "
                "{factor: 1, per_rev: 16 mm}"
            )
        return next(iter(units.values()))

    def numbers(self, names: Sequence[str], gaps: bool = False) -> Array:
        """Return (N, len(names)) without conversion; DatasetError at a cell that is not finite.

        With `gaps`, an empty cell is NaN.
        """
        return np.column_stack(
            [t.numbers([word], gaps) for t, word in map(self._find_column, names)]
        )

    def condition(self, name: str, column: str) -> Array:
        """Return a condition (N,) in its SI unit, degC for a temperature. A header without a unit
        means this unit, except for times since 1970, which tell theirs by their size. DatasetError
        for a unit of another quantity."""
        table, word = self._find_column(column)
        own = CONDITIONS.get(name.split(".")[0], ("", 0.0, False))[0]
        known = CONDITION_UNITS.get(own, {})
        unit = split_condition(word)[1] or split_unit(word)[1]
        if known and unit and unit not in known:
            raise DatasetError(
                f"{table.path}:1: column {word} is in {unit}, but {name} is in {own}: expected one "
                f"of {', '.join(known)}"
            )
        shown = self.numbers([column])[:, 0]
        if own == "s":
            clock = find_clock_unit(shown)
            unit = unit or clock
            if SECONDS.get(unit, 1.0) > SECONDS[clock]:
                raise DatasetError(
                    f"{table.path}:1: column {word} contains times up to {shown.max():.4g}, which "
                    f"are no times in {unit}: state their unit in the header (time [{clock}])"
                )
        factor, offset = known.get(unit or own, (UNITS.get(unit or "", 1.0), 0.0))
        return shown * factor + offset

    def describe_clocks(self, wanted: ColumnMap) -> list[str]:
        """Return a note if the unit of the condition `time` follows from its size only."""
        column = wanted.conditions.get("time")
        if not isinstance(column, str):
            return []
        table, word = self._find_column(column)
        unit = find_clock_unit(self.numbers([column]))
        if unit == "s" or split_condition(word)[1]:
            return []
        return [
            f"{table.path}: column {word} states no unit; its numbers are times since 1970 in "
            f"{unit}"
        ]

    def texts(self, name: str) -> list[str]:
        table, word = self._find_column(name)
        return table.texts(word)

    def position(self, wanted: ColumnMap, gaps: bool = False) -> Array | None:
        """Return positions (N, 3) in m, 0 for a coordinate that is not measured; None if none
        is."""
        if wanted.position is None:
            return None
        table, word = self._find_column(wanted.position.names[0])
        assumed = None if split_unit(word)[1] else table.assumed_unit or None
        found = self.si(wanted.position.names, wanted.position.unit or assumed, gaps)
        position = np.zeros((len(found), 3))
        position[:, wanted.position.measured] = found
        return position

    def rotation(self, wanted: ColumnMap, gaps: bool = False) -> Array | None:
        """Return rotations (N, 3, 3); None if they are not measured."""
        turned = wanted.angles or wanted.rotation_vector
        if turned is not None:
            from scipy.spatial.transform import Rotation

            turns = self.si(turned.columns, turned.unit, gaps)
            kept = ~np.isnan(turns).any(axis=1)
            R = np.full((len(turns), 3, 3), np.nan)
            R[kept] = (
                Rotation.from_euler(wanted.angles.axes, turns[kept])
                if wanted.angles
                else Rotation.from_rotvec(turns[kept])
            ).as_matrix()
            return R
        if wanted.matrix is not None:
            return self._rotation_matrix(wanted.matrix, gaps)
        given = wanted.orientation
        if given is None:
            return None
        quaternions = self.numbers(given, gaps)
        length = np.linalg.norm(quaternions, axis=1)
        if (bad := np.flatnonzero(np.abs(length - 1) > MAX_QUATERNION_LENGTH_ERROR)).size:
            table, _ = self._find_column(given[0])
            raise DatasetError(
                f"{table.path}:{table.lines[bad[0]]}: {', '.join(given)} are a quaternion of "
                f"length {length[bad[0]]:.4g}, expected 1: check that the columns are x, y, z and "
                "w, or remove the line"
            )
        return quaternion_to_matrix(quaternions)

    def _rotation_matrix(self, names: Sequence[str], gaps: bool) -> Array:
        """Return rotations (N, 3, 3) of columns with the elements of matrices, row by row."""
        R = self.numbers(names, gaps).reshape(-1, 3, 3)
        error = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        wrong = (error > MAX_MATRIX_ERROR) | (np.linalg.det(R) < 0)
        if (bad := np.flatnonzero(wrong)).size:
            table, _ = self._find_column(names[0])
            raise DatasetError(
                f"{table.path}:{table.lines[bad[0]]}: {', '.join(names)} are no rotation matrix: "
                "check that the columns are its elements row by row, or remove the line"
            )
        left, _, right = np.linalg.svd(np.where(np.isnan(R), np.eye(3), R))  # rounded in the file
        return np.where(np.isnan(R), np.nan, left @ right)

    def _find_column(self, name: str) -> tuple[Table, str]:
        return next((t, word) for t in self.tables if (word := t.find(name)) is not None)

    def _column(self, name: str, unit: str | None, gaps: bool, pixels: bool = False) -> Array:
        table, word = self._find_column(name)
        in_header = split_unit(word)[1]
        if unit is None and in_header is None:
            raise DatasetError(
                f"{table.path}:1: column {word} has no unit; state it in {self.map} "
                f"(unit: mm) or in the header ({word} [mm])"
                + ("; pixels of a camera: px" if pixels else "")
            )
        if unit and in_header and unit != in_header:
            raise DatasetError(
                f"{table.path}:1: column {word} is in {in_header}, but {self.map} states {unit}"
            )
        stated = unit or in_header or ""
        if stated == PIXEL and not pixels:
            raise DatasetError(
                f"{table.path}:1: column {word} is in px, expected a length or an angle; only "
                "readings of a camera are in pixels"
            )
        if stated not in UNITS and stated != PIXEL:
            raise DatasetError(
                f"{table.path}:1: column {word} is in {stated}, expected a length or an angle"
            )
        return table.numbers([word], gaps)[:, 0] * (1.0 if stated == PIXEL else UNITS[stated])
