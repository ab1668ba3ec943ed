"""A CSV file: a header and rows of text, read as numbers by column."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import DatasetError


@dataclass(frozen=True)
class Table:
    """The header's names, the rows of a CSV file as text, and the line each stands in."""

    path: Path
    header: list[str]
    rows: list[list[str]]
    lines: list[int]

    def complete(self) -> Table:
        """Without rows that hold nothing; DatasetError where a cell is missing or a name twice."""
        kept = [k for k, row in enumerate(self.rows) if any(map(str.strip, row))]
        if not kept:
            raise DatasetError(f"{self.path}: expected a header line and samples, found 1 lines")
        if len(set(self.header)) < len(self.header):
            raise DatasetError(f"{self.path}:1: a column occurs twice in '{','.join(self.header)}'")
        for k in kept:
            if len(self.rows[k]) != len(self.header):
                raise DatasetError(
                    f"{self.path}:{self.lines[k]}: {len(self.rows[k])} cells, the header has "
                    f"{len(self.header)}"
                )
        rows, lines = [self.rows[k] for k in kept], [self.lines[k] for k in kept]
        return Table(self.path, self.header, rows, lines)

    def texts(self, name: str) -> list[str]:
        """A column's cells; empty in rows that are shorter or longer than the header."""
        column, width = self.header.index(name), len(self.header)
        return [row[column].strip() if len(row) == width else "" for row in self.rows]

    def column(self, name: str) -> np.ndarray:
        """(N,) numbers, NaN for what is none."""
        return np.array([_number(text) for text in self.texts(name)], dtype=float)

    def numbers(self, names: Sequence[str]) -> np.ndarray:
        """(N, len(names)); DatasetError at the first cell that is not a finite number."""
        for name in names:
            for k in np.flatnonzero(~np.isfinite(self.column(name))):
                raise DatasetError(
                    f"{self.path}:{self.lines[k]}: column {name} holds '{self.texts(name)[k]}', "
                    "expected a finite number: fill it in or take the line out"
                )
        return np.column_stack([self.column(name) for name in names])


def read_table(path: Path) -> Table:
    """A CSV file with a header line, empty lines skipped; DatasetError where it is none."""
    try:
        reader = csv.reader(io.StringIO(path.read_text(encoding="utf-8-sig")), strict=True)
        found = [(reader.line_num, row) for row in reader if row]
    except OSError as error:
        raise DatasetError(f"{path}: {error.strerror}: the table cannot be read") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise DatasetError(f"{path}: not a CSV table: {error}") from None
    if not found or not any(found[0][1]):
        raise DatasetError(f"{path}:1: empty; expected a header line")
    (_, header), *rows = found
    names = [name.strip() for name in header]
    return Table(path, names, [row for _, row in rows], [line for line, _ in rows])


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
