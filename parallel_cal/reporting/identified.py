"""The parts of the report on parameters, unidentifiable combinations, comparison, provenance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

from parallel_cal.identification.prediction_errors import ERRORS, Summary
from parallel_cal.reporting import drawings, figures, spaces
from parallel_cal.reporting.contents import DescribedParameter, Residuals
from parallel_cal.reporting.markup import Cell, Plot, facts, items, paragraph, table, tabs
from parallel_cal.reporting.readable import (
    day,
    is_known,
    number,
    round_to_sigma,
    unit_of,
    value_unit,
    with_unit,
)
from parallel_cal.reporting.report import Report
from parallel_cal.reporting.versus import Difference, Side, Versus


def parameters(report: Report, plot: Plot) -> str:
    """Render every free parameter with its value, its sigma, its shift, and its place."""
    moving = {name: p for name, p in report.parameters.items() if not p.fixed}
    far = sum(abs(p.moved_tolerances) > figures.MAX_MOVED_TOLERANCES for p in moving.values())
    added = report.diagnosis.effects
    of = f"Model with {' and '.join(added)} added: " if added else ""
    note = (
        f"{of}{len(moving)} free parameters; {far or 'none'} moved more than "
        f"{figures.MAX_MOVED_TOLERANCES:g} tolerances from nominal. Click a column header to sort."
    )
    most = max((abs(p.moved_tolerances) for p in moving.values()), default=0.0)
    rows = [_parameter(name, p, most) for name, p in moving.items()]
    header = ("parameter", "moved [tolerances]", "value", "1 σ", "unit", "nominal", "description")
    pages = {"values": table(header, rows, "sortable")}
    drawn = drawings.drawing(report.diagnosis.best.fitted.model, None, report.parameters)
    if drawn is not None:
        about = "Point at a line to see its parameters and their values."
        pages["on the mechanism"] = paragraph(about, "note") + plot(drawn)
    return paragraph(note, "note") + tabs(pages)


def _parameter(name: str, p: DescribedParameter, most: float) -> list[Cell | str]:
    unit, factor = value_unit(p.unit)
    value, sigma = round_to_sigma(p.value, p.sigma, factor)
    moved, far = p.moved_tolerances, abs(p.moved_tolerances) > figures.MAX_MOVED_TOLERANCES
    return [
        Cell(name, mark="odd" if far else ""),
        Cell(number(moved, 1.0, 2), key=moved, bar=moved / most if most else None),
        Cell(value, key=p.value),
        Cell(sigma, key=p.sigma),
        unit,
        number(p.nominal, factor, 6),
        p.words,
    ]


def combinations(report: Report) -> str:
    """Render the unidentifiable and weak combinations and the strongest correlations."""
    found = report.combinations
    lists = {
        "Unidentifiable": [row["text"] for row in found["unidentifiable"]],
        "Determined less well than by the tolerances": [row["text"] for row in found["weak"]],
        "Strongly correlated": [
            f"{' and '.join(pair.parameters)}: {pair.value:.4f}" for pair in report.correlated
        ],
    }
    parts = [f"<h3>{title}</h3>{items(texts)}" for title, texts in lists.items() if texts]
    all_well = paragraph("The data determine every combination of the free parameters.", "none")
    return "".join(parts) or all_well


def render_comparison(versus: Versus, report: Report, plot: Plot) -> str:
    """Render two models side by side: errors, arrows, and the parameters that differ."""
    sides = dict(zip(("this model", "other model"), versus.sides, strict=True))
    columns = {name: side.errors for name, side in sides.items()}
    if (noise := versus.sides[0].noise).is_known:
        columns["noise floor"] = noise
    pictures = "".join(_side(name, side, report.residuals, plot) for name, side in sides.items())
    rows = [_difference(row) for row in versus.parameters]
    header = ("parameter", *sides, "unit", "difference [tolerances]")
    return (
        paragraph("Both models on the same samples, without a fit.", "note")
        + _errors(columns, report.provenance.joint_units)
        + f'<div class="pair">{pictures}</div>'
        + (
            table(header, rows, "sortable")
            if rows
            else paragraph("All parameters are equal.", "none")
        )
    )


def _errors(columns: Mapping[str, Summary], units: Mapping[str, str]) -> str:
    """Render the mean and rms of each measured error, one column per model."""
    rows = []
    for kind in ERRORS:
        for measure, get in (("mean", Summary.mean), ("rms", Summary.rms)):
            values = [get(e, kind) for e in columns.values()]
            if any(v is not None for v in values):
                shown = (with_unit(v, unit_of(kind, units)) for v in values)
                rows.append([f"{kind} error, {measure}", *shown])
    return table(("", *columns), rows)


def _side(name: str, side: Side, residuals: Residuals, plot: Plot) -> str:
    effects = " + ".join(side.effects) or "no effects"
    about, picture = f"{side.mechanism}, {effects}, sha256 {side.model_sha256[:12]}", ""
    if residuals.kind is not None:
        figure, scale = spaces.side(side.place, side.residual, residuals.kind, residuals.sample)
        about, picture = f"{about}, arrows × {scale:g}", plot(figure)
    caption = f"<figcaption><b>{escape(name)}</b> {escape(about)}</figcaption>"
    return f"<figure>{caption}{picture}</figure>"


def _difference(row: Difference) -> Sequence[Cell | str]:
    unit, factor = value_unit(row.unit)
    apart = row.difference_tolerances
    values = [number(v, factor, 6) for v in row.values]
    return [row.name, *values, unit, Cell(number(apart), key=apart)]


def provenance(report: Report) -> str:
    """Render the hashes, versions, sources of the noise, options and warnings."""
    p, found = report.provenance, report.diagnosis
    data, (low, high) = found.dataset, found.band
    base, best = (trial.fitted.estimate.chi2_per_dof for trial in (found.base, found.best))
    noise = [f"{kind} from {source}" for kind, source in p.noise_from.items()]
    band = f"; {number(low)} to {number(high)} if the model is complete" if is_known(high) else ""
    rows = {
        "Model": f"{p.mechanism}, effects: {', '.join(p.effects) or 'none'}",
        "Model, sha256": p.model_sha256,
        "Data": f"{data.source}, {len(data)} samples, {p.dropped} dropped messages",
        "Data, sha256": data.sha256 or "none: not read from a recording",
        "Noise": f"{'; '.join(noise)}; judged by: {found.noise.source}",
        "chi2/dof": f"{number(base)} now, {number(best)} with the effects found{band}",
        "Options": ", ".join(f"{key}={value}" for key, value in p.options.items()),
        "Made": f"{day(p.made)} by parallel_cal {p.version}",
    }
    warned = items(dict.fromkeys(found.best.fitted.warnings))
    return facts(rows) + (f"<h3>Warnings</h3>{warned}" if warned else "")
