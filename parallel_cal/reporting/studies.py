"""The results of studies as text and as pages."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from html import escape

import numpy as np

from parallel_cal.base.units import ERROR_SI_UNITS, ERROR_UNITS
from parallel_cal.reporting.blocks import Block, Cell, Column, Number, Row, Table, as_text
from parallel_cal.reporting.colours import ACCENT, MEASURED, QUIET, WARNING
from parallel_cal.reporting.figures import LEGEND, Spec
from parallel_cal.reporting.markup import Plot, as_html, paragraph, section, sentence
from parallel_cal.reporting.page import PageBuilder
from parallel_cal.reporting.readable import (
    error_unit,
    format_fixed,
    number,
    value_unit,
    with_unit,
)
from parallel_cal.study.power import HALF, MOSTLY, Detectable, Power
from parallel_cal.study.tolerance import Share, Tolerances

DIGITS = {"position": 1, "orientation": 2}
UNITS = {kind: (*ERROR_UNITS[kind], digits) for kind, digits in DIGITS.items()}
ERRORS = ("rms", "95 %", "largest", "rms of 95 % of robots", "rms of the budget")
PARAMETER_COLUMNS = ("parameters", "tolerance", "unit", "count")
SIZES = ("predicted 50 %", "90 %", "found 50 %", "90 %")
MIN_MISNAMED_SHARE = 0.2  # share of an effect's sessions from which a wrong name is reported
MIN_BUDGET_SHARE = 1e-3  # smaller shares of the budget are not shown


def format_tolerances(found: Tolerances, width: int | None = None) -> str:
    """Format the errors, the budget and the remarks for a terminal of a width."""
    robots, poses = found.errors[found.kind].shape
    tables = (_error_table(found), _budget_table(found))
    blocks: list[Block] = [f"{robots} robots, {poses} poses each", *tables, *remarks(found)]
    return as_text(blocks, width=width)


def _error_table(found: Tolerances) -> Table:
    rows: list[Row] = []
    for kind in found.errors:
        unit, factor, digits = UNITS[kind]
        figures = (*found.summary(kind).values(), found.linear[kind])
        rows.append((f"{kind} error [{unit}]", *(Number(v, factor, digits) for v in figures)))
    return Table(("", *ERRORS), rows)


def _budget_table(found: Tolerances) -> Table:
    """Describe the error of each group of parameters, and the total if its tolerance is halved."""
    header = [*PARAMETER_COLUMNS]
    for kind in found.errors:
        header += [f"{kind} [{UNITS[kind][0]}]", f"{kind} share [%]"]
    rows = []
    for one in found.budget:
        if all(_share(found, one, kind) <= MIN_BUDGET_SHARE for kind in UNITS):
            continue
        row: list[Cell | Number | str] = [one.name, *_tolerance(one), str(one.count)]
        for kind in found.errors:
            _, factor, digits = UNITS[kind]
            row += [Number(one.rms[kind], factor, digits), Number(_share(found, one, kind), 100, 1)]
        _, factor, digits = UNITS[found.kind]
        rows.append((*row, Number(one.halved[found.kind], factor, digits)))
    return Table((*header, "total if halved"), rows, "sortable")


def _format_error(value: float, kind: str) -> str:
    _, factor, digits = UNITS[kind]
    return format_fixed(value, factor, digits)


def _share(found: Tolerances, one: Share, kind: str) -> float:
    return one.compute_fraction(found.linear, kind) if kind in found.linear else 0.0


def _tolerance(one: Share) -> tuple[str, str]:
    """Format one number, or a range if the tolerances differ, and its unit."""
    unit, factor = value_unit(one.unit)
    low, high = (number(v, factor) for v in one.tolerance)
    return (low if low == high else f"{low}..{high}"), unit


def remarks(found: Tolerances) -> Iterator[str]:
    """Name the largest contribution, limits of the budget, and the error after calibration."""
    one, kind = found.budget[0], found.kind
    what = f"{one.label} ({one.name})" if one.label else one.name
    whole, halved = (_format_error(v, kind) for v in (found.linear[kind], one.halved[kind]))
    yield (
        f"{what}, {' '.join(_tolerance(one))}, contributes most: "
        f"{format_fixed(_share(found, one, kind), 100, 0)} % of the squared {kind} error; half "
        f"the tolerance would reduce the error from {whole} to {halved} {UNITS[kind][0]}"
    )
    for kind in found.errors:
        if found.differs(kind):
            ratio = found.summary(kind)["rms"] / found.linear[kind]
            yield (
                f"the {kind} errors of the random robots are {ratio:.2f} times those of the "
                "budget: the tolerances are so large that the errors are not proportional to them"
            )
    if found.unreached:
        yield f"{found.unreached} poses were out of reach of a random robot and are not counted"
    if found.calibrated:
        left = vars(found.calibrated)
        shown = [f"{_format_error(left[f'{k}_rms'], k)} {UNITS[k][0]}" for k in found.errors]
        yield (
            f"error after a calibration at the {found.planned} poses of the plan: "
            f"{', '.join(shown)}"
        )


def tolerances_page(found: Tolerances) -> str:
    """Make the page of a tolerance study: remarks, the budget as bars, the spread of the robots."""
    drawn, (robots, poses) = PageBuilder(), found.errors[found.kind].shape
    summary = "".join(paragraph(sentence(text), "verdict") for text in remarks(found))
    bars, figures = (
        "".join(draw(found, kind, drawn.plot) for kind in found.errors)
        for draw in (_bars, _distribution)
    )
    parts = [
        section("Largest contribution", summary),
        section("Error budget", bars + as_html([_budget_table(found)])),
        section(
            "Robots", as_html([_error_table(found)]) + figures, f"{robots}, {poses} poses each"
        ),
    ]
    return drawn.page_of(f"Tolerances of {found.model.mechanism.name}", parts)


def _bars(found: Tolerances, kind: str, plot: Plot) -> str:
    """Draw the first-order error of each group of parameters, the largest on top."""
    unit, factor = error_unit(ERROR_SI_UNITS[kind])
    upwards = sorted(found.budget, key=lambda one: one.rms[kind])
    upwards = [one for one in upwards if _share(found, one, kind) > MIN_BUDGET_SHARE]
    bars: Spec = {
        "type": "bar",
        "orientation": "h",
        "y": [escape(one.name) for one in upwards],
        "x": [one.rms[kind] * factor for one in upwards],
        "marker": {"color": ACCENT},
        "text": [f"{number(_share(found, one, kind), 100, 2)} %" for one in upwards],
        "textposition": "auto",
        "hovertext": [
            escape(
                f"{one.label or one.name}, {' '.join(_tolerance(one))}: "
                f"{with_unit(one.rms[kind], ERROR_SI_UNITS[kind])}; total if halved: "
                f"{with_unit(one.halved[kind], ERROR_SI_UNITS[kind])}"
            )
            for one in upwards
        ],
        "hoverinfo": "text",
    }
    across = f"{kind} error that it causes, rms [{unit}]; % of the total squared error"
    layout = {
        "height": 90 + 24 * len(upwards),
        "bargap": 0.3,
        "yaxis": {"dtick": 1},
        "xaxis": {"title": {"text": across}},
    }
    return plot({"data": [bars], "layout": layout})


def _distribution(found: Tolerances, kind: str, plot: Plot) -> str:
    """Draw the distribution of the robots' rms errors, with that of the budget."""
    unit, factor = error_unit(ERROR_SI_UNITS[kind])
    count, edges = np.histogram(found.robots(kind) * factor, bins="auto")
    keep, budget = found.summary(kind)["robots_p95"], found.linear[kind]
    traces: list[Spec] = [
        {
            "type": "bar",
            "x": ((edges[1:] + edges[:-1]) / 2).tolist(),
            "y": count.tolist(),
            "width": float(edges[1] - edges[0]),
            "marker": {"color": MEASURED},
            "name": "robots",
            "hovertemplate": f"%{{x:.3g}} {unit}: %{{y}}<extra></extra>",
        }
    ]
    for name, at, colour in (("budget", budget, WARNING), ("95 % of robots", keep, QUIET)):
        traces.append(
            {
                "type": "scatter",
                "mode": "lines",
                "name": name,
                "hoverinfo": "name",
                "x": [at * factor] * 2,
                "y": [0, int(count.max())],
                "line": {"color": colour, "width": 2},
            }
        )
    layout = {
        "height": 280,
        "showlegend": True,
        "legend": LEGEND,
        "margin": {"t": 40},
        "xaxis": {"title": {"text": f"{kind} error of a robot, rms [{unit}]"}},
        "yaxis": {"title": {"text": "number of robots"}},
    }
    return plot({"data": traces, "layout": layout})


def format_power(found: Power, width: int | None = None) -> str:
    """Format the detectable sizes, the effects that cannot be found, and the false alarms, for a
    terminal of a width."""
    sizes = _size_table(found)
    return as_text(
        [
            f"{len(found.question.planned)} poses, {found.sessions} sessions",
            *([sizes] if sizes.rows else []),
            *power_remarks(found),
        ],
        width=width,
    )


def _size_table(found: Power) -> Table:
    """Describe the sizes of each effect; a page adds how many sessions found each size tried."""
    pose_error = f"{found.kind} error [{UNITS[found.kind][0]}] 50 %"
    columns = ("effect", "parameter", "unit", *SIZES, pose_error, "90 %")
    rows = [
        (
            one.effect,
            one.number,
            error_unit(one.unit)[0].replace("µ", "u"),
            *_sizes(found, one),
            ", ".join(f"{size.found}/{size.sessions}" for size in one.tried),
        )
        for one in found.effects
        if not one.reason
    ]
    return Table((*columns, Column("found", on_terminal=False)), rows)


def _sizes(found: Power, one: Detectable) -> list[str]:
    """Format predicted and found sizes of a parameter, and their pose errors.

    `>` marks the largest size tried, if it was not found.
    """
    factor = error_unit(one.unit)[1] * one.tolerance
    tried = [one.smallest(share) for share in (HALF, MOSTLY)]
    beyond = [">" if size is None else "" for size in tried]
    sizes = [size or one.tried[-1] for size in tried]
    return [
        *(number(size, factor) for size in one.predicted),
        *(sign + number(size.size, factor) for sign, size in zip(beyond, sizes, strict=True)),
        *(s + _format_error(size.error, found.kind) for s, size in zip(beyond, sizes, strict=True)),
    ]


def power_remarks(found: Power) -> Iterator[str]:
    """Compare with the prediction; name undetectable effects, false alarms and failed sessions."""
    ratios = [
        size.size / one.predicted[1] for one in found.effects if (size := one.smallest(MOSTLY))
    ]
    if ratios:
        yield (
            f"effects found in 90 % of sessions are {np.median(ratios):.2f} times as large as "
            f"predicted (median of {len(ratios)} effect{'' if len(ratios) == 1 else 's'})"
        )
    for one in found.effects:
        if one.reason and one.applies:
            yield f"{one.effect}: {one.reason}"
        called = sum((Counter(size.called) for size in one.tried), Counter[str]())
        for name, n in called.items():
            if n >= MIN_MISNAMED_SHARE * (of := sum(size.sessions for size in one.tried)):
                yield f"{one.effect} is mistaken for {name} in {n} of {of} sessions"
    alarms = ", ".join(f"{name} in {n}" for name, n in found.false_alarms.items()) or "none"
    yield f"false alarms in {found.clean} sessions without any effect: {alarms}"
    if found.failed:
        yield f"{len(found.failed)} sessions failed; the first one: {found.failed[0]['reason']}"


def power_page(found: Power) -> str:
    """Make the page of a power study: ranges of sizes with their predictions, and all numbers."""
    drawn = PageBuilder()
    shown = [one for one in found.effects if not one.reason]
    remarks_ = "".join(paragraph(sentence(text)) for text in power_remarks(found))
    parts = [
        section("Detectable effects", _ranges(found, shown, drawn.plot) if shown else ""),
        section("Sizes", as_html([_size_table(found)])),
        section("Remarks", remarks_),
    ]
    mechanism, poses = found.document()["mechanism"], len(found.question.planned)
    return drawn.page_of(f"Effects that {poses} poses of {mechanism} detect", parts)


def _ranges(found: Power, shown: list[Detectable], plot: Plot) -> str:
    """Draw the pose errors at which the effect is found in 50 % and in 90 % of the sessions."""
    unit, factor = error_unit(ERROR_SI_UNITS[found.kind])
    upwards = shown[::-1]
    names = [escape(one.effect) for one in upwards]
    half, mostly = (
        [size.error * factor if (size := one.smallest(share)) else None for one in upwards]
        for share in (HALF, MOSTLY)
    )
    predicted = [one.predicted[1] * one.error_by_size * factor for one in upwards]
    traces: list[Spec] = [
        {
            "type": "scatter",
            "mode": "lines",
            "x": [low, high],
            "y": [name, name],
            "line": {"color": ACCENT, "width": 6},
            "showlegend": False,
            "hoverinfo": "skip",
        }
        for name, low, high in zip(names, half, mostly, strict=True)
        if high
    ]
    for name, colour, symbol, values in (
        ("found in 50 %", QUIET, "circle", half),
        ("found in 90 %", ACCENT, "circle", mostly),
        ("predicted, 90 %", WARNING, "diamond-open", predicted),
    ):
        traces.append(
            {
                "type": "scatter",
                "mode": "markers",
                "name": name,
                "x": values,
                "y": names,
                "marker": {"color": colour, "symbol": symbol, "size": 10},
                "hovertemplate": f"%{{y}}: %{{x:.3g}} {unit}",
            }
        )
    layout = {
        "height": 120 + 24 * len(upwards),
        "showlegend": True,
        "legend": LEGEND,
        "margin": {"t": 40},
        "yaxis": {"dtick": 1, "categoryorder": "array", "categoryarray": names},
        "xaxis": {"type": "log", "title": {"text": f"{found.kind} error, rms [{unit}]"}},
    }
    note = "The pose error that an effect alone causes at the size at which sessions find it."
    return paragraph(note, "note") + plot({"data": traces, "layout": layout})
