"""Everything that is printed: documents on stdout, tables for people, notes on stderr."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from parallel_cal.base.documents import plain

# what a person reads -> factor from SI; the unit is always printed beside the number
READABLE = {"m": ("mm", 1e3), "rad": ("deg", 180 / math.pi), "1": ("", 1.0)}
ERROR_UNITS = {
    "position": ("um", 1e6),
    "orientation": ("arcmin", 60 * 180 / math.pi),
    "reading": ("um", 1e6),
}


def emit(document: Any) -> None:
    """One JSON document on stdout."""
    sys.stdout.write(json.dumps(plain(document), allow_nan=False) + "\n")


def say(text: str) -> None:
    """A line of the answer for people, on stdout."""
    sys.stdout.write(text + "\n")


def note(text: str) -> None:
    """A line beside the answer: progress, warnings; on stderr."""
    sys.stderr.write(text + "\n")


def warn(warnings: Iterable[str]) -> None:
    for text in warnings:
        note(f"warning: {text}")


def error(text: str) -> None:
    """One line, whatever the text."""
    note("error: " + " ".join(text.split()))


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """A short table without frames; numbers to the right."""
    lines = [list(header), *([str(cell) for cell in row] for row in rows)]
    widths = [max(len(line[k]) for line in lines) for k in range(len(header))]
    right = [all(_numeric(line[k]) for line in lines[1:]) for k in range(len(header))]
    for line in lines:
        cells = [
            cell.rjust(width) if numbers else cell.ljust(width)
            for cell, width, numbers in zip(line, widths, right, strict=True)
        ]
        say("  ".join(cells).rstrip())


def _numeric(text: str) -> bool:
    return text.strip("+-0123456789.e ") == ""


def readable(value: float | None, unit: str, digits: int = 4) -> tuple[str, str]:
    """(number, unit) as people read them: m as mm, rad as degrees."""
    name, factor = READABLE.get(unit, (unit, 1.0))
    return number(value, factor, digits), name


def number(value: float | None, factor: float = 1.0, digits: int = 2) -> str:
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value * factor:.{digits}f}"


def vector(values: Iterable[float], factor: float, digits: int) -> str:
    return " ".join(number(float(v), factor, digits) for v in values)


def progress(stage: str, fraction: float) -> None:
    """A line on stderr that overwrites itself, where somebody looks at it."""
    if sys.stderr.isatty():
        text = f"{stage} {100 * fraction:.0f} %" if fraction < 1 else ""
        sys.stderr.write(f"\r\x1b[2K{text}")
        sys.stderr.flush()


def errors_table(
    columns: Mapping[str, Mapping[str, Any]], joint_units: Sequence[str], closure: bool = False
) -> None:
    """Mean and rms errors of what was measured, one column for each of before, after, ... (as
    table 5.15); with `closure` that of the closure's rows, too (where they are redundant)."""
    names = set(joint_units)
    joint = ("um", 1e6) if names == {"m"} else ("arcmin", 60 * 180 / math.pi)
    if len(names) > 1:  # turns and slides in one norm have no people's unit
        joint = ("urad|um", 1e6)
    units = {**ERROR_UNITS, "joint": joint}
    rows = []
    for kind, (unit, factor) in units.items():
        if all(c.get(f"{kind}_mean") is None for c in columns.values()):
            continue
        for measure in ("mean", "rms"):
            cells = [number(c.get(f"{kind}_{measure}"), factor, 2) for c in columns.values()]
            rows.append([f"{kind} error, {measure}", *cells, unit])
    if closure:
        cells = [number(c.get("closure_rms"), 1e6, 2) for c in columns.values()]
        rows.append(["closure, rms of its rows", *cells, "um"])
    table(["", *columns, "unit"], rows)
