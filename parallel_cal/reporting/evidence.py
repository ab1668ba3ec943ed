"""Which effect is missing and how sure that is; what to measure to be surer."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from parallel_cal.diagnosis.entries import Entry, SingleEffectFit
from parallel_cal.diagnosis.separate import PlannedPose
from parallel_cal.diagnosis.signature import signature
from parallel_cal.diagnosis.thresholds import MAX_REFITTED_CANDIDATES
from parallel_cal.identification.fit import ParameterEstimate
from parallel_cal.reporting import signatures
from parallel_cal.reporting.markup import (
    Cell,
    Plot,
    folded,
    items,
    paragraph,
    sentence,
    table,
    tabs,
)
from parallel_cal.reporting.readable import (
    MISSING,
    error_unit,
    number,
    percent,
    probability,
    unit_of,
    value_unit,
    vector,
)
from parallel_cal.reporting.report import Report

ESTIMATES = 4  # numbers of an effect; gears have a dozen
PATTERNS = 4  # that are drawn


def candidates(report: Report, plot: Plot) -> str:
    """The catalogue, best first; below what these data cannot test, and why."""
    found = report.diagnosis
    tested = [entry for entry in found.entries if entry.p_adjusted is not None]
    rest = [(entry.name, entry.reason) for entry in found.entries if entry.p_adjusted is None]
    control = found.negative_control.random_group
    note = (
        "Effects are scored off the geometry; the best are refitted, where they are no chance by "
        "themselves; p for having looked at all of them. Negative control: random columns would "
        f"come out as number {control.rank} (p = {probability(control.p_value)})."
    )
    told = [f"{name} fits no better than {', '.join(o)}" for name, o in found.swaps.items()]
    told += [f"Against it: {text}" for text in found.verdict.against]
    first = [e for e in tested if e.name in found.effects or e.rank <= MAX_REFITTED_CANDIDATES]
    later = [e for e in tested if e not in first]
    shown = _tested(report, first) if first else paragraph("None could be tested.", "none")
    shown += _patterns(first, report, plot)
    if later:
        shown += folded(f"{len(later)} more were tested and fit no better", _tested(report, later))
    if rest:
        listed = table(("effect", "why not"), rest, "evidence")
        shown += folded(f"Not tested: {len(rest)}", listed)
    return paragraph(note, "note") + items(told) + shown


def _patterns(rows: Sequence[Entry], report: Report, plot: Plot) -> str:
    """The patterns of the first laid over the residuals, in turn."""
    mechanism, pages = report.diagnosis.model.mechanism, {}
    for entry in rows[:PATTERNS]:
        drawn = signature(entry.candidate)
        if drawn.panels:
            pages[entry.name] = plot(signatures.figure(drawn, mechanism))
    note = (
        "What each would leave, laid over the residuals of the model as it is: where the dashed "
        "line follows the blue one and both leave the band, the effect fits."
    )
    return paragraph(note, "note") + tabs(pages) if pages else ""


def _tested(report: Report, rows: Sequence[Entry]) -> str:
    kind = next(iter(report.errors.kinds), "joint")
    unit = unit_of(kind, report.provenance.joint_units)
    header = (
        "effect",
        "p (Holm)",
        f"left-out {kind} rms",
        "explains",
        "picked first",
        "not geometry",
        "cannot be told from",
    )
    found = report.diagnosis.effects
    return table(
        header, [_row(entry, kind, unit, entry.name in found) for entry in rows], "evidence"
    )


def _row(entry: Entry, kind: str, unit: str, found: bool) -> list[Cell]:
    alone, effect = entry.alone, entry.candidate.effect
    # What stands against it, and what would tell it from its lookalikes.
    apart = f"told apart by {effect.separated_by}" if effect.separated_by else ""
    cure = f" At the machine: {effect.remedy}." if found and effect.remedy else ""
    return [
        Cell(f"{entry.rank}. {entry.name}", effect.physics + cure, mark="found" if found else ""),
        Cell(probability(entry.p_adjusted)),
        Cell(_fall(alone, kind, unit), _estimates(alone.parameters)) if alone else Cell(MISSING),
        Cell(percent(alone.share_explained if alone else None)),
        Cell(percent(entry.first_picks)),
        Cell(percent(entry.remaining)),
        Cell(
            ", ".join(entry.confused_with) or MISSING,
            "; ".join(filter(None, (entry.reason, apart))),
        ),
    ]


def _fall(alone: SingleEffectFit, kind: str, unit: str) -> str:
    """`37.6 → 32.2 µm`."""
    name, factor = error_unit(unit)
    sides = (number(e.rms(kind), factor) for e in (alone.before, alone.after))
    return " → ".join(sides) + f" {name}"


def _estimates(parameters: Mapping[str, ParameterEstimate]) -> str:
    """The effect's own numbers with their sigma, the surest first."""
    free = [(name, p) for name, p in parameters.items() if not p.fixed]
    free.sort(key=lambda item: -abs(item[1].value) / (item[1].sigma or math.inf))
    words = [_estimate(name, p) for name, p in free[:ESTIMATES]]
    rest = len(free) - len(words)
    return ", ".join(words) + (f" and {rest} more" if rest else "")


def _estimate(name: str, p: ParameterEstimate) -> str:
    if p.sigma is None:
        return f"{name} not identified"
    unit, factor = ("mrad", 1e3) if p.unit == "rad" else value_unit(p.unit)
    return f"{name} {number(p.value, factor)} ± {number(p.sigma, factor, 2)} {unit}".rstrip()


def measure_next(report: Report) -> str:
    """Advice, conditions to record, and the planned poses."""
    following = report.diagnosis.measure_next
    told = [sentence(text) for text in following.advice]
    lacking: dict[str, list[str]] = {}
    for effect, conditions in following.record.items():
        lacking.setdefault(" and ".join(conditions), []).append(effect)
    told += [f"Record {what}, to test {', '.join(e)}." for what, e in lacking.items()]
    plan = following.plan
    if not plan:
        return items(told) or paragraph("Nothing is left to be told apart.", "none")
    now, then = (number(sigmas, 1.0, 2) for sigmas in (plan.sigmas.now, plan.sigmas.then))
    words = (
        f"{len(plan.poses)} planned poses would tell {' from '.join(plan.separates)} by "
        f"{then} sigmas; the data so far do by {now}."
    )
    return items(told) + paragraph(words) + _poses(plan.poses, report.provenance.joint_units)


def _poses(poses: Sequence[PlannedPose], units: Mapping[str, str]) -> str:
    """The poses to measure, each under its circumstances."""
    joints = [f"{name} [{value_unit(unit)[0]}]" for name, unit in units.items()]
    stops = ["past it [mm]", "and back to [mm]"] if poses[0].by_way_of else []
    conditions = list(poses[0].conditions)
    rows = [
        [
            str(i),
            *(vector(stop.position, "m") for stop in pose.by_way_of),
            vector(pose.position, "m"),
            vector(pose.quaternion, "", 5),
            *(vector([q], u) for q, u in zip(pose.joints, units.values(), strict=True)),
            *(f"{pose.conditions[c]:.3g}" for c in conditions),
        ]
        for i, pose in enumerate(poses, 1)
    ]
    return table(["", *stops, "x y z [mm]", "quaternion x y z w", *joints, *conditions], rows)
