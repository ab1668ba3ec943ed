"""Describe results as blocks: one function for each kind of result, and for each of its parts."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from parallel_cal.base.arguments import describe_argument
from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.units import ARCMIN
from parallel_cal.diagnosis.verdict_words import VERDICT_LABELS
from parallel_cal.identification.fit import FitResult
from parallel_cal.identification.fit_warnings import chi2_band
from parallel_cal.identification.prediction_errors import ERRORS
from parallel_cal.model.region import describe_workspace_excess
from parallel_cal.reporting.blocks import (
    MAX_REMARKS,
    Block,
    Detail,
    Judgement,
    Number,
    PValue,
    Table,
)
from parallel_cal.reporting.contents import parameters as describe_parameters
from parallel_cal.reporting.images import describe_images
from parallel_cal.reporting.names import name_setting
from parallel_cal.reporting.readable import (
    format_fixed,
    format_fixed_vector,
    name_p_value,
    short_probability,
)
from parallel_cal.reporting.summary import describe_result_errors
from parallel_cal.reporting.tables import (
    budget_sentence,
    budget_table,
    candidate_table,
    errors_table,
    iso_sentence,
    parameter_table,
    select_shown_parameters,
)

if TYPE_CHECKING:
    from parallel_cal.diagnosis.catalogue import Candidate
    from parallel_cal.diagnosis.comparison import Comparison
    from parallel_cal.diagnosis.result import Diagnosis
    from parallel_cal.discovery.law import Discovery
    from parallel_cal.session.steps import Step

# Limits on what one screen shows.
MAX_CANDIDATES = 8
MAX_SAMPLES = 5
MAX_PATTERNS = 5
PATTERN_SIGNIFICANCE_LEVEL = 0.05  # below it a terminal shows an effect or a pattern of the errors


def describe(result: Any) -> Iterator[Block]:
    """Describe a result; ParallelCalError if it is not one of those below."""
    # By name: the classes of a diagnosis need not be imported to show a fit.
    describers: dict[str, Callable[[Any], Iterator[Block]]] = {
        "Step": describe_step,
        "FitResult": describe_fit,
        "Comparison": describe_comparison,
        "Diagnosis": describe_diagnosis,
        "Discovery": describe_discovery,
    }
    kind = type(result).__name__
    if kind not in describers:
        raise ParallelCalError(
            f"{describe_argument('result', result)}; expected the result of fit, add, remove, "
            "compare, diagnose or discover"
        )
    return describers[kind](result)


def describe_step(step: Step) -> Iterator[Block]:
    """Describe a step's fit; the fit without an added effect is its reference."""
    yield from describe_fit(step.result, step.rival if step.name == "add" else None)
    if step.knocked:
        yield (
            f"excluded from both fits: sample {', '.join(map(str, step.knocked))} "
            f"({step.result.dataset.excluded[step.knocked[0]].removeprefix('because it is ')})"
        )
    if shift := step.platform_shift:
        measured, anywhere, worth = (
            format_fixed(distance, 1e6, 0)
            for distance in (shift.measured, shift.workspace, shift.shown)
        )
        neutral = ", ".join(
            f"{name} {value:g}{'' if unit == '1' else f' {unit}'}"
            for name, (value, unit) in shift.neutral.items()
        )
        there = f" (at {neutral}; the samples have other values)" if neutral else ""
        yield (
            f"the change moves the origin of '{step.result.model.frames['platform']}' by "
            f"{measured} um rms at the measured poses and by {anywhere} um rms over the workspace"
            f"{there}; the validation error shows {worth} um of it"
        )
        beyond = describe_workspace_excess(step.result.model, step.result.region)
        where = f"these errors are of samples in {step.result.region.description}"
        yield f"{where}; {beyond}" if beyond else Detail(where)


def describe_fit(result: FitResult, without: FitResult | None = None) -> Iterator[Block]:
    """Describe a fit; `without` is the fit of the same samples without the added effect.

    The budget and the figures after ISO 9283 are for positions if positions were measured.
    """
    rival = result.held_out_before if without is None else without.held_out
    judged = {
        result.given.label: result.before.summary,
        "after": result.after.summary,
        f"held-out, {result.given.label}" if without is None else "held-out, without it": (
            rival.summary
        ),
        "held-out, after": result.held_out.summary,
    }
    estimate = result.estimate
    if result.held_out.summary.is_known:
        errors = describe_result_errors(result.held_out.summary, rival.summary, result.noise_floor)
        yield f"error at held-out poses {errors}"
    least, _ = chi2_band(estimate.dof)
    small = estimate.chi2_per_dof < least and not result.observations.noise_assumed
    cause = "the noise is taken too large, or lengths were read in too small a unit"
    yield (
        f"{result.samples} samples, {estimate.spectrum.rank} of {result.free.sum()} free "
        f"parameters identified, chi2/dof {format_fixed(estimate.chi2_per_dof)}"
    ) + small * f", below {format_fixed(least)}: {cause}"
    yield errors_table(judged, result.noise_floor, result.model)
    yield from describe_images(result)
    for budget in result.budgets[:1]:
        yield budget_table(budget)
        yield Detail(budget_sentence(budget))
    yield from map(Detail, map(iso_sentence, result.iso_9283[:1]))
    shown = select_shown_parameters(result.model, describe_parameters(result))
    yield Detail(parameter_table(shown), "parameters")


def describe_comparison(comparison: Comparison) -> Iterator[Block]:
    """Describe errors, the worst samples, patterns of the errors, and odd samples."""
    shown = describe_result_errors(comparison.errors.summary, None, comparison.noise)
    yield f"{len(comparison.observations)} samples: error {shown}"
    errors = {"error": comparison.errors.summary}
    if comparison.given.is_registered:
        # Without start values, a camera predicts nothing as given.
        as_given = {"as given": comparison.given.errors_as_given.summary}
        if comparison.given.lacked_start:
            as_given = {}
        errors = {
            **as_given,
            comparison.given.label: comparison.errors.summary,
            f"held-out, {comparison.given.label}": comparison.held_out.summary,
        }
    yield errors_table(errors, comparison.noise, comparison.model)
    yield from map(Detail, map(iso_sentence, comparison.iso_9283[:1]))
    yield "worst samples:"
    yield _worst_samples(comparison)
    rows = [
        (a.name, Number(a.strength, 1, 1), PValue(a.p_value))
        for a in comparison.residual_profiles[:MAX_PATTERNS]
        if a.p_value < PATTERN_SIGNIFICANCE_LEVEL
    ]
    if rows:
        yield "errors correlate with:"
        yield Table(("along", "largest mean [sigma]", "p"), rows)
    else:
        yield "errors correlate with no recorded quantity"
    worst = comparison.regions[0]
    yield (
        f"worst region: {worst.region}, "
        f"{format_fixed(worst.position_rms or worst.reading_rms, 1e6, 0)} um rms; "
        f"structure: {name_p_value(short_probability(comparison.structure.p_value))}"
    )
    for one in comparison.odd_samples[:MAX_PATTERNS]:
        at = format_fixed_vector(one.place, 1e3, 1)
        yield f"odd: sample {one.title} at {at} mm, {one.sigmas:.1f} sigmas"


def _worst_samples(comparison: Comparison) -> Table:
    data, errors = comparison.dataset, comparison.errors
    norms = {kind: errors.norms(kind) for kind in ERRORS}
    worst = comparison.worst_first[:MAX_SAMPLES]
    shown: dict[str, list[Number | str]] = {
        "sample": [str(number) for number in data.numbers[worst]],
    }
    if data.names:
        shown["name"] = [data.names.get(number, "-") for number in data.numbers[worst].tolist()]
    if data.has_time:
        shown["time [s]"] = [Number(t, 1, 1) for t in data.time[worst]]
    shown["at [mm]"] = [format_fixed_vector(place, 1e3, 1) for place in comparison.place[worst]]
    if np.isfinite(norms["position"]).any():
        shown["error [um]"] = [format_fixed_vector(e, 1e6, 0) for e in errors.position[worst]]
        shown["|error| [um]"] = [Number(e, 1e6, 0) for e in norms["position"][worst]]
    if np.isfinite(norms["orientation"]).any():
        shown["turned [arcmin]"] = [Number(e, 1 / ARCMIN) for e in norms["orientation"][worst]]
    if np.isfinite(norms["pixel"]).any():
        shown["corners [px]"] = [Number(e, 1.0, 2) for e in norms["pixel"][worst]]
    structure = comparison.model.structure
    for k in np.flatnonzero(structure.channel_units != "px"):
        channel, read = structure.channels[k], errors.reading[:, k]
        # The reading of an angle is an arc.
        shown[f"{channel} [um]"] = [Number(e, 1e6, 0) for e in read[worst]]
    return Table(tuple(shown), list(zip(*shown.values(), strict=True)))


def describe_verdict(diagnosis: Diagnosis) -> Judgement:
    """Describe the verdict, with what speaks against it and what else is to know."""
    verdict = diagnosis.verdict
    laws = [
        f"the effect {effect.name} was found in data; its physical cause is unknown"
        for effect in diagnosis.model.effects
        if effect.found_in_data
    ]
    remarks = (*verdict.against, *verdict.remarks, *laws)
    return Judgement(verdict.word, VERDICT_LABELS[verdict.word], verdict.summary, remarks)


def describe_diagnosis(diagnosis: Diagnosis) -> Iterator[Block]:
    """Describe the verdict, validation errors, the candidates, and what to measure next."""
    judged = {
        "held-out, as it is": diagnosis.base.fitted.held_out.summary,
        "held-out, with it": diagnosis.best.fitted.held_out.summary,
    }
    judgement = describe_verdict(diagnosis)
    yield from judgement.blocks()
    yield errors_table(judged, diagnosis.best.fitted.noise_floor, diagnosis.model)
    tested = [e for e in diagnosis.entries if e.candidate.testable][:MAX_CANDIDATES]
    likely = [e for e in tested if e.probable or e.name in diagnosis.effects]
    others = [entry for entry in tested if entry not in likely]
    if likely:
        yield candidate_table(diagnosis, likely)
    if others:
        yield Detail(candidate_table(diagnosis, others))
    yield from _describe_settings([entry.candidate for entry in likely])
    reasons = [
        f"{entry.name}: {entry.reason}"
        for entry in diagnosis.entries
        if entry.candidate.missing
        or (entry.reason and (entry in tested or entry.candidate.score is not None))
    ]
    for entry in tested:
        if entry.confused_with:
            words = f"{entry.name} is confused with {', '.join(entry.confused_with)}"
            yield words if entry.name in diagnosis.effects else Detail(words)
    more = max(len(judgement.remarks) - MAX_REMARKS, 0)
    hidden = [
        *([f"{more} more about the verdict"] if more else []),
        *([f"{len(others)} improbable effects"] if others else []),
        *(
            [f"{len(reasons)} remarks, such as what is missing to test an effect"]
            if reasons
            else []
        ),
    ]
    if hidden:
        yield f"--details lists {' and '.join(hidden)}"
    yield from map(Detail, reasons)
    excluded = {one.sample for one in diagnosis.knocked}  # the verdict and the next steps name them
    odd = [one for one in diagnosis.odd_samples if one.sample not in excluded]
    for one in odd[:MAX_CANDIDATES]:
        when = "" if math.isnan(one.time) else f"{one.time:.1f} s, "
        yield (
            f"{one.label}: sample {one.title} at {format_fixed_vector(one.place, 1e3, 1)} mm, "
            f"{when}{one.sigmas:.1f} sigmas, Cook's "
            f"distance {one.cooks_distance:.2f} (--data exclude={one.sample} excludes it)"
        )
    for advice in diagnosis.measure_next.advice:
        yield f"measure next: {advice}"
    if plan := diagnosis.measure_next.plan:
        yield f"{plan} (--json lists the poses)"


def _describe_settings(tested: Sequence[Candidate]) -> Iterator[str]:
    """Describe the fixed numbers that fit best, such as the lead of a screw: those of the effects
    found beside each other, and those of each other candidate alone."""
    for one in tested:
        for key, sigma in one.sigma.items():
            number = name_setting(key, one.settings)
            yield f"{one.name}: {number} {one.settings[key]:.4g} +- {sigma:.2g} fits best"


def describe_discovery(found: Discovery) -> Iterator[Block]:
    """Describe the verdict, each law with its parameters and validation errors, and advice."""
    yield f"{found.verdict}: {found.summary}"
    laws = [*found.laws, *found.suspected]
    for law in laws:
        judged = {"held-out, as it is": law.before, "held-out, with it": law.after}
        yield errors_table(judged, law.noise_floor, found.model)
        rows = [
            (c.name, f"{c.value:.4g}", "-" if c.sigma is None else f"{c.sigma:.2g}", c.unit)
            for c in law.parameters
        ]
        yield Table(("parameter", "value", "sigma", "unit"), rows)
    for advice in found.measure_next:
        yield f"measure next: {advice}"
