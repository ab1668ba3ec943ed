"""The parts of the report on parameters, unidentifiable combinations, comparison, provenance."""

from __future__ import annotations

from dataclasses import fields
from datetime import datetime

import numpy as np

from parallel_cal.base.units import DEGREE, ERROR_SI_UNITS, MM
from parallel_cal.diagnosis.verdict_words import describe_verdict
from parallel_cal.identification.noise_figures import list_noise
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.reporting import drawings, spaces
from parallel_cal.reporting.age import describe_age
from parallel_cal.reporting.blocks import Number, Row
from parallel_cal.reporting.certificate import CertificateFields
from parallel_cal.reporting.contents import CertifiedErrors
from parallel_cal.reporting.figures import MAX_MOVED_TOLERANCES
from parallel_cal.reporting.markup import (
    Plot,
    as_html,
    facts,
    figure,
    items,
    paragraph,
    sentence,
    table,
    tabs,
)
from parallel_cal.reporting.readable import (
    day,
    error_unit,
    is_known,
    number,
    value_unit,
    with_sigma,
    with_unit,
)
from parallel_cal.reporting.report import Report
from parallel_cal.reporting.tables import (
    describe_counts,
    errors_table,
    parameter_table,
    select_shown_parameters,
)
from parallel_cal.reporting.versus import Versus

HEIGHT_UNITS = {"m": ("mm per mm", 1.0), "rad": ("mm per degree", DEGREE / MM)}
MAX_NAMED_SAMPLES = 20  # excluded for one reason
IDENTIFIED_HERE = (
    "The model was identified from these samples. Its errors are rms at held-out poses: at each "
    "pose those of a fit that did not use it."
)
NOT_IDENTIFIED_HERE = (
    "The model was not identified from these samples. Its errors are rms errors of the unchanged "
    "model at these samples; only the registration of the device was estimated, if it was needed."
)
IDENTIFIED_WITH_OTHERS = (
    "The model was identified from these samples, but that fit excluded {}. The numbers of this "
    "report are those of fits without the excluded samples above: they are not those of the model. "
    "Exclude the same samples, fit and save the model again."
)
RULE = (
    "U is the expanded uncertainty (k = 2) from the scatter between poses. It does not contain the "
    "uncertainty of the measuring device: subtract that from the limit unless it is small. The "
    "decision follows the rule of ISO 14253-1: pass if error + U is within the limit, fail if "
    "error - U is beyond it."
)
NO_RULE = (
    "The standard deviations are from the scatter between poses and do not contain the uncertainty "
    "of the measuring device. State a limit (limit_um, limit_arcmin) to obtain a decision."
)


def parameters(report: Report, plot: Plot) -> str:
    """Render every free parameter with its value, its sigma, its shift, and its place."""
    shown = select_shown_parameters(report.diagnosis.best.fitted.model, report.parameters)
    far = sum(abs(p.moved_tolerances) > MAX_MOVED_TOLERANCES for p in shown.values())
    added = report.diagnosis.effects
    of = f"Model with {' and '.join(added)} added: " if added else ""
    free = sum(not p.fixed for p in shown.values())
    note = (
        f"{of}{free} free parameters; {far or 'none'} moved more than "
        f"{MAX_MOVED_TOLERANCES:g} tolerances from nominal."
    )
    how = paragraph("Click a column header to sort.", "note on-screen")
    pages = {"values": how + as_html([parameter_table(shown)])}
    drawn = drawings.drawing(report.diagnosis.best.fitted.model, None, report.parameters)
    if drawn is not None:
        about = "Point at a line to see its parameters and their values."
        pages["on the mechanism"] = figure(paragraph(about, "note on-screen") + plot(drawn))
    return paragraph(note, "note") + tabs(pages)


def height_changes(report: Report) -> str:
    """Render how the heights at some touches change with each parameter that a fit moves, and with
    what all chains have in common; empty without touches."""
    found = report.height_changes
    if found is None:
        return ""
    places = [f"x {x / MM:.0f}, y {y / MM:.0f} mm" for x, y in found.places]
    rows: list[Row] = []
    for name, change in found.parameters.items():
        known = report.parameters.get(name)
        if known is not None and known.fixed:
            continue
        unit, factor = HEIGHT_UNITS.get(change.unit, (f"m per {change.unit}", 1.0))
        slopes = np.round(factor * change.slopes, 3) + 0.0
        rows.append((name, *map(Number, slopes.tolist()), unit))
    note = (
        "How much higher the tip is there, at the same joint readings, if a parameter is larger. A "
        "firmware whose number is too large by that much finds the bed lower by as much."
    )
    return paragraph(note, "note") + table(("parameter", *places, "unit"), rows)


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
    drawn, residuals = [""] * 2, report.residuals
    if residuals.kind is not None:
        models = [(side.place, side.residual, residuals.sample) for side in versus.sides]
        figures, scale = spaces.sides(models, residuals.kind)
        drawn = [plot(figure) for figure in figures]
    pictures = ""
    for (name, side), picture in zip(sides.items(), drawn, strict=True):
        about = f"{side.mechanism}, {' + '.join(side.effects) or 'no effects'}"
        about += f", sha256 {side.model_sha256[:12]}" + (f", arrows × {scale:g}" if picture else "")
        pictures += figure(picture, name, about)
    rows: list[Row] = []
    for row in versus.parameters:
        unit, factor = value_unit(row.unit)
        values = [Number(value, factor, significant=6) for value in row.values]
        rows.append((row.name, *values, unit, Number(row.difference_tolerances)))
    header = ("parameter", *sides, "unit", "difference [tolerances]")
    return (
        paragraph("Both models on the same samples, without a fit.", "note")
        + as_html([errors_table(columns, versus.sides[0].noise, report.diagnosis.model)])
        + f'<div class="pair">{pictures}</div>'
        + (
            table(header, rows, "sortable")
            if rows
            else paragraph("All parameters are equal.", "none")
        )
    )


def certificate(report: Report) -> str:
    """Render the certificate: what the owner stated, the identity of model and data, the decision
    on each limit, and a line to sign. What was not stated is blank."""
    p, data, stated = report.provenance, report.diagnosis.dataset, report.certificate
    rows = {
        one.metadata["words"]: getattr(stated, one.name)
        for one in fields(stated)
        if "words" in one.metadata
    }
    recorded = data.conditions.get("temperature")
    if not stated.temperature and recorded is not None and np.isfinite(recorded).any():
        low, high = np.nanmin(recorded), np.nanmax(recorded)
        rows["Temperature"] = f"{low:.1f} to {high:.1f} °C (recorded with the samples)"
    errors = report.errors
    counts = describe_counts(errors.samples, errors.poses, True)
    verdict = report.diagnosis.verdict
    fitted = report.diagnosis.base.fitted
    rows |= {
        "Model": f"{p.mechanism}, effects: {', '.join(p.effects) or 'none'}; sha256 "
        f"{p.model_sha256}",
        "Data": f"{data.source}; {counts}; sha256 {data.sha256 or 'not known'}",
        "Excluded samples": _describe_excluded(data),
        "Noise, 1 sigma": "; ".join(
            f"{one.describe(with_unit)} ({one.source})"
            for one in list_noise(fitted.model, fitted.observations)
        ),
        "Region of the samples": report.diagnosis.base.fitted.region.description,
        "Verdict": sentence(describe_verdict(verdict.word, verdict.text)),
        "Trusted": sentence(describe_age(report.age, datetime.fromisoformat(p.made).timestamp())),
        "Software": f"parallel_cal {p.version}",
        "Date of this certificate": day(p.made),
    }
    certified = report.certified
    decided = [sentence(one.description) for one in report.conformity] or [
        f"No limit of acceptance was stated: there is no decision. {_errors_in_words(certified)}"
    ]
    signature = facts({"Calibrated by": "", "Approved by": ""})
    identified = IDENTIFIED_HERE if certified.identified_here else NOT_IDENTIFIED_HERE
    if certified.fit_excluded is not None:
        numbers = ", ".join(map(str, certified.fit_excluded))
        identified = IDENTIFIED_WITH_OTHERS.format(f"sample {numbers}" if numbers else "none")
    # The decision may be printed on another sheet than the fields.
    robot = paragraph(f"{name_robot(stated) or p.mechanism}, model {p.model_sha256[:12]}")
    note = paragraph(f"{identified} {RULE if report.conformity else NO_RULE}", "note")
    return (
        facts(rows)
        + f'<div class="decision"><h3>Decision</h3>{robot}{items(decided)}{note}'
        + f'<div class="signature">{signature}</div></div>'
    )


def name_robot(stated: CertificateFields) -> str:
    """Name the robot and its serial number as stated: `Delta 4, serial number D-0042`."""
    serial = f"serial number {stated.serial_number}" if stated.serial_number else ""
    return ", ".join(filter(None, (stated.robot, serial)))


def _describe_excluded(data: Dataset) -> str:
    """Describe the excluded samples by reason, with counts: `2 of 94: bumped (2: samples 3, 7)`."""
    if not data.excluded:
        return f"none; all {len(data)} samples were used"
    by_reason: dict[str, list[int]] = {}
    for sample, reason in sorted(data.excluded.items()):
        by_reason.setdefault(reason or "no reason given", []).append(sample)
    parts = []
    for reason, numbers in by_reason.items():
        named = ", ".join(map(data.title, numbers[:MAX_NAMED_SAMPLES]))
        more = ", ..." if len(numbers) > MAX_NAMED_SAMPLES else ""
        kind = "sample" if len(numbers) == 1 else "samples"
        parts.append(f"{reason} ({len(numbers)}: {kind} {named}{more})")
    count = len(data.excluded)
    return f"{count} of {len(data) + count}: {'; '.join(parts)}"


def _errors_in_words(certified: CertifiedErrors) -> str:
    """Describe the rms errors with their standard deviations."""
    known = [kind for kind in ERROR_SI_UNITS if is_known(certified.errors.rms(kind))]
    shown = []
    for kind in known:
        name, factor = error_unit(ERROR_SI_UNITS[kind])
        value = with_sigma(certified.errors.rms(kind), certified.sigmas.get(kind), factor)
        shown.append(f"{kind} error {value} {name} (1 sigma)")
    return f"{sentence('; '.join(shown))}" if shown else "The errors are not known."


def provenance(report: Report) -> str:
    """Render the hashes, versions, sources of the noise, options and warnings."""
    p, found = report.provenance, report.diagnosis
    data, (low, high) = found.dataset, found.band
    base, best = (trial.fitted.estimate.chi2_per_dof for trial in (found.base, found.best))
    noise = [f"{kind} from {source}" for kind, source in p.noise_from.items()]
    band = f"; {number(low)} to {number(high)} if the model is complete" if is_known(high) else ""
    effects = [
        f"{name} (found in data, cause unknown)" if name in p.found_in_data else name
        for name in p.effects
    ]
    rows = {
        "Model": f"{p.mechanism}, effects: {', '.join(effects) or 'none'}",
        "Model, sha256": p.model_sha256,
        "Data": f"{data.source}, {len(data)} samples, {p.dropped} dropped messages",
        "Data, sha256": data.sha256 or "none: not read from a recording",
        "Noise": f"{'; '.join(noise)}; judged by: {found.noise.source}",
        "chi2/dof": f"{number(base)} now, {number(best)} with the effects found{band}",
        "Options": ", ".join(
            f"{key} {', '.join(map(str, value)) if isinstance(value, (list, tuple)) else value}"
            for key, value in p.options.items()
            if value not in (None, False, "", [], (), {})
        ),
        "Made": f"{day(p.made)} by parallel_cal {p.version}",
    }
    warned = items(dict.fromkeys(found.best.fitted.warnings))
    return facts(rows) + (f"<h3>Warnings</h3>{warned}" if warned else "")
