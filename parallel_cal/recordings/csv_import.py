"""Convert tables to samples: measurements without a bag."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from parallel_cal.base.errors import DatasetError, format_suggestion
from parallel_cal.recordings.columns import ColumnMap, read_column_map
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.loading import load_tables
from parallel_cal.recordings.options import ReadOptions
from parallel_cal.recordings.robot_conventions import CONVENTIONS
from parallel_cal.recordings.table import read_table


def import_csv(
    paths: str | Path | Sequence[str | Path],
    columns: str | Path | None = None,
    options: ReadOptions | None = None,
    robot: str | None = None,
) -> Dataset:
    """Return the dataset of one table, or of several joined tables, by a column map (YAML).

    `options` apply to tables that log a moving robot. In place of a column map, `robot` names the
    maker of an arm, if the columns have the maker's usual names. DatasetError or ModelFileError
    name file, line and column of an error.
    """
    files = [Path(p) for p in ([paths] if isinstance(paths, str | Path) else paths)]
    tables = [read_table(file).drop_empty_rows() for file in files]
    if robot is None:
        if columns is None:
            raise DatasetError(
                "no column map and no robot: state a column map (--columns MAP.yaml) or the maker "
                f"of an arm (--robot {', '.join(CONVENTIONS)})"
            )
        return load_tables(tables, read_column_map(Path(columns)), str(columns), options)
    if columns is not None:
        raise DatasetError(
            f"a column map is given as well as robot={robot}: write 'robot: {robot}' into {columns}"
        )
    if robot not in CONVENTIONS:
        near = format_suggestion(robot, list(CONVENTIONS))
        raise DatasetError(f"robot={robot}{near}: expected one of {', '.join(CONVENTIONS)}")
    stated: dict[str, Any] = {"robot": robot}
    convention = CONVENTIONS[robot]
    if not any(table.find(name) for table in tables for name in convention.turns):
        stated["position"] = {"columns": list(convention.position)}  # as a tracker measures it
    return load_tables(tables, ColumnMap.model_validate(stated), f"robot={robot}", options)
