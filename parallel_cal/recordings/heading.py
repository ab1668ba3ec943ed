"""Where the heading of a text table is, and what separates its cells.

Programs write titles and remarks before the heading, write the heading as a remark (NumPy's
`savetxt`), put the units in a line below it, end lines with a separator, and separate cells by
commas, semicolons, tabs or spaces.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from itertools import pairwise

from parallel_cal.base.units import CONDITION_UNIT_ALIASES, CONDITION_UNITS, UNIT_ALIASES, UNITS

REMARKS = ("#", "%", "//", "!")  # before a line that is no data
SEPARATORS = ",;\t"
SPACE = " "  # separates cells where nothing else does
STATED = re.compile(r"\s*sep=(.)\s*")  # Excel's first line
MAX_LINES = 50  # among which the heading is
BRACKETS = re.compile(r"[\[(].*[\])]")  # around a unit
KNOWN_UNITS = {*UNITS, *UNIT_ALIASES, *CONDITION_UNIT_ALIASES, "px", "-"}
KNOWN_UNITS |= {unit.lower() for units in CONDITION_UNITS.values() for unit in units}


def split_cells(lines: Sequence[str], separator: str) -> list[tuple[int, list[str]]]:
    """Return the rows of a text as cells, each with the number of its last line; csv.Error."""
    spaced = separator == SPACE
    if spaced:
        lines = [line.replace("\t", SPACE) for line in lines]
    reader = csv.reader(lines, delimiter=separator, strict=True, skipinitialspace=spaced)
    return [(reader.line_num, row) for row in reader if row]


def find_separator(lines: Sequence[str]) -> str:
    """Return what separates the cells of the first row: the sign that makes most cells, or spaces.

    A cell in quotation marks may go on in the next line.
    """
    counts = {
        sign: len(next(csv.reader(lines, delimiter=sign, skipinitialspace=sign == SPACE), []))
        for sign in (*SEPARATORS, SPACE)
    }
    most = max(SEPARATORS, key=lambda sign: counts[sign])
    return most if counts[most] > 1 or counts[SPACE] < 2 else SPACE


def find_heading(lines: Sequence[str]) -> tuple[int, str]:
    """Return the index of the heading among the lines of a table, and the heading as a line.

    It is the first line without a number that has as many cells as the numbers or units below it,
    and may be written as a remark. It is the first line that is no remark if that line has as many
    cells as this one, as in a table of names, or if there is no such line.
    """
    filled = [k for k, line in enumerate(lines) if line.strip() and not STATED.fullmatch(line)]
    first = next((k for k in filled if not is_remark(lines[k])), None)
    if first is None:
        return (filled[0], lines[filled[0]]) if filled else (0, "")
    if lines[first].count('"') % 2:  # a cell goes on in the next line
        return first, lines[first]
    start = max(filled.index(first) - 1, 0)  # the last remark may be the heading
    for k, below in pairwise(filled[start : start + MAX_LINES]):
        line = _strip_marker(lines[k]) if is_remark(lines[k]) else lines[k]
        if not is_remark(lines[below]) and _is_heading_of(line, lines[below]):
            separator = find_separator([line])
            widths = [
                len(_drop_last_blanks(_split(text, separator))) for text in (lines[first], line)
            ]
            belongs = k > first and widths[0] == widths[1]
            return (first, lines[first]) if belongs else (k, line)
    return first, lines[first]


def is_remark(line: str) -> bool:
    return line.lstrip().startswith(REMARKS)


def join_units(names: Sequence[str], below: Sequence[str]) -> list[str] | None:
    """Return a heading with the units that the row below it states; None if it states none."""
    if not _are_units(below) or len(below) > len(names):
        return None
    units = [_strip_brackets(cell) for cell in below]
    joined = [
        f"{name} [{unit}]" if name and unit and unit != "-" else name
        for name, unit in zip(names, units, strict=False)
    ]
    return [*joined, *names[len(units) :]]


def join_brackets(names: Sequence[str]) -> list[str]:
    """Return a heading whose units in brackets are parts of the names before them."""
    joined: list[str] = []
    for name in names:
        if joined and BRACKETS.fullmatch(name):
            joined[-1] += f" {name}"
        else:
            joined.append(name)
    return joined


def _is_heading_of(line: str, below: str) -> bool:
    """Return whether a line has names, and as many cells as the line below it."""
    separator = find_separator([line])
    names, cells = (_drop_last_blanks(_split(text, separator)) for text in (line, below))
    if separator == SPACE and len(names) != len(cells):
        names = join_brackets(names)
    same = len(names) == len(cells) > 1
    if not same or any(map(_is_number, names)):
        return False
    return any(map(_is_number, cells)) or (_are_units(cells) and not _are_units(names))


def _are_units(cells: Sequence[str]) -> bool:
    units = [unit for unit in map(_strip_brackets, cells) if unit]
    return bool(units) and all(unit.lower() in KNOWN_UNITS for unit in units)


def _strip_brackets(cell: str) -> str:
    return cell.strip().strip("[]()").strip()


def _split(line: str, separator: str) -> list[str]:
    try:
        return next((row for _, row in split_cells([line], separator)), [])
    except csv.Error:
        return [line]


def _strip_marker(line: str) -> str:
    """Return a remark without its marker; a lone `#` over the first column is its name."""
    plain = line.lstrip()
    marker = next(marker for marker in REMARKS if plain.startswith(marker))
    rest = plain.removeprefix(marker)
    return line if not rest or rest[0] in SEPARATORS else rest.lstrip(" ")


def _drop_last_blanks(cells: Sequence[str]) -> list[str]:
    filled = [k for k, cell in enumerate(cells, start=1) if cell.strip()]
    return list(cells[: filled[-1]]) if filled else []


def _is_number(text: str) -> bool:
    try:
        float(text.strip().replace(",", "."))
    except ValueError:
        return False
    return True
