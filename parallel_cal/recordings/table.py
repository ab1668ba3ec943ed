"""A table in a text file: a header and rows, read as numbers by column.

Commas, semicolons, tabs or spaces separate the cells (heading.py). The decimal sign is a point, or
a comma if commas do not separate the cells. A column in which both occur has thousands separators,
and is refused.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterable, Sequence
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
from parallel_cal.recordings.foreign_files import describe_foreign
from parallel_cal.recordings.heading import (
    SPACE,
    find_heading,
    find_separator,
    is_remark,
    join_brackets,
    join_units,
    split_cells,
)
from parallel_cal.recordings.motive import FIRST_CELL, is_motive, merge_header
from parallel_cal.recordings.vicon import (
    HEADER_LINES,
    KINDS,
    OTHER_KINDS,
    convert_rows,
    find_first_table,
    is_vicon,
)

TABLE_SUFFIXES = (".csv", ".tsv", ".txt")
MAX_NAMED = 5  # places of a fault in one message
DECIMAL_COMMA = ". A decimal comma needs a semicolon or a tab between the cells"
MAX_TABLE_BYTES = 512 * MEGABYTE
EXPORTED = (
    FIRST_CELL,
    *KINDS,
    *OTHER_KINDS,
)  # the first cell of a table that a device's program wrote


@dataclass(frozen=True)
class Table:
    """The header of a table, its rows as text, and the line number of each row."""

    path: Path
    header: list[str]
    rows: list[list[str]]
    lines: list[int]
    decimal: str = "."
    exported: bool = False  # by a program whose tables have many columns besides those of interest
    assumed_unit: str = ""  # of lengths, if the program did not state it
    needed: tuple[str, ...] = ()  # columns that are read as well: an error names their cells, too

    def find(self, name: str) -> str | None:
        """Return the header's word for a column: its name, or name and unit (`x [mm]`, `x_mm`).

        DatasetError if several columns have the name.
        """
        splits = (split_unit, split_condition)
        same = [k for k, word in enumerate(self.header, start=1) if word == name] or [
            k
            for k, word in enumerate(self.header, start=1)
            if name in [split(word)[0] for split in splits]
        ]
        if len(same) > 1:
            raise DatasetError(
                f"{self.path}:1: column {name} occurs {len(same)} times (columns "
                f"{', '.join(map(str, same))}): rename all but one of them in the table"
            )
        return self.header[same[0] - 1] if same else None

    def select(self, rows: Sequence[int]) -> Table:
        """Return the table with some rows, in this order."""
        return replace(self, rows=[self.rows[k] for k in rows], lines=[self.lines[k] for k in rows])

    def drop_empty_rows(self) -> Table:
        """Return the table without empty rows; DatasetError for a missing cell."""
        kept = [k for k, row in enumerate(self.rows) if any(map(str.strip, row))]
        wrong = [k for k in kept if len(self.rows[k]) != len(self.header)]
        if wrong:
            first, *others = (f"{self.lines[k]}" for k in wrong)
            also = (
                f" ({len(wrong)} lines have this fault, also {_join_first(others)})"
                if others
                else ""
            )
            right = sorted({*kept} - {*wrong})
            hint = DECIMAL_COMMA * (
                self.decimal != "," and any(len(self.rows[k]) > len(self.header) for k in wrong)
            )
            raise DatasetError(
                f"{self.path}:{first}: {len(self.rows[wrong[0]])} cells, but the header "
                f"has {len(self.header)}{also}{self._name_odd_cells(right)}{hint}"
            )
        return self.select(kept)

    def _name_odd_cells(self, rows: Sequence[int]) -> str:
        """Name the cells of these rows that are no numbers, in columns of which most are; empty if
        there are none."""
        odd = list[tuple[int, str, str]]()
        for column, name in enumerate(self.header):
            texts = {k: self.rows[k][column].strip() for k in rows}
            bad = [k for k, text in texts.items() if text and not math.isfinite(self._number(text))]
            if 2 * len(bad) < len(rows):
                odd += [(self.lines[k], name, texts[k]) for k in bad]
        return f". Cells of other lines are no numbers: {_join_cells(sorted(odd))}" if odd else ""

    def texts(self, name: str) -> list[str]:
        """Return a column's cells; empty in rows whose length differs from the header's.

        DatasetError if several columns have the name.
        """
        self.find(name)
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

    def numbers(self, names: Sequence[str], gaps: bool = False) -> np.ndarray:
        """Return (N, len(names)); with `gaps`, an empty cell is NaN. DatasetError if a cell is no
        finite number."""
        columns = []
        for name in names:
            numbers, texts = self.column(name), self.texts(name)
            filled = np.isfinite(numbers)
            if any(texts[k] or not gaps for k in np.flatnonzero(~filled)):
                raise DatasetError(self.describe_bad_cells((*names, *self.needed), gaps))
            if (bad := find_unconverted(numbers[filled])) is not None:
                k = np.flatnonzero(filled)[bad]
                raise DatasetError(
                    f"{self.path}:{self.lines[k]}: column {name} contains {texts[k]!r:.60}: "
                    f"{UNCONVERTED}"
                )
            self._check_decimal_sign(name, texts)
            columns.append(numbers)
        return np.column_stack(columns)

    def describe_bad_cells(self, names: Sequence[str], gaps: bool = False) -> str:
        """Name the first cells of these columns that are no numbers; empty if there are none."""
        cells = sorted(
            (self.lines[k], name, text)
            for name in dict.fromkeys(names)
            for k, text in enumerate(self.texts(name))
            if (text or not gaps) and not math.isfinite(self._number(text))
        )
        if not cells:
            return ""
        (line, name, text), *others = cells
        commas = self.decimal != "," and any("," in t for _, _, t in [("", "", text), *others])
        hint = DECIMAL_COMMA * commas
        what = f"{self.path}:{line}: column {name} contains {text!r:.60}, expected a finite number"
        if not others:
            return f"{what}: enter one or remove the line{hint}"
        return (
            f"{what}. {len(others) + 1} cells have this fault, also {_join_cells(others)}: enter "
            f"numbers or remove the lines{hint}"
        )

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


def _join_cells(cells: Iterable[tuple[int, str, str]]) -> str:
    """Join cells, each a line, a column and a text, as `_join_first` does."""
    return _join_first([f"line {line} column {name} ({text!r:.60})" for line, name, text in cells])


def _join_first(places: Sequence[str]) -> str:
    """Join the first places, with the number of the others."""
    more = len(places) - MAX_NAMED
    return ", ".join([*places[:MAX_NAMED], *([f"{more} more"] if more > 0 else [])])


def read_table(path: Path) -> Table:
    """Read a table with a header line; skip titles, empty lines and remarks.

    The header of an export of OptiTrack's Motive (motive.py), or of Vicon's Tracker or Nexus
    (vicon.py), is merged into one line.

    DatasetError if the file is not such a table, or if it has no rows.
    """
    try:
        foreign = describe_foreign(path)
        text = "" if foreign else read_foreign_text(path, MAX_TABLE_BYTES)
    except OSError as error:
        raise DatasetError(f"{path}: the table cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise DatasetError(
            f"{path}: not a CSV table: it is not text (UTF-8, UTF-16 or Latin-1). Export it as CSV "
            "text"
        ) from None
    if foreign:
        raise DatasetError(f"{path}: {foreign}")
    lines = text.splitlines(keepends=True)
    try:
        table = _parse(path, lines)
    except csv.Error as error:
        raise DatasetError(f"{path}: not a CSV table: {error}") from None
    if not any(cell.strip() for row in table.rows for cell in row):
        raise DatasetError(
            f"{path}: no rows below the header '{','.join(table.header):.400}'; expected a header "
            "line and rows"
        )
    return table


def _parse(path: Path, lines: list[str]) -> Table:
    """Return the table in a text; csv.Error if its quotation marks do not match."""
    if exported := _parse_export(path, lines):
        return exported
    at, heading = find_heading(lines)
    body = [heading, *lines[at + 1 :]]
    separator = find_separator(body)
    found = [(at + line, row) for line, row in split_cells(body, separator)]
    if not found or not any(found[0][1]):
        raise DatasetError(f"{path}:1: the file is empty; expected a header line")
    (_, header), *rows = found
    names = [" ".join(name.split()) for name in header]  # Excel breaks lines within a cell
    width = max(k for k, name in enumerate(names, start=1) if name)
    decimal = "." if separator == "," else ","
    if separator == SPACE and rows and len(rows[0][1]) < width:
        names = join_brackets(names)
        width = len(names)
    if rows and (joined := join_units(names, rows[0][1])):
        names, rows = joined, rows[1:]
    kept = [
        (line, _fit_row(row, width, len(names)))
        for line, row in rows
        if len(row) == len(names) or not is_remark(row[0])
    ]
    return Table(path, names[:width], [row for _, row in kept], [n for n, _ in kept], decimal)


def _fit_row(row: list[str], width: int, columns: int) -> list[str]:
    """Return the cells of a row under the `width` columns up to the last named one.

    A row with filled cells beyond all `columns` of the header is unchanged. A row that is shorter
    than the header and ends with a separator lacks a cell.
    """
    if any(map(str.strip, row[columns:])):
        return row
    return row[:-1] if len(row) < columns and not row[-1].strip() else row[:width]


def _parse_export(path: Path, lines: list[str]) -> Table | None:
    """Return the table that a device's program wrote, with several lines of header."""
    remarks = next((k for k, line in enumerate(lines) if line.strip() and line[0] != "#"), None)
    if remarks is None or re.split(r"[,;\t]", lines[remarks])[0].strip('" \n') not in EXPORTED:
        return None
    remarks = find_first_table(lines, remarks)
    separator = find_separator(lines[remarks:])
    found = [(remarks + line, row) for line, row in split_cells(lines[remarks:], separator)]
    cells = [row for _, row in found]
    if is_vicon(cells):
        header, converted = convert_rows(cells)
        assumed = ""
        numbers = [line for line, _ in found[HEADER_LINES:]]
        rows = [*zip(numbers, converted, strict=False)]
    elif is_motive(cells):
        last, header, assumed = merge_header(cells)
        rows = [
            (line, [*row, *[""] * len(header)][: len(header)]) for line, row in found[last + 1 :]
        ]
    else:
        return None
    decimal = "." if separator == "," else ","
    texts, numbers = [row for _, row in rows], [line for line, _ in rows]
    return Table(path, header, texts, numbers, decimal, exported=True, assumed_unit=assumed)


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
    match = re.fullmatch(r"(.+?)\s*(?:\[([^\[\]]+)\]|\(([^()]+)\)|[_/ ]\s*([^_/ ]+))", word)
    if match is None:
        return word, ""
    return match[1], next(group for group in match.groups()[1:] if group).strip()
