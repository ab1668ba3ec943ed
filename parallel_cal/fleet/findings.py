"""What only many robots can tell: the population, what all have, what one has, who changes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from parallel_cal.base.confidence import CHANCE
from parallel_cal.base.errors import ModelError
from parallel_cal.fleet.drift import Trend, trend
from parallel_cal.fleet.judging import Row
from parallel_cal.fleet.population import Population, Sorted, sorted_out
from parallel_cal.identification.evidence import Evidence
from parallel_cal.model.model import Model
from parallel_cal.model.parameters import ParameterTable

LEAST = 4  # robots of which anything common is said
MOST = 0.5  # share of the robots: an effect that more of them have is the design's


@dataclass(frozen=True)
class Spread:
    """A parameter over the fleet, SI: the drawing's and the fleet's own figures, with 1 sigma of
    the mean and the ends of the spread's 95 % interval."""

    name: str
    unit: str
    nominal: float
    tolerance: float
    mean: float
    sigma: float
    spread: float
    low: float
    high: float


@dataclass(frozen=True)
class Deviation:
    """A robot's parameter apart from the others': by how much, and 1 sigma of what is usual."""

    robot: str
    name: str
    unit: str
    size: float
    sigma: float
    p_value: float


@dataclass(frozen=True)
class Drift:
    """A parameter of a robot that grows with time (SI a second)."""

    robot: str
    name: str
    unit: str
    rate: float
    sigma: float
    p_value: float


@dataclass(frozen=True)
class EffectOfFleet:
    """An effect that some diagnosis named: in which robots, and its numbers over all of them.

    `kind` is `design` (most have it, and its numbers' mean is not zero: `p_value`), `each` (most
    have it, in each another), `fault` (of the robots whose numbers stand apart: `deviations`) or
    `doubtful` (named in a few that do not).
    """

    name: str
    kind: str
    robots: tuple[str, ...]
    of: int
    p_value: float | None = None
    numbers: tuple[Spread, ...] = ()
    deviations: tuple[Deviation, ...] = ()


@dataclass(frozen=True)
class Findings:
    """Judged from the rows of a fleet's one kind of robot; `others` are of another mechanism."""

    robots: tuple[str, ...]
    mechanism: str
    others: tuple[str, ...]
    parameters: tuple[Spread, ...]
    outlying: tuple[Deviation, ...]
    effects: tuple[EffectOfFleet, ...]
    drifts: tuple[Drift, ...]


def findings(rows: Sequence[Row], drawing: Model) -> Findings | None:
    """What the rows say together, beside the drawing's model; None of fewer than four robots."""
    judged = [row for row in rows if not row["reason"]]
    own = [row for row in judged if row["mechanism"] == drawing.mechanism.name]
    robots = sorted({row["robot"] for row in own})
    if len(robots) < LEAST:
        return None
    told = [(row, Evidence.from_document(row["evidence"])) for row in own]
    shown = {name for _, evidence in told for name in evidence.names}
    table = _of(drawing.mechanism.parameters, shown)
    geometry = [(row, _in_tolerances(evidence, table)) for row, evidence in told]
    each = sorted_out(_together(geometry, robots, table), CHANCE)
    return Findings(
        robots=tuple(robots),
        mechanism=drawing.mechanism.name,
        others=tuple(sorted({row["robot"] for row in judged} - set(robots))),
        parameters=_spreads(each.population, table),
        outlying=_deviations(each, robots, table),
        effects=tuple(_effects(own, robots, drawing)),
        drifts=_drifts(geometry, robots, table),
    )


def _of(table: ParameterTable, names: Collection[str]) -> ParameterTable:
    return ParameterTable(p for p in table if p.name in names)


def _in_tolerances(evidence: Evidence, table: ParameterTable) -> Evidence:
    return evidence.about(table.names, table.nominal, table.tolerance)


def _together(
    told: Sequence[tuple[Row, Evidence]], robots: list[str], table: ParameterTable
) -> list[Evidence]:
    """What all the recordings of each robot say."""
    each = {robot: Evidence.nothing(table.names) for robot in robots}
    for row, evidence in told:
        each[row["robot"]] += evidence
    return list(each.values())


def _spreads(found: Population, table: ParameterTable) -> tuple[Spread, ...]:
    away, sigma = found.mean * table.tolerance, found.sigma * table.tolerance
    rows = zip(table, away, sigma, found.spread, found.low, found.high, strict=True)
    return tuple(
        Spread(
            p.name, p.unit, p.nominal, p.tolerance, float(p.nominal + mean), float(own),
            *(float(p.tolerance * value) for value in spreads),
        )
        for p, mean, own, *spreads in rows
    )  # fmt: skip


def _deviations(each: Sorted, robots: list[str], table: ParameterTable) -> tuple[Deviation, ...]:
    return tuple(
        Deviation(
            robots[i], (p := table[one.parameter]).name, p.unit, p.tolerance * one.size,
            p.tolerance * one.sigma, one.p_value,
        )
        for i, aways in each.outlying.items()
        for one in aways
    )  # fmt: skip


def _drifts(
    told: Sequence[tuple[Row, Evidence]], robots: list[str], table: ParameterTable
) -> tuple[Drift, ...]:
    """Of those named no more than the share CHANCE is there by chance."""
    from scipy.stats import false_discovery_control

    found: dict[str, Trend] = {}
    for robot in robots:
        own = [(e, row["time"]) for row, e in told if row["robot"] == robot and row["time"]]
        if one := trend([e for e, _ in own], [time for _, time in own]):
            found[robot] = one
    if not found:
        return ()
    named = false_discovery_control([one.p_value for one in found.values()]) < CHANCE
    return tuple(
        Drift(
            robot, (p := table[one.parameter]).name, p.unit, p.tolerance * one.rate,
            p.tolerance * one.sigma, one.p_value,
        )
        for (robot, one), drifts in zip(found.items(), named, strict=True)
        if drifts
    )  # fmt: skip


def _effects(rows: Sequence[Row], robots: list[str], drawing: Model) -> Iterator[EffectOfFleet]:
    """Those that a diagnosis named, the most frequent first."""
    recordings = Counter(row["robot"] for row in rows)
    times = Counter((name, row["robot"]) for row in rows for name in row["effects"])
    named: dict[str, list[str]] = {}
    for (name, robot), n in sorted(times.items()):
        if n > recordings[robot] / 2:
            named.setdefault(name, []).append(robot)
    for name, those in sorted(named.items(), key=lambda item: -len(item[1])):
        yield _effect(name, those, rows, robots, drawing)


def _effect(
    name: str, those: list[str], rows: Sequence[Row], robots: list[str], drawing: Model
) -> EffectOfFleet:
    """Whether it is the design's or that of the robots which have it."""
    told = [(row, evidence) for row in rows if (evidence := _of_effect(row, name))]
    shown = {number for _, evidence in told for number in evidence.names}
    most = len(those) > MOST * len(robots)
    try:
        table = _of(drawing.with_effect(name).table, shown)
    except ModelError:  # a sensor's, that the drawing has not
        table = ParameterTable(())
    if not len(table):
        return EffectOfFleet(name, "each" if most else "doubtful", tuple(those), len(robots))
    known = [(row, _in_tolerances(evidence, table)) for row, evidence in told]
    each = sorted_out(_together(known, robots, table), CHANCE)
    p = _is_zero(each.population, len(robots) - len(each.outlying))
    apart = tuple(d for d in _deviations(each, robots, table) if most or d.robot in those)
    kind = ("design" if p < CHANCE else "each") if most else "fault" if apart else "doubtful"
    spreads = _spreads(each.population, table)
    return EffectOfFleet(name, kind, tuple(those), len(robots), p, spreads, apart)


def _of_effect(row: Row, name: str) -> Evidence | None:
    """What a recording says of an effect's numbers, whether they are in its model or not."""
    if name in row["effects"]:
        whole = Evidence.from_document(row["evidence"])
        return whole.only(n for n in whole.names if n.startswith(f"{name}."))
    document = row["effects_evidence"].get(name)
    return Evidence.from_document(document) if document else None


def _is_zero(found: Population, robots: int) -> float:
    """The p-value of a mean that is zero (Hotelling's test, the covariance being the mean's)."""
    from scipy.stats import f

    n = len(found.mean)
    squares = float(found.mean @ np.linalg.solve(found.covariance, found.mean))
    dof = max(robots - n, 1)
    return float(f.sf(squares * dof / (n * max(robots - 1, 1)), n, dof))
