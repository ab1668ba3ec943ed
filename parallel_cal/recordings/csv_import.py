"""A CSV table and a column map -> Dataset: measurements that no bag was recorded of."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.rotation import quaternion_to_matrix
from parallel_cal.recordings.columns import ColumnMap, read_column_map
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.table import Table, read_table

SI = {"rad": 1.0, "deg": math.pi / 180, "m": 1.0, "mm": 1e-3}


def import_csv(path: str | Path, columns: str | Path) -> Dataset:
    """The dataset of a CSV table, read as a column map (YAML) says.

    DatasetError or ModelFileError naming file, line and column of what is wrong.
    """
    wanted, table = read_column_map(Path(columns)), read_table(Path(path)).complete()
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
