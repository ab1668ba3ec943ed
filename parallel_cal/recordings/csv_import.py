"""Convert tables to samples: measurements without a bag."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from parallel_cal.recordings.columns import read_column_map
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.loading import load_tables
from parallel_cal.recordings.options import ReadOptions
from parallel_cal.recordings.table import read_table


def import_csv(
    paths: str | Path | Sequence[str | Path],
    columns: str | Path,
    options: ReadOptions | None = None,
) -> Dataset:
    """Return the dataset of one table, or of several joined tables, by a column map (YAML).

    `options` apply to tables that log a moving robot. DatasetError or ModelFileError name file,
    line and column of an error.
    """
    files = [Path(p) for p in ([paths] if isinstance(paths, str | Path) else paths)]
    tables = [read_table(file).drop_empty_rows() for file in files]
    return load_tables(tables, read_column_map(Path(columns)), str(columns), options)
