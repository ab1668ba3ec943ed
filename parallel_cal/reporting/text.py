"""Format results for a terminal: tables and sentences, every number with its unit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import singledispatch
from typing import Any

import numpy as np

from parallel_cal.base.units import ARCMIN
from parallel_cal.diagnosis.comparison import Comparison
from parallel_cal.diagnosis.diagnose import Diagnosis
from parallel_cal.diagnosis.entries import Entry
from parallel_cal.identification.budget import Iso9283, iso_9283
from parallel_cal.identification.fit import FitResult
from parallel_cal.identification.prediction_errors import ERRORS, Summary
from parallel_cal.model.model import Model
from parallel_cal.reporting.readable import (
    columns,
    error_unit,
    format_fixed,
    format_fixed_vector,
    in_unit,
    percent,
    unit_of,
    value_unit,
)
from parallel_cal.session.steps import Step

# Limits on what one screen shows.
MAX_CANDIDATES = 8
MAX_SAMPLES = 10
MAX_PATTERNS = 5
MIN_SHOWN_P_VALUE = 1e-99  # a smaller p-value adds no information
PATTERN_SIGNIFICANCE_LEVEL = 0.05  # below it a pattern of the errors is shown


@singledispatch
def show(result: Any) -> str:
    """Format a result as the command line prints it.

    Parameters
    ----------
    result : FitResult, Step, Comparison or Diagnosis

    Returns
    -------
    str

    Raises
    ------
    TypeError
        For anything else.

    Examples
    --------
    >>> import parallel_cal as pc
    >>> model = pc.read_model("config/delta_mockup_nominal.yaml")
    >>> data = pc.load_dataset("bags/delta_backlash", joints=model.joints)
    >>> print(pc.show(pc.compare(model, data)).splitlines()[0])
    94 samples
    """
    kind = type(result).__name__
    raise TypeError(
        f"show: got {kind}, expected the result of fit, add, remove, compare or diagnose"
    )


@show.register
def format_step(step: Step) -> str:
    """Format a step's fit; the fit without an added effect is its reference."""
    shown = format_fit(step.result, step.rival if step.name == "add" else None)
    if step.platform_shift is None:
        return shown
    measured, anywhere, worth = (
        format_fixed(distance, 1e6, 0)
        for distance in (
            step.platform_shift.measured,
            step.platform_shift.workspace,
            step.platform_shift.shown,
        )
    )
    return (
        f"{shown}\nthe change moves the platform by {measured} um rms at the measured poses and by "
        f"{anywhere} um rms over the workspace; the validation error shows {worth} um of it"
    )


@show.register
def format_fit(result: FitResult, without: FitResult | None = None) -> str:
    """Format a fit; `without` is the fit of the same samples without the added effect."""
    rival = result.held_out_before if without is None else without.held_out
    judged = {
        "before": result.before.summary,
        "after": result.after.summary,
        "held-out, before" if without is None else "held-out, without it": rival.summary,
        "held-out, after": result.held_out.summary,
    }
    rows, given = [], find_given_parameters(result.model)
    for name, p in result.parameters().items():
        if not p.fixed or name in given:
            value, unit = in_unit(p.value, p.unit)
            change, sigma = (in_unit(v, p.unit)[0] for v in (p.value - p.nominal, p.sigma))
            rows.append((name, value, change, sigma, unit))
    estimate = result.estimate
    return "\n".join(
        [
            f"{result.samples} samples, {estimate.spectrum.rank} of {result.free.sum()} free "
            f"parameters identified, chi2/dof {format_fixed(estimate.chi2_per_dof)}",
            errors_table(judged, result.noise_floor, result.model),
            *budget_lines(result),
            columns(("parameter", "value", "from nominal", "sigma", "unit"), rows),
        ]
    )


def budget_lines(result: FitResult) -> Iterator[str]:
    """Format the error budget of the drawing and the ISO 9283 figures of the identified model.

    Both are for positions if positions were measured.
    """
    for budget in result.budgets[:1]:
        unit, factor = ascii_unit(budget.kind)
        rows = [
            (
                part.name,
                format_fixed(part.contribution, factor),
                format_fixed(part.alone, factor),
                unit,
            )
            for part in budget.parts
        ]
        total = f"{budget.kind} error of {format_fixed(budget.total, factor)} {unit}: parts"
        yield columns((total, "share", "by itself", "unit"), rows)
    yield from map(iso_line, result.iso_9283[:1])


def iso_line(figures: Iso9283) -> str:
    unit, factor = ascii_unit(figures.kind)
    again = "repeatability RP not known: no pose was visited twice"
    if figures.repeatability is not None:
        again = (
            f"repeatability RP {format_fixed(figures.repeatability, factor)} {unit} "
            f"({figures.poses} poses, {figures.visits} visits)"
        )
    mean, worst = (format_fixed(a, factor) for a in (figures.accuracy_mean, figures.accuracy_max))
    return f"ISO 9283 {figures.kind}: accuracy AP {mean} {unit}, worst {worst}; {again}"


def ascii_unit(kind: str) -> tuple[str, float]:
    name, factor = error_unit(unit_of(kind, {}))
    return name.replace("µ", "u"), factor


def find_given_parameters(model: Model) -> set[str]:
    """Find fixed parameters of effects that the owner gave or a search found: ratios, masses."""
    table = model.table
    known = [
        table.matching(effect.fixed_patterns())
        for effect in model.effects
        if effect.fixed_patterns()
    ]
    shown = np.any(known, axis=0) & (model.values != table.nominal) if known else []
    return {name for name, one in zip(table.names, shown, strict=False) if one}


def errors_table(judged: Mapping[str, Summary], noise: Summary, model: Model) -> str:
    """Format mean and rms errors, one column each of before, after, ... (as table 5.15).

    The noise floor is one more column if the noise is known. A redundant closure adds the rms of
    its rows.
    """
    judged = {**judged, "noise floor": noise} if noise.is_known else dict(judged)
    joint_units = dict(zip(model.joints, model.mechanism.joint_units, strict=True))
    rows = []
    for kind in ("position", "orientation", "reading", "joint"):
        winds = kind == "joint" and not model.mechanism.periodic  # winches turn many times
        name, factor = (value_unit if winds and "rad" in joint_units.values() else error_unit)(
            unit_of(kind, joint_units)
        )
        if any(e.mean(kind) is not None for e in judged.values()):
            for measure, get in (("mean", Summary.mean), ("rms", Summary.rms)):
                cells = [format_fixed(get(e, kind), factor) for e in judged.values()]
                rows.append([f"{kind} error, {measure}", *cells, name.replace("µ", "u")])
    if model.structure.phi.shape[0] > len(model.mechanism.moved):
        cells = [format_fixed(e.closure_rms, 1e6) for e in judged.values()]
        rows.append(["closure, rms of its rows", *cells, "um"])
    return columns(["", *judged, "unit"], rows)


@show.register
def format_comparison(comparison: Comparison) -> str:
    """Format errors, the worst samples, patterns of the errors, and odd samples."""
    return "\n".join(
        [
            f"{len(comparison.observations)} samples",
            errors_table({"error": comparison.errors.summary}, comparison.noise, comparison.model),
            *map(iso_line, iso_9283(comparison.errors, comparison.observations)[:1]),
            "worst samples:",
            _worst(comparison),
            *_format_patterns(comparison),
        ]
    )


def _worst(comparison: Comparison) -> str:
    data, errors = comparison.dataset, comparison.errors
    norms = {kind: errors.norms(kind) for kind in ERRORS}
    worst = comparison.worst_first[:MAX_SAMPLES]
    shown = {
        "sample": [str(number) for number in data.numbers[worst]],
        "time [s]": [format_fixed(t, 1, 1) for t in data.time[worst]],
        "at [mm]": [format_fixed_vector(place, 1e3, 1) for place in comparison.place[worst]],
    }
    if np.isfinite(norms["position"]).any():
        shown["error [um]"] = [format_fixed_vector(e, 1e6, 0) for e in errors.position[worst]]
        shown["|error| [um]"] = [format_fixed(e, 1e6, 0) for e in norms["position"][worst]]
    if np.isfinite(norms["orientation"]).any():
        shown["turned [arcmin]"] = [
            format_fixed(e, 1 / ARCMIN) for e in norms["orientation"][worst]
        ]
    for channel, read in zip(comparison.model.structure.channels, errors.reading.T, strict=True):
        shown[f"{channel} [um]"] = [format_fixed(e, 1e6, 0) for e in read[worst]]
    return columns(tuple(shown), list(zip(*shown.values(), strict=True)))


def _format_patterns(comparison: Comparison) -> Iterator[str]:
    """Format significant patterns of the errors, the worst region and odd samples."""
    rows = [
        (a.name, format_fixed(a.strength, 1, 1), f"{a.p_value:.2g}")
        for a in comparison.residual_profiles[:MAX_PATTERNS]
        if a.p_value < PATTERN_SIGNIFICANCE_LEVEL
    ]
    if rows:
        yield "errors correlate with:"
        yield columns(("along", "largest mean [sigma]", "p"), rows)
    else:
        yield "errors correlate with no recorded quantity"
    worst = comparison.regions[0]
    yield (
        f"worst region: {worst.region}, "
        f"{format_fixed(worst.position_rms or worst.reading_rms, 1e6, 0)} um rms; "
        f"structure: p = {comparison.structure.p_value:.2g}"
    )
    for one in comparison.odd_samples[:MAX_PATTERNS]:
        at = format_fixed_vector(one.place, 1e3, 1)
        yield f"odd: sample {one.sample} at {at} mm, {one.sigmas:.1f} sigmas"


@show.register
def format_diagnosis(diagnosis: Diagnosis) -> str:
    """Format the verdict, validation errors, the candidates, and what to measure next."""
    judged = {
        "held-out, as it is": diagnosis.base.fitted.held_out.summary,
        "held-out, with it": diagnosis.best.fitted.held_out.summary,
    }
    return "\n".join(
        [
            f"{diagnosis.verdict.word}: {diagnosis.verdict.summary}",
            errors_table(judged, diagnosis.best.fitted.noise_floor, diagnosis.model),
            *_candidates(diagnosis.entries),
            *_odd(diagnosis),
            *_next(diagnosis),
        ]
    )


def _candidates(entries: tuple[Entry, ...]) -> Iterator[str]:
    tested = [entry for entry in entries if entry.p_adjusted is not None][:MAX_CANDIDATES]
    header = ("effect", "p", "held-out", "explains", "first pick", "not geometry", "confused with")
    yield columns(header, [_candidate(entry) for entry in tested])
    for entry in tested:
        for key, sigma in entry.candidate.sigma.items():
            best = entry.candidate.settings[key]
            yield f"{entry.name}: {key} {best:.4g} +- {sigma:.2g} fits best"
    for entry in entries:
        was_scored = entry in tested or entry.candidate.score is not None
        if entry.candidate.missing or (entry.reason and was_scored):
            yield f"{entry.name}: {entry.reason}"


def _candidate(entry: Entry) -> tuple[str, ...]:
    p, alone = entry.p_adjusted or 0.0, entry.alone
    ratio, share = (alone.ratio, alone.share_explained) if alone else (None, None)
    return (
        entry.name,
        f"{p:.2g}" if p > MIN_SHOWN_P_VALUE else f"<{MIN_SHOWN_P_VALUE:.0g}",
        percent(ratio, 1, "-"),
        *(percent(one, missing="-") for one in (share, entry.first_picks, entry.remaining)),
        ", ".join(entry.confused_with),
    )


def _odd(diagnosis: Diagnosis) -> Iterator[str]:
    for one in diagnosis.odd_samples[:MAX_CANDIDATES]:
        yield (
            f"{one.label}: sample {one.sample} at {format_fixed_vector(one.place, 1e3, 1)} mm, "
            f"{one.time:.1f} s, {one.sigmas:.1f} sigmas, Cook's "
            f"distance {one.cooks_distance:.2f} (--data exclude={one.sample} excludes it)"
        )


def _next(diagnosis: Diagnosis) -> Iterator[str]:
    for advice in diagnosis.measure_next.advice:
        yield f"measure next: {advice}"
    if plan := diagnosis.measure_next.plan:
        yield (
            f"{len(plan.poses)} planned poses (--json) would separate "
            f"{' from '.join(plan.separates)} "
            f"by {plan.sigmas.then:.1f} sigmas; the present samples do by {plan.sigmas.now:.1f}"
        )
