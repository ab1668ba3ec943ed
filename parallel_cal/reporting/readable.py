"""Numbers with units for people: um, mm, arcmin, degrees.

A page has a few significant digits, a dash and µ; a terminal fixed digits, a hyphen and ASCII.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeGuard

from parallel_cal.base.units import ERROR_SI_UNITS, LARGE_UNITS, SMALL_UNITS

SMALL = SMALL_UNITS | {
    "m": ("µm", SMALL_UNITS["m"][1]),
    "rad|m": ("µrad|µm", 1e6),  # a norm of revolute and prismatic joints has no common unit
}
LARGE = LARGE_UNITS | {"degC": ("°C", 1.0), "1": ("", 1.0)}
MISSING = "–"
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
    """Format the first known kind of error in a summary with its sigma: `32.2 ± 1.4 µm`."""
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


def columns(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Format a short table without frames, with numbers aligned to the right."""
    lines = [list(header), *([str(cell) for cell in row] for row in rows)]
    widths = [max(len(line[k]) for line in lines) for k in range(len(header))]
    right = [
        all(not line[k].strip("<+-0123456789.e ") for line in lines[1:]) for k in range(len(header))
    ]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if numbers else cell.ljust(width)
            for cell, width, numbers in zip(line, widths, right, strict=True)
        ).rstrip()
        for line in lines
    )
