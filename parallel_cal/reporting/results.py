"""Describe results as blocks: one function for each kind of result, and for each of its parts."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from parallel_cal.base.arguments import describe_argument
from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.units import ARCMIN
from parallel_cal.diagnosis.verdict_words import VERDICT_LABELS
from parallel_cal.identification.acceptance import format_errors
from parallel_cal.identification.budget import Budget, Iso9283
from parallel_cal.identification.fit import FitResult, ParameterEstimate
from parallel_cal.identification.prediction_errors import ERRORS, Summary
from parallel_cal.model.model import Model
from parallel_cal.model.region import describe_workspace_excess
from parallel_cal.reporting.blocks import (
    MAX_REMARKS,
    Block,
    Cell,
    Column,
    Detail,
    Judgement,
    Number,
    PValue,
    Row,
    Table,
    Tile,
)
from parallel_cal.reporting.contents import DescribedParameter, HeldOutErrors, JudgedSample
from parallel_cal.reporting.contents import parameters as describe_parameters
from parallel_cal.reporting.figures import MAX_MOVED_TOLERANCES
from parallel_cal.reporting.images import describe_images
from parallel_cal.reporting.names import title_of
from parallel_cal.reporting.readable import (
    error_unit,
    format_fixed,
    format_fixed_vector,
    format_judged_errors,
    format_percent,
    is_known,
    name_p_value,
    number,
    percent,
    short_probability,
    unit_of,
    value_unit,
    vector,
    with_sigma,
)
from parallel_cal.reporting.summary import describe_result_errors

if TYPE_CHECKING:
    from parallel_cal.diagnosis.catalogue import Candidate
    from parallel_cal.diagnosis.comparison import Comparison
    from parallel_cal.diagnosis.diagnose import Diagnosis
    from parallel_cal.diagnosis.entries import Entry
    from parallel_cal.discovery.law import Discovery
    from parallel_cal.session.saving import ComparedModel
    from parallel_cal.session.steps import Step

# Limits on what one screen shows.
MAX_CANDIDATES = 8
MAX_SAMPLES = 5
MAX_PATTERNS = 5
MAX_ESTIMATES = 4  # parameters of an effect that are shown; gears have a dozen
PATTERN_SIGNIFICANCE_LEVEL = 0.05  # below it a terminal shows an effect or a pattern of the errors
# How a model and the samples of a figure are related.
IN_SAMPLE = "poses (not held out)"
UNUSED = "poses (no fit of this model used them)"
REGISTERED_TO = "poses (no fit of this model used them, except for the device's frame)"


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
    yield (
        f"{result.samples} samples, {estimate.spectrum.rank} of {result.free.sum()} free "
        f"parameters identified, chi2/dof {format_fixed(estimate.chi2_per_dof)}"
    )
    yield errors_table(judged, result.noise_floor, result.model)
    yield from describe_images(result)
    for budget in result.budgets[:1]:
        yield budget_table(budget)
        yield Detail(budget_sentence(budget))
    yield from map(Detail, map(iso_sentence, result.iso_9283[:1]))
    shown = select_shown_parameters(result.model, describe_parameters(result))
    yield Detail(parameter_table(shown), "parameters")


def saving_table(models: Sequence[ComparedModel]) -> Table:
    """Describe the models that a save compares, each with its errors at the same samples."""
    rows: list[Row] = []
    for one in models:
        shown = format_judged_errors(one.errors.document(), one.sigmas)
        effects = ", ".join(one.effects) or "none"
        rows.append((one.name, ", ".join(shown), one.where, str(one.samples), effects))
    return Table(("model", "rms error", "judged", "samples", "effects"), rows)


def budget_table(budget: Budget) -> Table:
    """Describe the error budget of the nominal model."""
    unit, factor = ascii_unit(budget.kind)
    shown = with_sigma(budget.total, budget.sigma, factor).replace("±", "+-")
    total = f"{budget.kind} error of the nominal model: {shown} {unit}"
    columns = (Column(total, "part"), "removes", "sigma", "moves the platform by", "unit")
    rows = [
        (
            part.name,
            Number(part.removed, factor, sigma=part.sigma),
            Number(part.sigma, factor, significant=2),
            Number(part.alone, factor, sigma=part.sigma),
            unit,
        )
        for part in budget.parts
    ]
    return Table(columns, rows)


def budget_sentence(budget: Budget) -> str:
    """Describe at which samples a budget was made, and what its numbers mean."""
    return (
        f"{describe_counts(budget.samples, budget.poses, budget.held_out)}. A part removes "
        "sqrt(a^2 - b^2), where a is the error of the model without this part and b the error of "
        "the whole model. Noise and rest remain. The last column is the motion of the measured "
        "point (the target)"
    )


def describe_counts(samples: int, poses: int, held_out: bool) -> str:
    """Say at which samples an error was taken: `94 samples of 74 held-out poses`."""
    return f"{samples} samples of {poses} {'held-out poses' if held_out else IN_SAMPLE}"


def iso_sentence(figures: Iso9283) -> str:
    """Describe the figures after ISO 9283, with their counts and the sides of approach."""
    unit, factor = ascii_unit(figures.kind)
    side = "from the same side" if figures.sides_known else "(sides of approach not recorded)"
    if figures.sides_from_order:
        side += " (sides taken from the order of the rows)"
    few = "only one pose was visited twice" if figures.visits else "no pose was visited twice"
    again = f"repeatability RP not known: {few} {side}"
    if figures.repeatability is not None:
        shown = with_sigma(figures.repeatability, figures.repeatability_sigma, factor)
        again = (
            f"repeatability RP {shown} {unit} of {figures.visits} visits to "
            f"{figures.repeated_poses} poses {side}"
        )
    mean = with_sigma(figures.accuracy_mean, figures.accuracy_sigma, factor)
    worst = number(figures.accuracy_max, factor)
    counts = describe_counts(figures.samples, figures.poses, figures.held_out)
    if figures.unused and not figures.held_out:
        counts = counts.replace(IN_SAMPLE, REGISTERED_TO if figures.frames_fitted else UNUSED)
    text = (
        f"after ISO 9283, {figures.kind}: accuracy AP {mean} {unit}, worst {worst}, at {counts}, "
        f"noise of the device included; {again}"
    )
    return text.replace("±", "+-")


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


def select_shown_parameters(
    model: Model, parameters: Mapping[str, DescribedParameter]
) -> dict[str, DescribedParameter]:
    """Select the free parameters, and the fixed ones that the owner gave or a search found."""
    given = find_given_parameters(model)
    return {name: p for name, p in parameters.items() if not p.fixed or name in given}


def errors_table(judged: Mapping[str, Summary], noise: Summary, model: Model) -> Table:
    """Describe mean and rms errors, one column each of before, after, ... (as table 5.15).

    The noise floor is one more column if the noise is known. A redundant closure adds the rms of
    its rows.
    """
    judged = {**judged, "noise floor": noise} if noise.is_known else dict(judged)
    joint_units = dict(zip(model.joints, model.mechanism.joint_units, strict=True))
    rows: list[Row] = []
    for kind in ("position", "orientation", "reading", "pixel", "joint"):
        winds = kind == "joint" and not model.mechanism.periodic  # winches turn many times
        name, factor = (value_unit if winds and "rad" in joint_units.values() else error_unit)(
            unit_of(kind, joint_units)
        )
        if any(e.mean(kind) is not None for e in judged.values()):
            for measure, get in (("mean", Summary.mean), ("rms", Summary.rms)):
                cells = [Number(get(e, kind), factor) for e in judged.values()]
                rows.append([f"{kind} error, {measure}", *cells, name.replace("µ", "u")])
    if model.structure.equations > len(model.mechanism.moved):
        cells = [Number(e.closure_rms, 1e6) for e in judged.values()]
        rows.append(["closure, rms of its rows", *cells, "um"])
    return Table(("", *judged, "unit"), rows)


def parameter_table(parameters: Mapping[str, DescribedParameter]) -> Table:
    """Describe parameters; a page adds how far they moved, the nominal values, the descriptions."""
    columns = (
        Column("parameter", "name"),
        Column("moved [tolerances]", "moved", on_terminal=False),
        "value",
        "from nominal",
        "sigma",
        Column("unit", in_html=False),
        Column("nominal", on_terminal=False),
        Column("description", on_terminal=False),
    )
    farthest = max((abs(p.moved_tolerances) for p in parameters.values()), default=0.0)
    rows = []
    for p in parameters.values():
        (unit, factor), moved = value_unit(p.unit), p.moved_tolerances
        nominal = float(f"{p.nominal * factor:.6g}")
        # Without a sigma, many digits tell where a value is, but not how far it moved.
        value, change, sigma = (
            Number(v, factor, 4, digits, p.sigma, unit)
            for v, digits in (
                (p.value, 6),
                (p.value - p.nominal, 3),
                (None if p.fixed else p.sigma, 2),
            )
        )
        words = p.words
        if p.fixed:
            words += f", fixed at {'its nominal' if p.value == p.nominal else 'this'} value"
        rows.append(
            (
                Cell(p.shown_name, mark="odd" if abs(moved) > MAX_MOVED_TOLERANCES else ""),
                Cell(Number(moved, significant=2), bar=moved / farthest if farthest else None),
                value,
                change,
                sigma,
                unit,
                Cell(f"{nominal:.6g} {unit}", key=nominal),
                words,
            )
        )
    return Table(columns, rows, "sortable")


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
    yield from _describe_settings(diagnosis, [entry.candidate for entry in likely])
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
    for one in diagnosis.odd_samples[:MAX_CANDIDATES]:
        when = "" if math.isnan(one.time) else f"{one.time:.1f} s, "
        yield (
            f"{one.label}: sample {one.title} at {format_fixed_vector(one.place, 1e3, 1)} mm, "
            f"{when}{one.sigmas:.1f} sigmas, Cook's "
            f"distance {one.cooks_distance:.2f} (--data exclude={one.sample} excludes it)"
        )
    for advice in diagnosis.measure_next.advice:
        yield f"measure next: {advice}"
    if plan := diagnosis.measure_next.plan:
        yield (
            f"{len(plan.poses)} planned poses (--json) would separate "
            f"{' from '.join(plan.separates)} "
            f"by {plan.sigmas.then:.1f} sigmas; the present samples do by {plan.sigmas.now:.1f}"
        )


def _describe_settings(diagnosis: Diagnosis, tested: Sequence[Candidate]) -> Iterator[str]:
    """Describe the fixed numbers that fit best, such as the lead of a screw: those of the effects
    found, with which the diagnosis proposes to add them, and those of the other candidates."""
    found = {one.name: one.settings for one in diagnosis.best.chosen}
    for one in tested:
        settings = found.pop(one.name, one.settings)
        for key, sigma in one.sigma.items():
            value, alone = (f"{numbers[key]:.4g}" for numbers in (settings, one.settings))
            if value == alone or len(diagnosis.best.chosen) == 1:
                yield f"{one.name}: {key} {value} +- {sigma:.2g} fits best"
            else:
                yield (
                    f"{one.name}: {key} {value} fits best beside the other effects found "
                    f"({alone} +- {sigma:.2g} without them)"
                )
    for name, settings in found.items():
        for key, setting in settings.items():
            yield f"{name}: {key} {setting:.4g} fits best beside the other effects found"


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


def law_table(found: Discovery) -> Table:
    """Describe the laws of a discovery, proven ones first, with those that are equally good."""
    columns = ("law", "or", "formula", "accounts for", "validation error", "tested at", "proven")
    rows: list[Row] = []
    for law in (*found.laws, *found.suspected):
        tested = [f"{name} {low:.3g} to {high:.3g}" for name, (low, high) in law.tested.items()]
        rows.append(
            (
                law.name,
                ", ".join(law.alternatives) or "-",
                law.formula,
                percent(law.share, missing="-"),
                format_errors(law.after, law.before),
                ", ".join(tested),
                f"no: {law.against}" if law.against else "yes",
            )
        )
    return Table(columns, rows, "evidence")


def candidate_table(diagnosis: Diagnosis, entries: Sequence[Entry]) -> Table:
    """Describe tested effects; a page adds their physics, estimates, objections and lookalikes."""
    errors, model = HeldOutErrors.of(diagnosis), diagnosis.model
    kind = next(iter(errors.kinds), "joint")
    joint_units = dict(zip(model.joints, model.mechanism.joint_units, strict=True))
    unit, factor = error_unit(unit_of(kind, joint_units))
    columns = (
        Column("rank", on_terminal=False),
        "effect",
        "probability",
        "held-out",
        Column(f"validation error, {kind} rms", "fall", on_terminal=False),
        "explains",
        "not geometry",
        Column("confused with", on_terminal=False),
    )
    rows = []
    for entry in entries:
        alone, effect = entry.alone, entry.candidate.effect
        found = entry.name in diagnosis.effects
        cure = f" At the machine: {effect.remedy}." if found and effect.remedy else ""
        apart = f"distinguished by {effect.separated_by}" if effect.separated_by else ""
        fall, estimates = "", ""
        if alone is not None:
            then, now = (number(e.rms(kind), factor) for e in (alone.before, alone.after))
            fall = f"{then} → {now} {unit}" if then != now else f"{now} {unit}, unchanged"
            estimates = _format_estimates(alone.parameters)
        rows.append(
            (
                str(entry.rank),
                Cell(entry.name, effect.physics + cure, mark="found" if found else ""),
                "-" if entry.probability is None else format_percent(entry.probability),
                percent(alone.ratio if alone else None, 1, "-"),
                Cell(fall or "-", estimates),
                percent(alone.share_explained if alone else None, missing="-"),
                percent(entry.remaining, missing="-"),
                Cell(
                    ", ".join(entry.confused_with), "; ".join(filter(None, (entry.reason, apart)))
                ),
            )
        )
    return Table(columns, rows, "evidence")


def _format_estimates(parameters: Mapping[str, ParameterEstimate]) -> str:
    """Format the parameters of an effect with their sigma, the most certain first."""
    free = [(name, p) for name, p in parameters.items() if not p.fixed]
    free.sort(key=lambda item: -abs(item[1].value) / (item[1].sigma or math.inf))
    words = []
    for name, p in free[:MAX_ESTIMATES]:
        unit, factor = ("mrad", 1e3) if p.unit == "rad" else value_unit(p.unit)
        words.append(
            f"{name} not identified"
            if p.sigma is None
            else f"{name} {with_sigma(p.value, p.sigma, factor)} {unit}".rstrip()
        )
    rest = len(free) - len(words)
    return ", ".join(words) + (f" and {rest} more" if rest else "")


def sample_table(
    samples: Sequence[JudgedSample], kinds: Collection[str], joint_units: Mapping[str, str]
) -> Table:
    """Describe samples with the errors of the present model, and with the effects found."""
    units = {kind: error_unit(unit_of(kind, joint_units)) for kind in kinds}
    both = bool(samples) and samples[0].found is not None
    sides = ("", ", with effect") if both else ("",)
    timed = any(is_known(one.time) for one in samples)
    is_any_odd = any(one.odd for one in samples)
    is_any_named = any(one.name for one in samples)
    joint_unit = ", ".join(dict.fromkeys(value_unit(unit)[0] for unit in joint_units.values()))
    columns = (
        "sample",
        *(["name"] if is_any_named else []),
        *(f"sigmas{side}" for side in sides),
        *(["odd"] if is_any_odd else []),
        *(f"{kind} [{unit}]{side}" for side in sides for kind, (unit, _) in units.items()),
        *(["time [s]"] if timed else []),
        f"joints [{joint_unit}]",
        "position [mm]",
    )
    rows: list[Row] = []
    for one in samples:
        errors = [side for side in (one.now, one.found) if side is not None]
        joints = [vector([q], u) for q, u in zip(one.joints, joint_units.values(), strict=True)]
        rows.append(
            (
                Cell(str(one.sample), key=one.sample, mark="odd" if one.odd else ""),
                *([one.name] if is_any_named else []),
                *(Number(side["sigmas"], significant=2) for side in errors),
                *([one.odd] if is_any_odd else []),
                *(Number(side[k], factor) for side in errors for k, (_, factor) in units.items()),
                *([Number(one.time, significant=4)] if timed else []),
                " ".join(joints),
                vector(one.position, "m"),
            )
        )
    return Table(columns, rows, "sortable", "sigmas")


def make_tile(
    name: str,
    errors: Summary,
    kinds: Collection[str],
    joint_units: Mapping[str, str],
    about: str = "validation error",
    mark: str = "",
    sigmas: Mapping[str, float] | None = None,
) -> Tile:
    """Make a tile in the units in which errors of each kind are shown; `sigmas` by kind is the
    standard deviation of its rms."""
    values = []
    for kind in kinds:
        unit, factor = error_unit(unit_of(kind, joint_units))
        shown = with_sigma(errors.rms(kind), (sigmas or {}).get(kind), factor)
        values.append((shown, unit, kind))
    return Tile(name, values, about, mark)


def error_tiles(
    errors: HeldOutErrors, effects: Sequence[str], joint_units: Mapping[str, str]
) -> Iterator[Tile]:
    """Describe the errors before, now and with the effects found, and the noise floor."""

    def tile(name: str, shown: Summary, sigmas: Mapping[str, float], mark: str = "") -> Tile:
        return make_tile(name, shown, errors.kinds, joint_units, mark=mark, sigmas=sigmas)

    yield tile(errors.before_name, errors.before, errors.sigmas["before"])
    yield tile("now", errors.now, errors.sigmas["now"])
    if errors.found:
        added = f"with {' and '.join(map(title_of, effects))} added"
        yield tile(added, errors.found, errors.sigmas["found"], "found")
    if errors.noise.is_known:
        yield tile("noise floor", errors.noise, errors.sigmas["noise"])
