"""A table in a text file: a header and rows, read as numbers by column.

Commas, semicolons or tabs separate the cells. The decimal sign is a point, or a comma if commas do
not separate the cells.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.units import UNIT_ALIASES, UNITS


@dataclass(frozen=True)
class Table:
    """The header of a table, its rows as text, and the line number of each row."""

    path: Path
    header: list[str]
    rows: list[list[str]]
    lines: list[int]
    decimal: str = "."

    def find(self, name: str) -> str | None:
        """Return the header's word for a column: its name, or name and unit (`x [mm]`, `x_mm`)."""
        if name in self.header:
            return name
        return next((word for word in self.header if split_unit(word)[0] == name), None)

    def select(self, rows: Sequence[int]) -> Table:
        """Return the table with some rows, in this order."""
        return replace(self, rows=[self.rows[k] for k in rows], lines=[self.lines[k] for k in rows])

    def drop_empty_rows(self) -> Table:
        """Return the table without empty rows; DatasetError for a missing cell or repeated name."""
        kept = [k for k, row in enumerate(self.rows) if any(map(str.strip, row))]
        if not kept:
            raise DatasetError(f"{self.path}: expected a header line and rows, found only 1 line")
        if len(set(self.header)) < len(self.header):
            raise DatasetError(f"{self.path}:1: a column occurs twice in '{','.join(self.header)}'")
        for k in kept:
            if len(self.rows[k]) != len(self.header):
                raise DatasetError(
                    f"{self.path}:{self.lines[k]}: {len(self.rows[k])} cells, but the header "
                    f"has {len(self.header)}"
                )
        return self.select(kept)

    def texts(self, name: str) -> list[str]:
        """Return a column's cells; empty in rows whose length differs from the header's."""
        column, width = self.header.index(name), len(self.header)
        return [row[column].strip() if len(row) == width else "" for row in self.rows]

    def column(self, name: str) -> np.ndarray:
        """Return a column's numbers (N,); NaN for a cell that is not a number."""
        numbers = []
        for text in self.texts(name):
            try:
                numbers.append(float(text.replace(self.decimal, ".")))
            except ValueError:
                numbers.append(math.nan)
        return np.array(numbers, dtype=float)

    def numbers(self, names: Sequence[str]) -> np.ndarray:
        """Return (N, len(names)); DatasetError at the first cell that is not a finite number."""
        for name in names:
            for k in np.flatnonzero(~np.isfinite(self.column(name))):
                raise DatasetError(
                    f"{self.path}:{self.lines[k]}: column {name} contains "
                    f"'{self.texts(name)[k]}', expected a finite number: enter one or remove "
                    "the line"
                )
        return np.column_stack([self.column(name) for name in names])


def read_table(path: Path) -> Table:
    """Read a table with a header line; skip empty lines and leading `#` lines.

    DatasetError if the file is not such a table.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise DatasetError(f"{path}: the table cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise DatasetError(f"{path}: not a CSV table: not UTF-8. Save it as UTF-8") from None
    lines = text.splitlines(keepends=True)
    remarks = next((k for k, l in enumerate(lines) if l.strip() and l[0] != "#"), len(lines))
    first = lines[remarks] if remarks < len(lines) else ""
    apart = max(",;\t", key=first.count)
    reader = csv.reader(io.StringIO("".join(lines[remarks:])), delimiter=apart, strict=True)
    try:
        found = [(remarks + reader.line_num, row) for row in reader if row]
    except csv.Error as error:
        raise DatasetError(f"{path}: not a CSV table: {error}") from None
    if not found or not any(found[0][1]):
        raise DatasetError(f"{path}:1: the file is empty; expected a header line")
    (_, header), *rows = found
    names = [name.strip() for name in header]
    decimal = "." if apart == "," else ","
    return Table(path, names, [row for _, row in rows], [line for line, _ in rows], decimal)


def split_unit(word: str) -> tuple[str, str | None]:
    """Split `x [mm]`, `x (mm)`, `x_mm`, `x/mm` or `x mm`; (word, None) if there is no unit."""
    match = re.fullmatch(r"(.+?)\s*(?:\[(.+)\]|\((.+)\)|[_/ ]\s*([^_/ ]+))", word)
    if match is None:
        return word, None
    unit = next(group for group in match.groups()[1:] if group).strip()
    unit = UNIT_ALIASES.get(unit.lower(), unit.lower())
    return (match[1], unit) if unit in UNITS else (word, None)
