"""Which effect is missing and how sure that is; what to measure to be surer."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from parallel_cal.reporting.markup import Cell, Document, items, paragraph, sentence, table
from parallel_cal.reporting.readable import (
    MISSING,
    large,
    number,
    percent,
    probability,
    shown_kinds,
    small,
    unit_of,
    vector,
)

ESTIMATES = 4  # numbers of an effect; gears have a dozen


def candidates(document: Document) -> str:
    """The catalogue, best first; below what these data cannot test, and why."""
    found = document["diagnosis"]
    tested = [c for c in found["candidates"] if c["p_adjusted"] is not None]
    rest = [(c["effect"], c["reason"]) for c in found["candidates"] if c["p_adjusted"] is None]
    control = found["negative_control"]["random_group"]
    note = (
        "Effects are scored off the geometry and the best refitted; p for having looked at all of "
        f"them. Negative control: random columns would come out as number {control['rank']} "
        f"(p = {probability(control['p_value'])})."
    )
    told = [f"{name} fits no better than {', '.join(o)}" for name, o in found["swaps"].items()]
    told += [f"Against it: {text}" for text in found["against"]]
    shown = _tested(document, tested) if tested else paragraph("None could be tested.", "none")
    untested = f"<h3>Not tested</h3>{table(('effect', 'why not'), rest, 'evidence')}"
    return paragraph(note, "note") + items(told) + shown + (untested if rest else "")


def _tested(document: Document, rows: Sequence[Mapping[str, Any]]) -> str:
    kind = next(iter(shown_kinds(document["errors"])), "joint")
    unit = unit_of(kind, document["provenance"]["joint_units"])
    header = (
        "effect", "p (Holm)", f"left-out {kind} rms", "explains", "picked first", "not geometry",
        "cannot be told from",
    )  # fmt: skip
    found = document["diagnosis"]["effects"]
    return table(header, [_row(c, kind, unit, c["effect"] in found) for c in rows], "evidence")


def _row(c: Mapping[str, Any], kind: str, unit: str, found: bool) -> list[Cell]:
    return [
        Cell(f"{c['rank']}. {c['effect']}", c["physics"], mark="found" if found else ""),
        Cell(probability(c["p_adjusted"])),
        Cell(_fall(c, kind, unit), _estimates(c["parameters"])),
        Cell(percent(c["share_explained"])),
        Cell(percent(c["first_picks"])),
        Cell(percent(c["remaining_after_geometry"])),
        Cell(", ".join(c["confused_with"]) or MISSING, _remarks(c)),
    ]


def _remarks(c: Mapping[str, Any]) -> str:
    """What stands against a candidate, and what would tell it from its lookalikes."""
    apart = f"told apart by {c['separated_by']}" if c["separated_by"] else ""
    return "; ".join(filter(None, (c["reason"], apart)))


def _fall(c: Mapping[str, Any], kind: str, unit: str) -> str:
    """`37.6 to 32.2 um`, where the candidate was refitted."""
    sides = (c["holdout_before"], c["holdout_after"])
    if None in sides:
        return MISSING
    name, factor = small(unit)
    return " → ".join(number(e[f"{kind}_rms"], factor) for e in sides) + f" {name}"


def _estimates(parameters: Mapping[str, Any]) -> str:
    """The effect's own numbers with their sigma, the surest first."""
    free = [(name, p) for name, p in parameters.items() if not p["fixed"]]
    free.sort(key=lambda item: -abs(item[1]["value"]) / (item[1]["sigma"] or math.inf))
    words = [_estimate(name, p) for name, p in free[:ESTIMATES]]
    rest = len(free) - len(words)
    return ", ".join(words) + (f" and {rest} more" if rest else "")


def _estimate(name: str, p: Mapping[str, Any]) -> str:
    if p["sigma"] is None:
        return f"{name} not identified"
    unit, factor = ("mrad", 1e3) if p["unit"] == "rad" else large(p["unit"])
    return f"{name} {number(p['value'], factor)} ± {number(p['sigma'], factor, 2)} {unit}".rstrip()


def measure_next(document: Document) -> str:
    """Advice, conditions to record, and the planned poses."""
    following = document["diagnosis"]["measure_next"]
    told = [sentence(text) for text in following["advice"]]
    lacking: dict[str, list[str]] = {}
    for effect, conditions in following["record"].items():
        lacking.setdefault(" and ".join(conditions), []).append(effect)
    told += [f"Record {what}, to test {', '.join(e)}." for what, e in lacking.items()]
    plan = following["plan"]
    if not plan:
        return items(told) or paragraph("Nothing is left to be told apart.", "none")
    now, then = (number(plan["sigmas"][key], 1.0, 2) for key in ("now", "then"))
    words = (
        f"{len(plan['poses'])} planned poses would tell {' from '.join(plan['separates'])} by "
        f"{then} sigmas; the data so far do by {now}."
    )
    return items(told) + paragraph(words) + _poses(plan["poses"], document["provenance"])


def _poses(poses: Sequence[Mapping[str, Any]], provenance: Mapping[str, Any]) -> str:
    """The poses to measure, each under its circumstances."""
    units = provenance["joint_units"]
    joints = [f"{name} [{large(unit)[0]}]" for name, unit in units.items()]
    conditions = list(poses[0]["conditions"])
    rows = [
        [
            str(i), vector(pose["position"], "m"), vector(pose["quaternion"], "", 5),
            *(vector([q], u) for q, u in zip(pose["joints"], units.values(), strict=True)),
            *(f"{pose['conditions'][c]:.3g}" for c in conditions),
        ]
        for i, pose in enumerate(poses, 1)
    ]  # fmt: skip
    return table(["", "x y z [mm]", "quaternion x y z w", *joints, *conditions], rows)
