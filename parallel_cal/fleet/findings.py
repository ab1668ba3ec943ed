"""What only many robots can tell: the population, what all have, what one has, who changes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from parallel_cal.base.confidence import SIGNIFICANCE_LEVEL
from parallel_cal.base.errors import ModelError
from parallel_cal.base.threads import single_threaded
from parallel_cal.fleet.drift import Jump, Trend, jump, trend
from parallel_cal.fleet.judging import Row, sort_recordings
from parallel_cal.fleet.population import Population, SeparatedPopulation, separate_outliers
from parallel_cal.identification.evidence import Evidence
from parallel_cal.model.model import Model
from parallel_cal.model.parameters import ParameterTable

MIN_ROBOTS = 4  # robots of which anything common is said
MIN_DESIGN_SHARE = 0.5  # share of the robots: an effect that more of them have is the design's

T = TypeVar("T")
Recordings = Mapping[str, Sequence[Row]]  # of each robot, from the first to the last


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
class Change:
    """A robot whose recordings contradict each other: the parameter that changes most between two
    of them."""

    robot: str
    name: str
    unit: str
    before: str
    after: str
    size: float
    sigma: float


@dataclass(frozen=True)
class EffectOfFleet:
    """An effect that some diagnosis named: in which robots, and its numbers over all of them.

    `kind` is `design` (most have it, and its numbers' mean is not zero: `p_value`), `each` (most
    have it, in each another), `fault` (of the robots whose numbers stand apart: `deviations`) or
    `doubtful` (named in some that do not).
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
    """Judged from the rows of a fleet's one kind of robot; `others` are of another mechanism. Of a
    robot that drifted or `changed`, only the last recording counts."""

    robots: tuple[str, ...]
    mechanism: str
    others: tuple[str, ...]
    parameters: tuple[Spread, ...]
    outlying: tuple[Deviation, ...]
    effects: tuple[EffectOfFleet, ...]
    drifts: tuple[Drift, ...]
    changed: tuple[Change, ...]


@single_threaded()
def findings(rows: Sequence[Row], drawing: Model) -> Findings | None:
    """What the rows say together, beside the drawing's model; None of fewer than four robots."""
    judged = [row for row in rows if not row["reason"]]
    own = sort_recordings(row for row in judged if row["mechanism"] == drawing.mechanism.name)
    robots = sorted(own)
    if len(robots) < MIN_ROBOTS:
        return None
    told = {
        robot: [Evidence.from_document(row["evidence"]) for row in own[robot]] for robot in robots
    }
    shown = {name for each in told.values() for evidence in each for name in evidence.names}
    table = _select_parameters(drawing.mechanism.parameters, shown)
    geometry = {robot: [_to_tolerances(e, table) for e in each] for robot, each in told.items()}
    alike = {robot: _find_comparable_recordings(own[robot]) for robot in robots}
    trends = _trends(geometry, own)
    jumps = _jumps({robot: [geometry[robot][k] for k in some] for robot, some in alike.items()})
    for robot in set(trends) & set(jumps):  # whichever explains more
        del (trends if trends[robot].gain < jumps[robot].gain else jumps)[robot]
    drifts = tuple(_drift(robot, one, table) for robot, one in trends.items())
    changed = tuple(
        _change([own[robot][k] for k in alike[robot]], one, table) for robot, one in jumps.items()
    )
    for robot in {*trends, *jumps}:  # as it is now
        own[robot], geometry[robot] = own[robot][-1:], geometry[robot][-1:]
    each = separate_outliers(
        [_combine_evidence(one, table) for one in geometry.values()], SIGNIFICANCE_LEVEL
    )
    return Findings(
        robots=tuple(robots),
        mechanism=drawing.mechanism.name,
        others=tuple(sorted({row["robot"] for row in judged} - set(robots))),
        parameters=_spreads(each.population, table),
        outlying=_deviations(each, robots, table),
        effects=tuple(_effects(own, robots, drawing)),
        drifts=drifts,
        changed=changed,
    )


def _select_parameters(table: ParameterTable, names: Collection[str]) -> ParameterTable:
    return ParameterTable(p for p in table if p.name in names)


def _to_tolerances(evidence: Evidence, table: ParameterTable) -> Evidence:
    return evidence.recentre(table.names, table.nominal, table.tolerance)


def _combine_evidence(told: Sequence[Evidence], table: ParameterTable) -> Evidence:
    """What all the recordings of a robot say."""
    return sum(told, Evidence.uninformative(table.names))


def _spreads(found: Population, table: ParameterTable) -> tuple[Spread, ...]:
    away, sigma = found.mean * table.tolerance, found.sigma * table.tolerance
    rows = zip(table, away, sigma, found.spread, found.low, found.high, strict=True)
    return tuple(
        Spread(
            p.name,
            p.unit,
            p.nominal,
            p.tolerance,
            float(p.nominal + mean),
            float(own),
            *(float(p.tolerance * value) for value in spreads),
        )
        for p, mean, own, *spreads in rows
    )


def _deviations(
    each: SeparatedPopulation, robots: list[str], table: ParameterTable
) -> tuple[Deviation, ...]:
    return tuple(
        Deviation(
            robots[i],
            (p := table[one.parameter]).name,
            p.unit,
            p.tolerance * one.size,
            p.tolerance * one.sigma,
            one.p_value,
        )
        for i, aways in each.outlying.items()
        for one in aways
    )


def _trends(told: Mapping[str, Sequence[Evidence]], own: Recordings) -> dict[str, Trend]:
    """Of robots that drift."""
    found: dict[str, Trend] = {}
    for robot, evidence in told.items():
        timed = [(e, t) for e, row in zip(evidence, own[robot], strict=True) if (t := row["time"])]
        if one := trend([e for e, _ in timed], [time for _, time in timed]):
            found[robot] = one
    return _select_significant(found, [one.p_value for one in found.values()])


def _jumps(told: Mapping[str, Sequence[Evidence]]) -> dict[str, Jump]:
    """Of robots whose recordings differ by more than chance, and than those of the others usually
    do: a model that lacks something makes them differ, too."""
    from scipy.stats import chi2

    found = {robot: one for robot, evidence in told.items() if (one := jump(evidence))}
    usual = np.median([one.between / one.dof for one in found.values()]) if found else 1.0
    scale = max(1.0, float(usual))
    return _select_significant(
        found, [chi2.sf(one.between / scale, one.dof) for one in found.values()]
    )


def _find_comparable_recordings(rows: Sequence[Row]) -> list[int]:
    """Numbers of the recordings in which the same effects were found: lengths of other models
    differ by these. The most there are, or the latest."""
    found = [frozenset(row["effects"]) for row in rows]
    most = max(reversed(found), key=found.count)
    return [k for k, effects in enumerate(found) if effects == most]


def _select_significant(found: dict[str, T], p_values: Sequence[float]) -> dict[str, T]:
    """Of these no more than the share CHANCE is there by chance."""
    from scipy.stats import false_discovery_control

    if not found:
        return {}
    named = false_discovery_control(p_values) < SIGNIFICANCE_LEVEL
    return {robot: one for (robot, one), real in zip(found.items(), named, strict=True) if real}


def _drift(robot: str, one: Trend, table: ParameterTable) -> Drift:
    p = table[one.parameter]
    rate, sigma = p.tolerance * one.rate, p.tolerance * one.sigma
    return Drift(robot, p.name, p.unit, rate, sigma, one.p_value)


def _change(rows: Sequence[Row], one: Jump, table: ParameterTable) -> Change:
    p, (before, after) = table[one.parameter], rows[one.after : one.after + 2]
    size, sigma = p.tolerance * one.size, p.tolerance * one.sigma
    return Change(
        before["robot"], p.name, p.unit, before["recording"], after["recording"], size, sigma
    )


def _effects(own: Recordings, robots: list[str], drawing: Model) -> Iterator[EffectOfFleet]:
    """Those that a diagnosis named, the most frequent first."""
    named: dict[str, list[str]] = {}
    for robot in robots:
        times = Counter(name for row in own[robot] for name in row["effects"])
        for name, n in sorted(times.items()):
            if n > len(own[robot]) / 2:
                named.setdefault(name, []).append(robot)
    for name, those in sorted(named.items(), key=lambda item: (-len(item[1]), item[0])):
        yield _effect(name, those, own, robots, drawing)


def _effect(
    name: str, those: list[str], own: Recordings, robots: list[str], drawing: Model
) -> EffectOfFleet:
    """Whether it is the design's or that of the robots which have it."""
    told = {
        robot: [e for row in own[robot] if (e := _get_effect_evidence(row, name))]
        for robot in robots
    }
    shown = {number for each in told.values() for evidence in each for number in evidence.names}
    most = len(those) > MIN_DESIGN_SHARE * len(robots)
    try:
        table = _select_parameters(drawing.with_effect(name).table, shown)
    except ModelError:  # a sensor's, that the drawing has not
        table = ParameterTable(())
    if not len(table):
        return EffectOfFleet(name, "each" if most else "doubtful", tuple(those), len(robots))
    each = separate_outliers(
        [
            _combine_evidence([_to_tolerances(e, table) for e in one], table)
            for one in told.values()
        ],
        SIGNIFICANCE_LEVEL,
    )
    p = _compute_zero_mean_p_value(each.population, len(robots) - len(each.outlying))
    apart = tuple(d for d in _deviations(each, robots, table) if most or d.robot in those)
    kind = (
        ("design" if p < SIGNIFICANCE_LEVEL else "each")
        if most
        else "fault"
        if apart
        else "doubtful"
    )
    spreads = _spreads(each.population, table)
    return EffectOfFleet(name, kind, tuple(those), len(robots), p, spreads, apart)


def _get_effect_evidence(row: Row, name: str) -> Evidence | None:
    """What a recording says of an effect's numbers, whether they are in its model or not."""
    if name in row["effects"]:
        whole = Evidence.from_document(row["evidence"])
        return whole.marginalise(n for n in whole.names if n.startswith(f"{name}."))
    document = row["effects_evidence"].get(name)
    return Evidence.from_document(document) if document else None


def _compute_zero_mean_p_value(found: Population, robots: int) -> float:
    """The p-value of a mean that is zero (Hotelling's test, the covariance being the mean's)."""
    from scipy.stats import f

    n = len(found.mean)
    squares = float(found.mean @ np.linalg.solve(found.covariance, found.mean))
    dof = max(robots - n, 1)
    return float(f.sf(squares * dof / (n * max(robots - 1, 1)), n, dof))
