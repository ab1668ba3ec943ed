"""A CSV table and a column map -> Dataset: measurements that no bag was recorded of."""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import io
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.rotation import quaternion_to_matrix
from parallel_cal.recordings.columns import ColumnMap, read_column_map
from parallel_cal.recordings.dataset import Dataset

SI = {"rad": 1.0, "deg": math.pi / 180, "m": 1.0, "mm": 1e-3}


def import_csv(path: str | Path, columns: str | Path) -> Dataset:
    """The dataset of a CSV table, read as a column map (YAML) says.

    DatasetError or ModelFileError naming file, line and column of what is wrong.
    """
    wanted, table = read_column_map(Path(columns)), read_table(Path(path))
    if missing := [name for name in wanted.columns if name not in table.header]:
        raise DatasetError(
            f"{path}:1: no column {', '.join(missing)}, which {columns} names; the table has "
            f"{', '.join(table.header)}"
        )
    joints = [table.numbers([joint.column]) * SI[joint.unit] for joint in wanted.joints.values()]
    r, R = _position(wanted, table), _rotation(wanted, table)
    conditions = _conditions(wanted, table)
    found = Dataset.from_arrays(
        tuple(wanted.joints),
        np.hstack(joints),
        np.zeros((len(table.rows), 3)) if r is None else r,
        R,
        measured=np.repeat([r is not None, R is not None], 3),
        pose_cov=_covariance(wanted),
        joint_sigma=wanted.noise.joint,
        conditions=conditions,
        pose_id=_visits(wanted, table),
        source=str(path),
        sha256=hashlib.sha256(Path(path).read_bytes()).hexdigest(),
    )
    # The order of lines is no time: drift must not be judged by it.
    return dataclasses.replace(found, conditions=conditions)


@dataclasses.dataclass(frozen=True)
class Table:
    """The rows of a CSV file as text, and the line each stands in."""

    path: Path
    header: list[str]
    rows: list[list[str]]
    lines: list[int]

    def texts(self, name: str) -> list[str]:
        column = self.header.index(name)
        return [row[column].strip() for row in self.rows]

    def numbers(self, names: Sequence[str]) -> np.ndarray:
        """(N, len(names)); DatasetError at the first cell that is not a finite number."""
        return np.array([self._column(name) for name in names], dtype=float).T

    def _column(self, name: str) -> list[float]:
        pairs = zip(self.texts(name), self.lines, strict=True)
        return [self._number(name, text, line) for text, line in pairs]

    def _number(self, name: str, text: str, line: int) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise DatasetError(
                f"{self.path}:{line}: column {name} holds '{text}', expected a finite number: "
                "fill it in or take the line out"
            )
        return value


def read_table(path: Path) -> Table:
    """A CSV file with a header line; blank lines are skipped."""
    try:
        reader = csv.reader(io.StringIO(path.read_text(encoding="utf-8-sig")), strict=True)
        found = [(reader.line_num, row) for row in reader if any(map(str.strip, row))]
    except (UnicodeDecodeError, csv.Error) as error:
        raise DatasetError(f"{path}: not a CSV table: {error}") from None
    if len(found) < 2:
        raise DatasetError(f"{path}: expected a header line and samples, found {len(found)} lines")
    (first, names), *samples = found
    header = [name.strip() for name in names]
    if len(set(header)) < len(header):
        raise DatasetError(f"{path}:{first}: a column occurs twice in '{','.join(header)}'")
    for line, row in samples:
        if len(row) != len(header):
            raise DatasetError(f"{path}:{line}: {len(row)} cells, the header has {len(header)}")
    return Table(path, header, [row for _, row in samples], [line for line, _ in samples])


def _position(wanted: ColumnMap, table: Table) -> np.ndarray | None:
    given = wanted.position
    return table.numbers(given.columns) * SI[given.unit] if given else None


def _rotation(wanted: ColumnMap, table: Table) -> np.ndarray | None:
    names = wanted.orientation
    if names is None:
        return None
    quaternions = table.numbers(names)
    length = np.linalg.norm(quaternions, axis=1)
    if bad := [line for line, l in zip(table.lines, length, strict=True) if abs(l - 1) > 0.05]:
        raise DatasetError(
            f"{table.path}:{bad[0]}: {', '.join(names)} are no quaternion x y z w of length 1"
        )
    return quaternion_to_matrix(quaternions)


def _covariance(wanted: ColumnMap) -> np.ndarray:
    """(6, 6) as the device's maker states it, NaN for what he does not."""
    noise = wanted.noise
    sigma = np.repeat([noise.position or np.nan, noise.orientation or np.nan], 3)
    return np.where(np.isnan(sigma), np.nan, np.diag(sigma**2))


def _conditions(wanted: ColumnMap, table: Table) -> dict[str, np.ndarray]:
    n = len(table.rows)
    return {
        name: table.numbers([given])[:, 0] if isinstance(given, str) else np.full(n, given)
        for name, given in wanted.conditions.items()
    }


def _visits(wanted: ColumnMap, table: Table) -> np.ndarray | None:
    if wanted.group is None:
        return None
    return np.unique(table.texts(wanted.group), return_inverse=True)[1]
