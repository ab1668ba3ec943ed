"""What a model says about its age: until when its validation error can be trusted."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from parallel_cal.base.confidence import format_percent
from parallel_cal.base.units import ERROR_UNITS
from parallel_cal.identification.age import PROBABILITY, Age
from parallel_cal.identification.drift_rate import PARTS, DriftRate
from parallel_cal.reporting.blocks import Column, Number, Row, Table
from parallel_cal.reporting.readable import day, number
from parallel_cal.reporting.watching import iso
from parallel_cal.watch.watch import DAY

GROWTH_WORDS = ("each session", "random walk", "steady")
CURE = "record a second session and run parallel-cal drift with both"


def describe_age(age: Age, now: float | None = None) -> str:
    """Say in one line until when a calibration can be trusted; `now` (s since 1970) may be past."""
    if age.unknown:
        return f"{age.unknown}; {CURE}"
    return "; ".join(describe_trusts(age, now))


def describe_trusts(age: Age, now: float | None = None) -> Iterator[str]:
    """Say for each kind of error until when it can be trusted."""
    for one in age.trusts:
        unit, factor = ERROR_UNITS[one.kind]
        error = f"{one.kind} error within {number(one.limit, factor)} {unit}"
        chance = format_percent(PROBABILITY)
        if one.until == age.calibrated:
            yield f"{error}: not beyond the session of the calibration ({chance})"
            continue
        words = f"{error} until {day(iso(one.until))} ({chance})"
        if now is not None and now > one.until:
            words += ", which is past: measure again"
        elif not one.is_seen:
            words += ", as long as the sessions show; later is not known"
        yield words


def is_past(age: Age, now: float) -> bool:
    """Whether the end of an age that is known is before `now` (s since 1970)."""
    return age.until is not None and now > age.until


def describe_rate(rate: DriftRate) -> Table:
    """Tabulate how far and how each part of the parameters drifts."""
    low, middle, high = (rate.quantile(level) for level in (0.025, 0.5, 0.975))
    rows: list[Row] = []
    for k, part in enumerate(PARTS):
        shares = [format_percent(p) for p in rate.weights[k].sum(axis=1)]
        rows.append(
            (part, *(Number(one[part], 1.0, significant=2) for one in (middle, low, high)), *shares)
        )
    return Table(("drift of", Column("usual ones"), "from", "to", *GROWTH_WORDS), rows)


def describe_sessions(rate: DriftRate) -> str:
    """Say from what a rate was estimated."""
    days = f"{rate.span / DAY:.3g} days"
    if rate.robots > 1:
        return f"{rate.sessions} sessions of {rate.robots} robots, at most {days} apart"
    return f"{rate.sessions} sessions in {days}"


def document_age(age: Age) -> dict[str, Any]:
    """The JSON document of an age; SI, times as ISO 8601 in UTC, None where not known."""
    return {
        "unknown": age.unknown,
        "calibrated": None if age.calibrated is None else iso(age.calibrated),
        "trusted": [vars(one) | {"until": iso(one.until)} for one in age.trusts],
        "probability": PROBABILITY,
        "rate": None if age.rate is None else age.rate.document(),
    }
