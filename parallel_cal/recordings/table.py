"""A table in a text file: a header and rows, read as numbers by column.

Commas, semicolons or tabs separate the cells. The decimal sign is a point, or a comma if commas do
not separate the cells. A column in which both occur has thousands separators, and is refused.
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
from parallel_cal.base.files import MEGABYTE, read_foreign_text
from parallel_cal.base.float_fields import UNCONVERTED, find_unconverted
from parallel_cal.base.units import (
    CONDITION_UNIT_ALIASES,
    CONDITION_UNITS,
    PIXEL,
    UNIT_ALIASES,
    UNITS,
)
from parallel_cal.model.effect import CONDITIONS
from parallel_cal.recordings.motive import is_motive, merge_header
from parallel_cal.recordings.vicon import HEADER_LINES, convert_rows, is_vicon

TABLE_SUFFIXES = (".csv", ".tsv", ".txt")
MAX_TABLE_BYTES = 512 * MEGABYTE


@dataclass(frozen=True)
class Table:
    """The header of a table, its rows as text, and the line number of each row."""

    path: Path
    header: list[str]
    rows: list[list[str]]
    lines: list[int]
    decimal: str = "."
    exported: bool = False  # by a program whose tables have many columns besides those of interest

    def find(self, name: str) -> str | None:
        """Return the header's word for a column: its name, or name and unit (`x [mm]`, `x_mm`)."""
        if name in self.header:
            return name
        splits = (split_unit, split_condition)
        return next((w for w in self.header if name in [split(w)[0] for split in splits]), None)

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
        return np.array([self._number(text) for text in self.texts(name)], dtype=float)

    def _number(self, text: str) -> float:
        try:
            # Python would read 1_000, too.
            return math.nan if "_" in text else float(text.replace(self.decimal, "."))
        except ValueError:
            return math.nan

    def numbers(self, names: Sequence[str]) -> np.ndarray:
        """Return (N, len(names)); DatasetError at the first cell that is not a finite number."""
        columns = []
        for name in names:
            numbers, texts = self.column(name), self.texts(name)
            for k in np.flatnonzero(~np.isfinite(numbers)):
                hint = ""
                if "," in texts[k] and self.decimal != ",":
                    hint = ". A decimal comma needs a semicolon or a tab between the cells"
                raise DatasetError(
                    f"{self.path}:{self.lines[k]}: column {name} contains "
                    f"{texts[k]!r:.60}, expected a finite number: enter one or remove "
                    f"the line{hint}"
                )
            if (row := find_unconverted(numbers)) is not None:
                raise DatasetError(
                    f"{self.path}:{self.lines[row]}: column {name} contains {texts[row]!r:.60}: "
                    f"{UNCONVERTED}"
                )
            self._check_decimal_sign(name, texts)
            columns.append(numbers)
        return np.column_stack(columns)

    def _check_decimal_sign(self, name: str, texts: Sequence[str]) -> None:
        """Raise DatasetError if some numbers of a column have a comma and some have a point."""
        if self.decimal != ",":
            return
        commas = [k for k, text in enumerate(texts) if "," in text]
        points = [k for k, text in enumerate(texts) if "." in text]
        if commas and points:
            first, other = commas[0], points[0]
            raise DatasetError(
                f"{self.path}:{self.lines[first]}: column {name} contains {texts[first]!r:.60}, "
                f"but {texts[other]!r:.60} in line {self.lines[other]}: expected a comma or a "
                "point as decimal sign, not both. Export the table without thousands separators"
            )


def read_table(path: Path) -> Table:
    """Read a table with a header line; skip empty lines and leading `#` lines.

    The header of an export of OptiTrack's Motive (motive.py), or of Vicon's Tracker or Nexus
    (vicon.py), is merged into one line.

    DatasetError if the file is not such a table.
    """
    try:
        text = read_foreign_text(path, MAX_TABLE_BYTES)
    except OSError as error:
        raise DatasetError(f"{path}: the table cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise DatasetError(
            f"{path}: not a CSV table: it is not text (UTF-8, UTF-16 or Latin-1). Export it as CSV "
            "text"
        ) from None
    lines = text.splitlines(keepends=True)
    remarks = next((k for k, l in enumerate(lines) if l.strip() and l[0] != "#"), len(lines))
    body = "".join(lines[remarks:])
    try:
        apart = max(
            ",;\t", key=lambda sign: len(next(csv.reader(io.StringIO(body), delimiter=sign), []))
        )
        reader = csv.reader(io.StringIO(body), delimiter=apart, strict=True)
        found = [(remarks + reader.line_num, row) for row in reader if row]
    except csv.Error as error:
        raise DatasetError(f"{path}: not a CSV table: {error}") from None
    if not found or not any(found[0][1]):
        raise DatasetError(f"{path}:1: the file is empty; expected a header line")
    cells = [row for _, row in found]
    if is_vicon(cells):
        header, converted = convert_rows(cells)
        numbers = [line for line, _ in found[HEADER_LINES:]]
        rows = [*zip(numbers, converted, strict=False)]
    elif is_motive(cells):
        last, header = merge_header(cells)
        rows = [
            (line, [*row, *[""] * len(header)][: len(header)]) for line, row in found[last + 1 :]
        ]
    else:
        (_, header), *rows = found
    names = [" ".join(name.split()) for name in header]  # Excel breaks lines within a cell
    decimal = "." if apart == "," else ","
    exported = is_vicon(cells) or is_motive(cells)
    texts, numbers = [row for _, row in rows], [line for line, _ in rows]
    return Table(path, names, texts, numbers, decimal, exported)


def is_table(path: Path) -> bool:
    """Return whether a path is a table, by its suffix."""
    return path.suffix.lower() in TABLE_SUFFIXES


def split_unit(word: str) -> tuple[str, str | None]:
    """Split `x [mm]`, `x (mm)`, `x_mm`, `x/mm` or `x mm`; (word, None) if there is no unit."""
    name, unit = _split_last_word(word)
    unit = UNIT_ALIASES.get(unit.lower(), unit.lower())
    return (name, unit) if unit in UNITS or unit == PIXEL else (word, None)


def split_condition(word: str) -> tuple[str, str | None]:
    """Split `temperature [degC]` or `time_ms`; (word, None) if there is no unit of a condition.

    Without brackets, only the name of a condition has a unit: `arm_g` is a name.
    """
    name, unit = _split_last_word(word)
    unit = CONDITION_UNIT_ALIASES.get(unit.lower(), unit)
    known = any(unit in units for units in CONDITION_UNITS.values())
    stated = word.rstrip().endswith(("]", ")")) or name.split(".")[0] in CONDITIONS
    return (name, unit) if known and stated else (word, None)


def _split_last_word(word: str) -> tuple[str, str]:
    """Split a header's word into a name and what may be its unit, empty if there is none."""
    match = re.fullmatch(r"(.+?)\s*(?:\[(.+)\]|\((.+)\)|[_/ ]\s*([^_/ ]+))", word)
    if match is None:
        return word, ""
    return match[1], next(group for group in match.groups()[1:] if group).strip()
