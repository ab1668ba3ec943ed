"""Tables and a column map -> Dataset: measurements without a bag."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.rotation import quaternion_to_matrix
from parallel_cal.base.units import LENGTHS, UNITS
from parallel_cal.recordings.columns import (
    ColumnMap,
    Join,
    JointColumn,
    read_column_map,
)
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.recording import Dropped
from parallel_cal.recordings.samples import READING
from parallel_cal.recordings.table import Table, read_table, split_unit


def import_csv(paths: str | Path | Sequence[str | Path], columns: str | Path) -> Dataset:
    """Return the dataset of one table, or of several joined tables, by a column map (YAML).

    DatasetError or ModelFileError name file, line and column of an error.
    """
    files = [Path(p) for p in ([paths] if isinstance(paths, str | Path) else paths)]
    tables = [read_table(file).drop_empty_rows() for file in files]
    return make_dataset(tables, read_column_map(Path(columns)), str(columns))


def make_dataset(given: Sequence[Table], wanted: ColumnMap, asks: str) -> Dataset:
    """Return the dataset of tables that contain what is `wanted`; `asks` names the requester."""
    tables, dropped = _join_tables([*given], wanted.join)
    found = Columns(tables, asks).check(wanted)
    joints = [found.joint(joint) for joint in wanted.joints.values()]
    r = found.si(wanted.position.columns, wanted.position.unit) if wanted.position else None
    R, n = _rotation(wanted, found), len(tables[0].rows)
    readings = {
        READING + name: found.si([one.column], one.unit, gaps=True)[:, 0]
        for name, one in wanted.readings.items()
    }
    conditions = {
        name: found.numbers([given])[:, 0] if isinstance(given, str) else np.full(n, given)
        for name, given in wanted.conditions.items()
    }
    noise = wanted.noise  # as the manufacturers state it; NaN if they do not
    sigma = np.repeat([noise.position or np.nan, noise.orientation or np.nan], 3)
    pose_id = None
    if wanted.group is not None:
        pose_id = np.unique(found.texts(wanted.group), return_inverse=True)[1]
    return Dataset.from_arrays(
        tuple(wanted.joints),
        np.hstack(joints),
        np.zeros((n, 3)) if r is None else r,
        R,
        measured=np.repeat([r is not None, R is not None], 3),
        pose_cov=np.where(np.isnan(sigma), np.nan, np.diag(sigma**2)),
        joint_sigma=wanted.noise.joint,
        conditions=conditions | readings,
        pose_id=pose_id,
        source=" + ".join(str(table.path) for table in given),
        sha256=hashlib.sha256(b"".join(table.path.read_bytes() for table in given)).hexdigest(),
        dropped=tuple(dropped),
    )


@dataclass(frozen=True)
class Columns:
    """The columns of tables whose rows correspond, in SI units; `map` names the requester."""

    tables: Sequence[Table]
    map: str

    def check(self, wanted: ColumnMap) -> Columns:
        """Return self; DatasetError for a column that no table or more than one table has."""
        for name in wanted.columns:
            having = [str(table.path) for table in self.tables if table.find(name)]
            if len(having) > 1:
                raise DatasetError(
                    f"column {name} is in {' and '.join(having)}: rename one of them"
                )
            if not having:
                has = "; ".join(", ".join(t.header) for t in self.tables)
                raise DatasetError(
                    f"{', '.join(f'{t.path}:1' for t in self.tables)}: no column {name}, "
                    f"which {self.map} names; the table has {has}"
                )
        return self

    def si(self, names: Sequence[str], unit: str | None, gaps: bool = False) -> np.ndarray:
        """Return columns (N, len(names)) in m or rad; with `gaps`, an empty cell is NaN."""
        return np.column_stack([self._column(name, unit, gaps) for name in names])

    def joint(self, wanted: JointColumn) -> np.ndarray:
        """Return (N, 1) readings in m or rad; DatasetError if per_rev is given for a length."""
        table, word = self._find_column(wanted.column)
        unit = wanted.unit or split_unit(word)[1]
        if wanted.per_rev is not None and unit in LENGTHS:
            raise DatasetError(
                f"{table.path}:1: column {word} is in {unit}, but {self.map} has per_rev "
                f"{wanted.per_rev}, which needs an angle: state the motor's unit (unit: "
                "rev or deg), or remove per_rev"
            )
        return self.si([wanted.column], wanted.unit) * wanted.per_radian

    def numbers(self, names: Sequence[str]) -> np.ndarray:
        """Return (N, len(names)) without conversion; DatasetError at a cell that is not finite."""
        return np.column_stack(
            [t.numbers([word])[:, 0] for t, word in map(self._find_column, names)]
        )

    def texts(self, name: str) -> list[str]:
        table, word = self._find_column(name)
        return table.texts(word)

    def _find_column(self, name: str) -> tuple[Table, str]:
        return next((t, word) for t in self.tables if (word := t.find(name)) is not None)

    def _column(self, name: str, unit: str | None, gaps: bool) -> np.ndarray:
        table, word = self._find_column(name)
        said = split_unit(word)[1]
        if unit is None and said is None:
            raise DatasetError(
                f"{table.path}:1: column {word} has no unit; state it in {self.map} "
                f"(unit: mm) or in the header ({word} [mm])"
            )
        if unit and said and unit != said:
            raise DatasetError(
                f"{table.path}:1: column {word} is in {said}, but {self.map} states {unit}"
            )
        filled = [k for k, text in enumerate(table.texts(word)) if text or not gaps]
        values = np.full(len(table.rows), np.nan)
        values[filled] = table.select(filled).numbers([word])[:, 0] * UNITS[unit or said or ""]
        return values


def _join_tables(tables: list[Table], join: Join | None) -> tuple[list[Table], list[Dropped]]:
    """Return tables of corresponding rows, and the rows that lack a partner in a table."""
    if len(tables) == 1:
        return tables, []
    if join is None:
        counts = {str(table.path): len(table.rows) for table in tables}
        if len({*counts.values()}) > 1:
            raise DatasetError(
                f"{' and '.join(f'{n} rows in {p}' for p, n in counts.items())}: state in "
                "the column map how they belong together (join: {by: COLUMN})"
            )
        return tables, []
    for table in tables:
        if table.find(join.by) is None:
            raise DatasetError(f"{table.path}:1: no column {join.by} to join by")
    one = min(tables, key=lambda table: len(table.rows))
    partners = np.column_stack([_find_partners(one, table, join) for table in tables])
    kept = (partners >= 0).all(axis=1)
    if not kept.any():
        raise DatasetError(
            f"no row of {one.path} has the same {join.by} as a row of the other tables"
        )
    unpaired = [(one, np.flatnonzero(~kept).tolist())]
    if join.within is None:  # in a log by time, most rows belong to no sample
        for table, rows in zip(tables, partners[kept].T, strict=True):
            if table is not one:
                unpaired.append((table, sorted({*range(len(table.rows))} - {*rows.tolist()})))
    dropped = [
        Dropped(
            0.0,
            "no partner",
            f"{table.path}:{table.lines[k]}: no other table has its {join.by}",
        )
        for table, rest in unpaired
        for k in rest
    ]
    chosen = [t.select(rows.tolist()) for t, rows in zip(tables, partners[kept].T, strict=True)]
    # Only the first table keeps the column that joins them: a column must be in one table only.
    others = [
        dataclasses.replace(t, header=["" if w == t.find(join.by) else w for w in t.header])
        for t in chosen[1:]
    ]
    return [chosen[0], *others], dropped


def _find_partners(one: Table, other: Table, join: Join) -> np.ndarray:
    """Return the row (N,) of `other` that belongs to each row of `one`; -1 if there is none."""
    mine, its = one.find(join.by) or "", other.find(join.by) or ""
    if join.within is not None:
        at, among = one.numbers([mine])[:, 0], other.numbers([its])[:, 0]
        order = np.argsort(among, kind="stable")
        after = np.searchsorted(among[order], at).clip(1, max(len(among) - 1, 1))
        around = order[np.minimum(np.stack([after - 1, after]), len(among) - 1)]
        nearest = np.where(np.diff(np.abs(among[around] - at), axis=0)[0] < 0, *around[::-1])
        return np.where(np.abs(among[nearest] - at) <= join.within, nearest, -1)
    texts = other.texts(its)
    for table, words in ((other, texts), (one, one.texts(mine))):
        first = dict(zip(words[::-1], range(len(words))[::-1], strict=True))
        if twice := [k for k, text in enumerate(words) if first[text] < k]:
            raise DatasetError(
                f"{table.path}:{table.lines[twice[0]]}: {join.by} {words[twice[0]]} occurs twice"
            )
    rows = {text: k for k, text in enumerate(texts)}
    return np.array([rows.get(text, -1) for text in one.texts(mine)])


def _rotation(wanted: ColumnMap, found: Columns) -> np.ndarray | None:
    if (turned := wanted.angles) is not None:
        from scipy.spatial.transform import Rotation

        turns = found.si(turned.columns, turned.unit)
        return np.asarray(Rotation.from_euler(turned.axes, turns).as_matrix())
    given = wanted.orientation
    if given is None:
        return None
    quaternions = found.numbers(given)
    length = np.linalg.norm(quaternions, axis=1)
    if (bad := np.flatnonzero(np.abs(length - 1) > 0.05)).size:
        table, _ = found._find_column(given[0])
        raise DatasetError(
            f"{table.path}:{table.lines[bad[0]]}: {', '.join(given)} are a quaternion of length "
            f"{length[bad[0]]:.4g}, expected 1: check that the columns are x, y, z and w, or "
            "remove the line"
        )
    return quaternion_to_matrix(quaternions)
