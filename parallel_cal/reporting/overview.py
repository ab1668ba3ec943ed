"""The first parts of the report: the verdict, the main numbers, the error budget, the history."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

from parallel_cal.identification.budget import Budget, Iso9283
from parallel_cal.identification.prediction_errors import Summary
from parallel_cal.reporting import figures
from parallel_cal.reporting.markup import Plot, micro, paragraph, table
from parallel_cal.reporting.readable import error_unit, number, unit_of, with_unit
from parallel_cal.reporting.report import Report

LABELS = {
    "at_noise": "at the noise floor",
    "explained": "explained",
    "partly_explained": "partly explained",
    "unexplained": "unexplained",
    "cannot_know": "cannot know",
}


def verdict(report: Report) -> str:
    """Render the verdict as a badge and a sentence."""
    found = report.diagnosis.verdict
    badge = f'<span class="badge {escape(found.word)}">{escape(LABELS[found.word])}</span>'
    words = f'<p class="verdict">{badge} {escape(micro(found.summary))}</p>'
    return f'<section id="verdict">{words}</section>'


def numbers(report: Report) -> str:
    """Render the errors before, now and with the effects found, and the noise floor, as tiles."""
    errors, units = report.errors, report.provenance.joint_units
    tiles = [
        _tile("before calibration", errors.before, errors.kinds, units),
        _tile("now", errors.now, errors.kinds, units),
    ]
    if errors.found:
        effects = " and ".join(report.diagnosis.effects)
        tiles.append(_tile(f"with {effects}", errors.found, errors.kinds, units, "found"))
    if errors.noise.is_known:
        tiles.append(_tile("noise floor", errors.noise, errors.kinds, units))
    note = paragraph("Validation error: rms of the error's norm at held-out poses.", "note")
    return f'<section id="numbers"><div class="tiles">{"".join(tiles)}</div>{note}</section>'


def _tile(
    name: str, e: Summary, kinds: Sequence[str], units: Mapping[str, str], mark: str = ""
) -> str:
    values = "".join(_value(e, kind, unit_of(kind, units)) for kind in kinds)
    return f'<dl class="{mark}"><dt>{escape(name)}</dt>{values}</dl>'


def _value(e: Summary, kind: str, si: str) -> str:
    unit, factor = error_unit(si)
    value = number(e.rms(kind), factor)
    return f"<dd>{value}<span>{escape(unit)}</span><em>{escape(kind)}</em></dd>"


def budget(report: Report) -> str:
    """Render the error budget of the nominal model, and the figures of ISO 9283."""
    if not report.budget:
        return paragraph("There is no error budget: no pose was measured.", "none")
    note = (
        "The shares add up to the rms error of the nominal model. The share of a part is its "
        "component along the total error. Alone: the rms of the part by itself, which other parts "
        "may compensate."
    )
    tables = [_shares(b) for b in report.budget]
    figures = [_iso(i) for i in report.iso_9283]
    header = ("ISO 9283", "accuracy, mean", "accuracy, worst", "repeatability", "poses, visits")
    return paragraph(note, "note") + "".join(tables) + table(header, figures)


def _shares(b: Budget) -> str:
    si = unit_of(b.kind, {})
    rows = [(p.name, with_unit(p.contribution, si), with_unit(p.alone, si)) for p in b.parts]
    return table((f"{b.kind}, {with_unit(b.total, si)}", "share", "alone"), rows)


def _iso(i: Iso9283) -> tuple[str, ...]:
    values = (i.accuracy_mean, i.accuracy_max, i.repeatability)
    shown = (with_unit(value, unit_of(i.kind, {})) for value in values)
    return (i.kind, *shown, f"{i.poses}, {i.visits}")


def history(report: Report, plot: Plot) -> str:
    """Render the validation error step by step, a chart for each kind."""
    rows, errors, units = report.history, report.errors, report.provenance.joint_units
    charts = [
        figures.history(rows, errors.noise, kind, unit_of(kind, units)) for kind in errors.kinds
    ]
    if not charts:
        return paragraph("There is no error to show: no suitable quantity was measured.", "none")
    note = "Validation error of each step. On average it cannot fall below the noise floor."
    if len({row["sha256"] for row in rows}) > 1:
        note += " The steps were judged on different data. Point at a step to see its data."
    drawn = "".join(f"<div>{plot(chart)}</div>" for chart in charts)
    return paragraph(note, "note") + f'<div class="pair">{drawn}</div>'
