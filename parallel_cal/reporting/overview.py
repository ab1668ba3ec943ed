"""The first parts of the report: the verdict, the main numbers, the error budget, the history."""

from __future__ import annotations

from html import escape

from parallel_cal.identification.given_model import was_fitted
from parallel_cal.reporting import figures
from parallel_cal.reporting.blocks import Block
from parallel_cal.reporting.error_steps import DOTTED, draw_steps
from parallel_cal.reporting.markup import (
    Plot,
    as_html,
    chip,
    items,
    paragraph,
    sentence,
    tiles,
)
from parallel_cal.reporting.readable import unit_of
from parallel_cal.reporting.report import Report
from parallel_cal.reporting.results import describe_verdict
from parallel_cal.reporting.tables import (
    budget_sentence,
    budget_table,
    describe_counts,
    error_tiles,
    iso_sentence,
)

KEPT_SENSORS = (
    " Nominal model: the robot as drawn, with its sensors (such as the height and tilt of a bed) "
    "where the fit found them. The error before calibration, in the history and in fit and "
    "compare, has them where the model file states them."
)
REFITTED = (
    " The model was identified from other samples. The numbers, the verdict and the parameters are "
    "those of fits to these samples, which start from it; the error of the unchanged model at them "
    "is that of the certificate."
)


def verdict(report: Report) -> str:
    """Render the verdict as a badge and its sentences."""
    diagnosis = report.diagnosis
    found, caution = describe_verdict(diagnosis), ""
    words = f'<p class="verdict">{chip(found)} {escape(sentence(found.summary))}</p>'
    words += items(map(sentence, found.remarks))
    if aside := [one.title for one in diagnosis.knocked]:
        names = ", ".join(aside)
        caution = paragraph(
            f"All numbers are those of a fit without {names}. If the model was fitted with it, "
            "exclude it and fit again before you use the model.",
            "caution",
        )
    advice = (f"measure next: {words}" for words in diagnosis.measure_next.advice)
    steps = items(map(sentence, [*diagnosis.next_steps, *advice]))
    following = f'<div class="next"><h3>Next steps</h3>{steps}</div>' if steps else ""
    return f'<section id="verdict">{words}{caution}{following}</section>'


def numbers(report: Report) -> str:
    """Render the errors before, now and with the effects found, and the noise floor, as tiles."""
    shown = error_tiles(report.errors, report.diagnosis.effects, report.provenance.joint_units)
    errors, certified = report.errors, report.certified
    counts = describe_counts(errors.samples, errors.poses, True)
    refitted = was_fitted(report.diagnosis.model) and not certified.identified_here
    note = paragraph(
        f"Validation error: rms of the error's norm at {counts}, with its standard deviation. "
        "Noise floor: what a perfect model would show at these samples, as their noise is stated."
        f"{KEPT_SENSORS if errors.keeps_sensors else ''}{REFITTED if refitted else ''}",
        "note",
    )
    return f'<section id="numbers">{tiles(shown)}{note}</section>'


def budget(report: Report) -> str:
    """Render the error budget of the nominal model, and the figures after ISO 9283."""
    if not report.budget:
        return paragraph("There is no error budget: no pose was measured.", "none")
    note = paragraph(sentence(budget_sentence(report.budget[0])), "note")
    blocks: list[Block] = [
        *map(budget_table, report.budget),
        *map(sentence, map(iso_sentence, report.iso_9283)),
    ]
    return note + as_html(blocks)


def history(report: Report, plot: Plot) -> str:
    """Render the validation error step by step, a chart for each kind."""
    rows, errors, units = report.history, report.errors, report.provenance.joint_units
    falls = [
        figures.find_steps(rows, errors.noise, kind, unit_of(kind, units)) for kind in errors.kinds
    ]
    if not falls:
        return paragraph("There is no error to show: no suitable quantity was measured.", "none")
    note = "Validation error of each step. On average it cannot fall below the noise floor."
    if not all(step.is_comparable for fall in falls for step in fall.steps):
        note += f" {DOTTED}"
    drawn = "".join(f"<div>{plot(draw_steps(fall))}</div>" for fall in falls)
    how = paragraph("Point at a step to see its data.", "note on-screen")
    return paragraph(note, "note") + how + f'<div class="pair">{drawn}</div>'
