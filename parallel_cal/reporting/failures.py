"""The parts of the report on residuals: in space, against quantities, by sample, smooth map."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from parallel_cal.diagnosis.lack_of_fit import SmoothMap
from parallel_cal.diagnosis.patterns import Region
from parallel_cal.diagnosis.signature import signature
from parallel_cal.reporting import image_figures, images, joint_panels, maps, spaces
from parallel_cal.reporting.markup import Plot, as_html, folded, paragraph, table, tabs
from parallel_cal.reporting.multiples import colour, multiples
from parallel_cal.reporting.readable import (
    name_p_value,
    percent,
    probability,
    vector,
    with_unit,
)
from parallel_cal.reporting.report import Report
from parallel_cal.reporting.results import sample_table

MAX_SAMPLE_ROWS = 400  # rows of the table of samples, worst first
MAX_PRINTED_SAMPLE_ROWS = 100  # as in page.css
MAX_OPEN_PANELS = 8  # panels that are not folded
PROFILE_NOTE = (
    "Residuals in sigmas of the noise. Grey: every sample. Coloured: the rolling mean. The band "
    "contains 99 % of such means if the residuals do not depend on the quantity; of many windows "
    "a few leave it by chance. The strongest dependence of the present model comes first. "
    "Quantities that did not vary, such as velocities at rest, are not shown."
)
SWITCH = (
    '<p class="switch"><button type="button" value="0" aria-pressed="true">present model</button>'
    '<button type="button" value="1" aria-pressed="false">with the effects found</button></p>'
)
COLOURS = "Colour is direction: red +x, green-yellow +y, cyan -x, violet -y; light up, dark down."


def over_images(report: Report, plot: Plot) -> str:
    """Render what each camera saw, its lens, and the robot's error without the noise of the images;
    empty without a camera."""
    fitted = report.diagnosis.best.fitted
    told = as_html(images.describe_images(fitted))
    pages = {
        one.name: paragraph(one.words, "note") + plot(one.figure)
        for one in image_figures.draw_cameras(fitted)
    }
    return tabs(pages) + told if pages else ""


def in_space(report: Report, plot: Plot) -> str:
    """Render residual arrows in space and in projections, errors by octant, model uncertainty."""
    left = report.residuals
    if left.kind is None:
        return paragraph("No pose was measured: there are no residuals in space.", "none")
    fields = [left.now] if left.found is None else [left.now, left.found]
    figure, scale = spaces.residual_arrows(left.place, fields, left.kind, left.sample)
    flat, same = maps.residuals(left.place, fields, left.kind, left.sample)
    what = (
        f"Measured minus predicted position, magnified {scale:g} times."
        if left.kind == "position"
        else "Rotation from predicted to measured orientation (rotation vector in {B}), at "
        f"the platform's z axis on the unit sphere; 1 rad is drawn {scale:g} long."
    )
    if len(left.sample) > spaces.MAX_ARROWS:
        what += f" {spaces.MAX_ARROWS} of {len(left.sample)} samples are drawn."
    wheel = '<span class="wheel" aria-hidden="true"></span>'
    legend = f'<p class="note legend">{wheel}<span>{escape(f"{what} {COLOURS}")}</span></p>'
    pages = {
        "in space": legend + plot(figure),
        "plan, front, side": paragraph(f"Residuals, magnified {same:g} times.", "note")
        + plot(flat),
    }
    if report.spread is not None:
        ellipses, wide = maps.workspace(report.spread)
        note = (
            "Model uncertainty of the position: 1 σ ellipses, magnified "
            f"{wide:g} times, and 1 σ as colour. They follow from the covariance of the "
            "parameters, not from the residuals."
        )
        pages["model uncertainty"] = paragraph(note, "note") + plot(ellipses)
    return (SWITCH if left.found is not None else "") + tabs(pages) + _regions(report.regions)


def _regions(rows: Sequence[Region]) -> str:
    """Render the rms errors of the workspace's octants, worst first."""
    if not rows:
        return ""
    listed = table(
        ("octant", "samples", "position rms", "orientation rms"),
        [
            (
                r.region,
                str(r.samples),
                with_unit(r.position_rms, "m"),
                with_unit(r.orientation_rms, "rad"),
            )
            for r in rows
        ],
    )
    note = "Residuals of the fit of all samples; validation errors are larger."
    title = f"By octant of the workspace about ({vector(rows[0].middle, 'm', 0)}) mm"
    return folded(title, paragraph(note, "note") + listed)


def along_everything(report: Report, plot: Plot) -> str:
    """Render residuals against joints, position, time and conditions, and each joint's own."""
    drawn = [
        f"<figure><figcaption><b>{escape(name)}</b> {escape(words)}</figcaption>"
        f"{plot(figure)}</figure>"
        for name, words, figure in multiples(report.along, report.residuals, report.along_found)
    ]
    if not drawn:
        return paragraph("No recorded quantity varied.", "none")
    key = "".join(
        f'<span class="key"><i style="background:{colour(name)}"></i>{escape(name)}</span>'
        for name in report.residuals.components
    )
    first, rest = "".join(drawn[:MAX_OPEN_PANELS]), "".join(drawn[MAX_OPEN_PANELS:])
    parts = [
        SWITCH if report.residuals.found is not None else "",
        paragraph(PROFILE_NOTE, "note"),
        f'<p class="note">{key}</p><div class="grid">{first}</div>',
    ]
    if rest:
        title = f"{len(drawn) - MAX_OPEN_PANELS} more quantities"
        parts.append(folded(title, f'<div class="grid">{rest}</div>'))
    return "".join(parts) + _joints(report, plot)


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
    pages = {"linear": plot(joint_panels.flat_panels(found, candidate))}
    if (polar := joint_panels.polar_panels(found, candidate)) is not None:
        pages["polar"] = plot(polar)
    words = (
        "Encoder reading minus inverse kinematics of the measured pose, present model, against "
        f"the reading{pattern}."
    )
    title = "<h3>Residual of each joint</h3>"
    return title + paragraph(words, "note") + tabs(pages)


def structure(report: Report, plot: Plot) -> str:
    """Render the tests of the remaining residuals, and the smooth map."""
    found = report.diagnosis.structure
    p = name_p_value(probability(found.p_value))
    known = paragraph(
        f"Neighbouring residuals are similar, or their signs change too seldom ({p})."
        if found.has_structure
        else f"The residuals show no structure, neither of neighbours nor of signs ({p})."
    )
    drawn = spaces.smooth_map(found.map)
    if drawn is None:
        return known + paragraph(
            "There is no smooth map: none predicts the residuals at held-out poses.", "none"
        )
    figure, scale = drawn
    return known + paragraph(_caption(found.map, scale), "caution") + plot(figure)


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
    note = f"{len(rows)} samples, worst first, with their validation errors."
    if len(rows) > MAX_SAMPLE_ROWS:
        note += f" The worst {MAX_SAMPLE_ROWS} are shown; all are in the JSON document."
    odd = [f"{row.sample} ({row.odd})" for row in rows if row.odd]
    note += " Samples are counted from 0, in the order of the recording."
    note += f" Odd samples: {', '.join(odd)}." if odd else " There are no odd samples."
    shown = sample_table(rows[:MAX_SAMPLE_ROWS], report.errors.kinds, report.provenance.joint_units)
    printed = ""
    if len(rows) > MAX_PRINTED_SAMPLE_ROWS:
        printed = paragraph(f"On paper: the worst {MAX_PRINTED_SAMPLE_ROWS} samples.", "note more")
    return paragraph(note, "note") + printed + as_html([shown])
