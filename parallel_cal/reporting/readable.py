"""Numbers with units for people: um, mm, arcmin, degrees.

A page has a few significant digits, a dash and µ; a terminal fixed digits, a hyphen and ASCII.
"""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeGuard

from parallel_cal.base.units import ERROR_SI_UNITS, LARGE_UNITS, SMALL_UNITS

SMALL = SMALL_UNITS | {
    "m": ("µm", SMALL_UNITS["m"][1]),
    "rad|m": ("µrad|µm", 1e6),  # a norm of revolute and prismatic joints has no common unit
}
LARGE = LARGE_UNITS | {"degC": ("°C", 1.0), "1": ("", 1.0)}
MISSING = "–"
WIDTH = 80  # columns of a terminal that every table should fit
# Marks of cells, by which a terminal colours them and pages style them.
HEADING, COMMAND, FOUND, ODD, LABEL = "heading", "command", "found", "odd", "label"
Paint = Callable[[str, str], str]  # colours a text by its mark


def plain(text: str, mark: str) -> str:
    """Return the text without a colour."""
    return text


ABOUT_SAMPLES = (
    "Samples are counted from 0, in the order of the recording. The sigmas of a sample are the rms "
    "of its residuals, in standard deviations of the noise. After a fit, these residuals are "
    "in-sample, and the errors are validation errors."
)


def error_unit(unit: str) -> tuple[str, float]:
    """Return (name, factor) of the unit in which errors of this SI unit are shown."""
    return SMALL.get(unit, (unit, 1.0))


def value_unit(unit: str) -> tuple[str, float]:
    """Return (name, factor) of the unit in which values of this SI unit are shown."""
    return LARGE.get(unit, (unit, 1.0))


def is_known(value: float | None) -> TypeGuard[float]:
    """Return whether a value is a finite number."""
    return value is not None and math.isfinite(value)


def number(value: float | None, factor: float = 1.0, digits: int = 3) -> str:
    """Format a few significant digits; a dash if the value is not known."""
    if not is_known(value):
        return MISSING
    scaled = value * factor
    if scaled == 0:
        return "0"
    size = math.floor(math.log10(abs(scaled)))
    if size < -4 or size > 6:
        return f"{scaled:.{digits - 1}e}"
    return f"{scaled:.{max(digits - 1 - size, 0)}f}"


def round_to_sigma(value: float, sigma: float | None, factor: float = 1.0) -> tuple[str, str]:
    """Format (value, sigma) with the decimals of the sigma's second digit."""
    if not is_known(sigma) or sigma <= 0:
        return number(value, factor, 6), MISSING
    decimals = max(1 - math.floor(math.log10(sigma * factor)), 0)
    rounded = round(value * factor, decimals) + 0.0  # never -0
    return f"{rounded:.{decimals}f}", f"{sigma * factor:.{decimals}f}"


def with_sigma(value: float | None, sigma: float | None, factor: float = 1.0) -> str:
    """Format `32.2 ± 1.5`, with the decimals of the sigma's second digit; without a known sigma
    only the value."""
    shown, uncertainty = round_to_sigma(value, sigma, factor) if is_known(value) else (MISSING, "")
    if not is_known(value) or uncertainty == MISSING:
        return number(value, factor)
    return f"{shown} ± {uncertainty}"


def format_judged_error(errors: Mapping[str, float | None], sigmas: Mapping[str, float]) -> str:
    """Format the first known kind of error in a summary with its sigma: `32.2 ± 1.8 µm`."""
    return next(format_judged_errors(errors, sigmas), MISSING)


def format_judged_errors(
    errors: Mapping[str, float | None], sigmas: Mapping[str, float]
) -> Iterator[str]:
    """Format each known kind of error in a summary with its sigma."""
    for kind, unit in ERROR_SI_UNITS.items():
        if is_known(value := errors.get(f"{kind}_rms")):
            name, factor = error_unit(unit)
            yield f"{with_sigma(value, sigmas.get(kind), factor)} {name}"


def write_micro(text: str) -> str:
    """Write um as µm, urad as µrad and +- as ±: messages and texts of blocks are ASCII, a page is
    not."""
    return re.sub(r"((?<=\d )|(?<=\[)|^)u(m|rad)\b", r"µ\2", text.replace(" +- ", " ± "))


def day(stamp: str) -> str:
    """Format an ISO time stamp as `2026-01-31 12:05 UTC`."""
    return f"{stamp[:10]} {stamp[11:16]} UTC"


def with_unit(value: float | None, unit: str, scale: Any = error_unit) -> str:
    """Format `32.2 µm`; a dash if the value is not known."""
    name, factor = scale(unit)
    text = number(value, factor)
    return text if text == MISSING else f"{text} {name}".rstrip()


def vector(values: Iterable[float | None], unit: str, digits: int = 2) -> str:
    """Format several values of one unit with fixed digits, so that columns line up."""
    factor = value_unit(unit)[1]
    rounded = (round(v * factor, digits) + 0.0 if is_known(v) else None for v in values)
    shown = [MISSING if v is None else f"{v:.{digits}f}" for v in rounded]  # never -0.00
    return " ".join(shown) if set(shown) != {MISSING} else MISSING


def probability(p: float | None) -> str:
    """Format a p-value in two digits, or as `< 1e-99`."""
    if not is_known(p):
        return MISSING
    return f"{p:.2g}" if p > 1e-99 else "< 1e-99"


def name_p_value(shown: str) -> str:
    """Write a formatted p-value as `p = 0.02` or `p < 1e-99`."""
    return f"p {shown}" if shown.startswith("<") else f"p = {shown}"


def percent(share: float | None, digits: int = 0, missing: str = MISSING) -> str:
    return f"{round(100 * share, digits) + 0.0:.{digits}f} %" if is_known(share) else missing


def unit_of(kind: str, joint_units: Mapping[str, str]) -> str:
    """Return the SI unit of an error kind; rad|m for a mix of revolute and prismatic joints."""
    units = set(joint_units.values())
    return ERROR_SI_UNITS.get(kind) or (units.pop() if len(units) == 1 else "rad|m")


def format_fixed(value: float | None, factor: float = 1.0, digits: int = 2) -> str:
    """Format a number for a terminal."""
    return f"{value * factor:.{digits}f}" if is_known(value) else "-"


def format_fixed_vector(values: Iterable[float | None], factor: float, digits: int) -> str:
    return " ".join(format_fixed(value, factor, digits) for value in values)


def in_unit(value: float | None, unit: str, digits: int = 4) -> tuple[str, str]:
    """Format (number, unit) of a value for a terminal: m as mm, rad as degrees."""
    name, factor = value_unit(unit)
    return format_fixed(value, factor, digits), name


def short_probability(p: float | None) -> str:
    """Format a p-value for a terminal: two digits, or `< 0.001`."""
    if not is_known(p):
        return "-"
    return f"{p:.2g}" if p >= 1e-3 else "< 0.001"


def columns(
    header: Sequence[str],
    rows: Iterable[Sequence[str]],
    width: int | None = None,
    paint: Paint = plain,
    marks: Sequence[Sequence[str]] = (),
) -> str:
    """Format a short table without frames, with numbers aligned to the right.

    Where the table is wider than `width` (80 if none is given), headings are broken between words.
    Texts in cells are broken only if a width is given: a pipe gets one line for each row. `marks`
    has a mark for each cell, with which `paint` colours it.
    """
    body = [[str(cell) for cell in row] for row in rows]
    lines = [list(header), *body]
    heads, blank = [HEADING] * len(header), [[""] * len(header)] * len(body)
    right = [
        all(not row[k].strip("<>+-0123456789.e %") for row in body) for k in range(len(header))
    ]
    longest = [max((len(row[k]) for row in body), default=0) for k in range(len(header))]
    widths = [max(len(name), size) for name, size in zip(header, longest, strict=True)]
    floors = [max(_longest_word(name), size) for name, size in zip(header, longest, strict=True)]
    widths = _narrow(widths, floors, width or WIDTH)
    for k, name in enumerate(header):
        while widths[k] > floors[k] and 1 < len(wrap(name, widths[k])) == len(
            wrap(name, widths[k] - 1)
        ):
            widths[k] -= 1  # the lines of a broken heading are about equally long
    if width is not None:
        words = [max(_longest_word(line[k]) for line in lines) for k in range(len(header))]
        texts = [
            size if numbers else word
            for size, word, numbers in zip(widths, words, right, strict=True)
        ]
        widths = _narrow(widths, texts, width)
        # At last, vectors between their numbers.
        cells = [{line[k] for line in lines} for k in range(len(header))]
        widths = _break_evenly(cells, widths, words, width)
    shown = []
    for line, of_line in zip(lines, [heads, *(marks or blank)], strict=True):
        if not any(line):  # a table without headings
            continue
        parts = [_break_cell(*cell) for cell in zip(line, widths, of_line, strict=True)]
        height = max(map(len, parts))
        for part in parts:  # a heading stands directly above its column
            more = [""] * (height - len(part))
            part[:] = more + part if line is lines[0] else part + more
        for pieces in zip(*parts, strict=True):
            last = max(k for k, text in enumerate(pieces) if text)
            shown.append(
                "  ".join(
                    paint(
                        text.rjust(size) if numbers else text.ljust(size if k < last else 0), mark
                    )
                    for k, (text, size, numbers, mark) in enumerate(
                        zip(pieces[: last + 1], widths, right, of_line, strict=False)
                    )
                )
            )
    return "\n".join(shown)


def _break_cell(cell: str, width: int, mark: str) -> list[str]:
    """Break a cell between words; a command ends its lines so that a shell reads them as one."""
    if len(cell) <= width:
        return [cell]
    if mark == COMMAND:
        *lines, last = wrap(cell, width - len(" \\"))
        return [*(f"{line} \\" for line in lines), last]
    return wrap(cell, width)


def _longest_word(text: str) -> int:
    return max(map(len, text.split()), default=0)


def _narrow(widths: Sequence[int], floors: Sequence[int], width: int) -> list[int]:
    """Narrow the widest columns that are above their floor until the table fits."""
    found = list(widths)
    for _ in range(sum(found) + 2 * (len(found) - 1) - width):
        loose = [k for k, floor in enumerate(floors) if found[k] > floor]
        if not loose:
            break
        found[max(loose, key=lambda k: found[k])] -= 1
    return found


def _break_evenly(
    cells: Sequence[Collection[str]], widths: Sequence[int], floors: Sequence[int], width: int
) -> list[int]:
    """Narrow columns (sets of cells) until the table fits: each time the one that then has the
    fewest lines, so that no cell becomes much higher than its neighbours."""
    found = list(widths)

    def count_lines(k: int, size: int) -> int:
        return max(len(wrap(cell, size)) for cell in cells[k])

    while (excess := sum(found) + 2 * (len(found) - 1) - width) > 0:
        loose = [k for k, floor in enumerate(floors) if found[k] > floor]
        if not loose:
            break
        k = min(loose, key=lambda k: (count_lines(k, found[k]), -found[k]))
        most = count_lines(k, found[k]) + 1
        sizes = range(floors[k], found[k])
        enough = [size for size in sizes if count_lines(k, size) <= most and size <= found[k] - 1]
        found[k] = max(min(enough, default=floors[k]), found[k] - excess)
    return found


def wrap(text: str, width: int, indent: str = "") -> list[str]:
    """Break a text between words; lines after the first begin with `indent`."""
    return textwrap.wrap(
        text, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )
