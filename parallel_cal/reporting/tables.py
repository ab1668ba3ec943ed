"""Tables and sentences of results, which the screen, the report and the page share."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from parallel_cal.base.confidence import format_percent
from parallel_cal.identification.acceptance import format_errors
from parallel_cal.identification.budget import Budget, Iso9283
from parallel_cal.identification.fit import ParameterEstimate
from parallel_cal.identification.prediction_errors import Summary
from parallel_cal.model.model import Model
from parallel_cal.reporting.blocks import (
    Cell,
    Column,
    Number,
    Row,
    Table,
    Tile,
)
from parallel_cal.reporting.contents import DescribedParameter, HeldOutErrors, JudgedSample
from parallel_cal.reporting.figures import MAX_MOVED_TOLERANCES
from parallel_cal.reporting.names import title_of
from parallel_cal.reporting.readable import (
    error_unit,
    format_judged_errors,
    is_known,
    number,
    percent,
    unit_of,
    value_unit,
    vector,
    with_sigma,
)

if TYPE_CHECKING:
    from parallel_cal.diagnosis.entries import Entry
    from parallel_cal.diagnosis.result import Diagnosis
    from parallel_cal.discovery.law import Discovery
    from parallel_cal.session.saving import ComparedModel

MAX_ESTIMATES = 4  # parameters of an effect that are shown; gears have a dozen
# How a model and the samples of a figure are related.
IN_SAMPLE = "poses (not held out)"
UNUSED = "poses (no fit of this model used them)"
REGISTERED_TO = "poses (no fit of this model used them, except for the device's frame)"


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
