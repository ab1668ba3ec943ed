"""The parts of the report on residuals: in space, against quantities, by sample, smooth map."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from parallel_cal.base.sample_names import format_sample
from parallel_cal.diagnosis.lack_of_fit import SmoothMap
from parallel_cal.diagnosis.patterns import Region
from parallel_cal.diagnosis.signature import signature
from parallel_cal.reporting import contents, image_figures, images, joint_panels, maps, spaces
from parallel_cal.reporting.markup import Plot, as_html, figure, folded, paragraph, table, tabs
from parallel_cal.reporting.multiples import colour, multiples
from parallel_cal.reporting.readable import (
    ABOUT_SAMPLES,
    name_p_value,
    percent,
    probability,
    vector,
    with_unit,
)
from parallel_cal.reporting.report import Report
from parallel_cal.reporting.results import PATTERN_SIGNIFICANCE_LEVEL
from parallel_cal.reporting.tables import sample_table

MAX_SAMPLE_ROWS = 400  # rows of the table of samples, worst first
MAX_PRINTED_SAMPLE_ROWS = 100  # as in page.css
MAX_OPEN_PANELS = 8  # panels that are not folded
PROFILE_NOTE = (
    "Residuals in sigmas of the noise. Grey: every sample. Coloured: the rolling mean. The band "
    "contains 99 % of such means if the residuals do not depend on the quantity; of many windows "
    "a few leave it by chance, and p is the chance of one as far outside as the farthest. The "
    "strongest dependence of the present model comes first. "
    "Quantities that did not vary, such as velocities at rest, are not shown."
)
SWITCH = (
    '<p class="switch"><button type="button" value="0" aria-pressed="true">present model</button>'
    '<button type="button" value="1" aria-pressed="false">with the effects found</button></p>'
)


def over_images(report: Report, plot: Plot) -> str:
    """Render what each camera saw, its lens, and the robot's error without the noise of the images;
    empty without a camera."""
    fitted = report.diagnosis.best.fitted
    told = as_html(images.describe_images(fitted))
    pages = {
        one.name: figure(plot(one.figure), caption=one.words)
        for one in image_figures.draw_cameras(fitted)
    }
    return tabs(pages) + told if pages else ""


def in_space(report: Report, plot: Plot) -> str:
    """Render residual arrows in space and in projections, errors by octant, model uncertainty."""
    left = report.residuals
    if left.kind is None:
        return paragraph("No pose was measured: there are no residuals in space.", "none")
    fields = [left.now] if left.found is None else [left.now, left.found]
    arrows, scale = spaces.residual_arrows(left.place, fields, left.kind, left.sample)
    flat, same = maps.residuals(left.place, fields, left.kind, left.sample)
    what = (
        f"Measured minus predicted position in {{B}}, magnified {scale:g} times."
        if left.kind == "position"
        else "Rotation from predicted to measured orientation (rotation vector in {B}), at "
        f"the platform's z axis on the unit sphere; 1 rad is drawn {scale:g} long."
    )
    if len(left.sample) > spaces.MAX_ARROWS:
        what += f" {spaces.MAX_ARROWS} of {len(left.sample)} samples are drawn."
    pages = {
        "in space": figure(paragraph(what, "note") + plot(arrows)),
        "plan, front, side": figure(
            plot(flat), caption=f"Residuals in {{B}}, magnified {same:g} times."
        ),
    }
    if report.spread is not None:
        ellipses, wide = maps.workspace(report.spread)
        note = (
            "Model uncertainty of the position: 1 σ ellipses, magnified "
            f"{wide:g} times, and 1 σ as colour. They follow from the covariance of the "
            "parameters, not from the residuals."
        )
        if report.spread.validity:
            note += f" They hold {report.spread.validity}."
        pages["model uncertainty"] = figure(plot(ellipses), caption=note)
    return (SWITCH if left.found is not None else "") + tabs(pages) + _regions(report.regions)


def _regions(rows: Sequence[Region]) -> str:
    """Render the rms errors of the workspace's octants, worst first."""
    if not rows:
        return ""
    turns = any(r.orientation_rms for r in rows)  # 0 if orientations were not measured
    listed = table(
        ("octant", "samples", "position rms", *(["orientation rms"] if turns else [])),
        [
            (
                r.region,
                str(r.samples),
                with_unit(r.position_rms, "m"),
                *([with_unit(r.orientation_rms, "rad")] if turns else []),
            )
            for r in rows
        ],
    )
    note = "Residuals of the fit of all samples; validation errors are larger."
    title = f"By octant of the workspace about ({vector(rows[0].middle, 'm', 0)}) mm"
    return folded(title, paragraph(note, "note") + listed)


def along_everything(report: Report, plot: Plot) -> str:
    """Render residuals against joints, position, time and conditions, and each joint's own."""
    shown, others = list[str](), list[str]()
    for profile, words, drawn in multiples(report.along, report.residuals, report.along_found):
        depends = profile.p_value < PATTERN_SIGNIFICANCE_LEVEL
        panel = figure(plot(drawn), f"Residual against {profile.name}:", words)
        (shown if depends else others).append(panel)
    if not shown + others:
        return paragraph("No recorded quantity varied.", "none")
    key = "".join(
        f'<span class="key"><i style="background:{colour(name, k)}"></i>{escape(name)}</span>'
        for k, name in enumerate(report.residuals.components)
    )
    note = f'{paragraph(PROFILE_NOTE, "note")}<p class="note">{key}</p>'
    parts = [SWITCH if report.residuals.found is not None else ""]
    if shown:
        parts.append(f"{note}{_grid(shown[:MAX_OPEN_PANELS])}")
    if rest := shown[MAX_OPEN_PANELS:]:
        more = f"{len(rest)} more {'quantity' if len(rest) == 1 else 'quantities'}"
        parts.append(folded(more, _grid(rest)))
    if others:
        inside = f"{'' if shown else note}{_grid(others)}"  # a note is next to what it explains
        chance = f"p > {PATTERN_SIGNIFICANCE_LEVEL:g}"
        title = f"{len(others)} quantities on which the residuals do not depend ({chance})"
        parts.append(f'<div class="on-screen">{folded(title, inside)}</div>')
        on_paper = f"Not printed: {len(others)} quantities on which the residuals do not depend"
        parts.append(paragraph(f"{on_paper} ({chance}).", "note more"))
    return "".join(parts) + _joints(report, plot)


def _grid(figures: Sequence[str]) -> str:
    return f'<div class="grid">{"".join(figures)}</div>' if figures else ""


def _joints(report: Report, plot: Plot) -> str:
    """Render each joint's residual against its reading, with the pattern of an effect found."""
    found = report.joints
    if not found.joints:
        return ""
    taken = [e.candidate for e in report.diagnosis.entries if e.name in report.diagnosis.effects]
    patterns = (signature(one) for one in taken if one.score is not None)
    own = [s for s in patterns if any(p.component in found.joints for p in s.panels)]
    candidate = own[0] if own else None
    pattern = f", with the pattern of {candidate.effect}" if candidate else ""
    words = (
        "Encoder reading minus inverse kinematics of the measured pose, present model, against "
        f"the reading{pattern}."
    )
    drawn = {
        "linear": joint_panels.flat_panels(found, candidate),
        "polar": joint_panels.polar_panels(found, candidate),
    }
    pages = {k: figure(plot(one), caption=words) for k, one in drawn.items() if one is not None}
    return "<h3>Residual of each joint</h3>" + tabs(pages)


def structure(report: Report, plot: Plot) -> str:
    """Render the tests of the remaining residuals, and the smooth map."""
    found = report.diagnosis.structure
    p = name_p_value(probability(found.p_value))
    known = paragraph(
        f"Neighbouring residuals are similar, or their signs change too seldom ({p})."
        if found.has_structure
        else f"The residuals show no structure, neither of neighbours nor of signs ({p})."
    )
    drawn = spaces.smooth_map(contents.map_in_base(report.diagnosis.base.scene, found.map))
    if drawn is None:
        return known + paragraph(
            "There is no smooth map: none predicts the residuals at held-out poses.", "none"
        )
    arrows, scale = drawn
    caution = paragraph(_caption(found.map, scale), "caution")
    return known + figure(caution + plot(arrows))


def _caption(found: SmoothMap, scale: float) -> str:
    position = found.kind == "position"
    over = f"correlated over {found.length * 1e3:.3g} mm" if position else "over the joints"
    return (
        "A picture, not a physical model: the smooth part of the residuals, "
        f"{with_unit(found.size, 'm' if position else 'rad')} rms, "
        f"{over}. It predicts {percent(found.share)} of the variance at held-out poses. Arrows are "
        f"magnified {scale:g} times."
    )


def samples(report: Report) -> str:
    """Render the samples, worst first; a click on a column header sorts them."""
    rows = report.samples
    note = f"{len(rows)} samples with their validation errors, the largest residual first."
    if len(rows) > MAX_SAMPLE_ROWS:
        note += f" The worst {MAX_SAMPLE_ROWS} are shown; all are in the JSON document."
    odd = [f"{format_sample(row.sample, row.name)} ({row.odd})" for row in rows if row.odd]
    aside = [f"{one.title} ({one.size})" for one in report.diagnosis.knocked]
    note += f" {ABOUT_SAMPLES}"
    if aside:
        note += (
            f" Set aside by the diagnosis, with the errors of a fit without it: {', '.join(aside)}."
        )
    other = "other " if aside else ""
    note += (
        f" Odd {other}samples: {', '.join(odd)}." if odd else f" There are no {other}odd samples."
    )
    shown = sample_table(rows[:MAX_SAMPLE_ROWS], report.errors.kinds, report.provenance.joint_units)
    printed = ""
    if len(rows) > MAX_PRINTED_SAMPLE_ROWS:
        printed = paragraph(f"On paper: the worst {MAX_PRINTED_SAMPLE_ROWS} samples.", "note more")
    return paragraph(note, "note") + printed + as_html([shown])
