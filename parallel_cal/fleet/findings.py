"""Compare the robots of a fleet: their population, common effects, outliers, drifts and jumps."""

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

MIN_ROBOTS = 4  # fewer robots are not compared
MIN_DESIGN_SHARE = 0.5  # share of the robots above which an effect is the design's

T = TypeVar("T")
Recordings = Mapping[str, Sequence[Row]]  # the recordings of each robot, in order of time


@dataclass(frozen=True)
class Spread:
    """A parameter over the fleet, SI: `nominal` and `tolerance` of the drawing, `mean` and `spread`
    of the fleet.

    `sigma` is that of the mean; `low` and `high` are the ends of the spread's 95 % interval."""

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
    """A parameter by which a robot deviates from the others: how far, 1 sigma of the usual
    deviation, and the p-value (SI)."""

    robot: str
    name: str
    unit: str
    size: float
    sigma: float
    p_value: float


@dataclass(frozen=True)
class Drift:
    """A parameter of a robot that changes steadily with time (SI units per second)."""

    robot: str
    name: str
    unit: str
    rate: float
    sigma: float
    p_value: float


@dataclass(frozen=True)
class Change:
    """A robot whose recordings contradict each other: the parameter that changes most, and the
    recordings `before` and `after` the change (SI)."""

    robot: str
    name: str
    unit: str
    before: str
    after: str
    size: float
    sigma: float


@dataclass(frozen=True)
class EffectOfFleet:
    """An effect that some diagnoses named: in which robots, of how many, and its coefficients over
    all of them.

    `kind` is `design` (most robots have it, and the mean of its coefficients is not zero:
    `p_value`), `each` (most robots have it, each with different coefficients), `fault` (a fault of
    the robots whose coefficients deviate: `deviations`) or `doubtful` (named in some robots whose
    coefficients do not deviate).
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
    """Findings about the robots of one mechanism; `others` are robots of another mechanism.

    Only the last recording counts for a robot in `drifts` or `changed`."""

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
    """Compare the robots of a fleet with each other and with the drawing's model.

    None if there are fewer than four robots of the drawing's mechanism."""
    judged = [row for row in rows if not row["reason"]]
    own = sort_recordings(row for row in judged if row["mechanism"] == drawing.mechanism.name)
    robots = sorted(own)
    if len(robots) < MIN_ROBOTS:
        return None
    whole = {
        robot: [Evidence.from_document(row["evidence"]) for row in own[robot]] for robot in robots
    }
    names = {name for each in whole.values() for evidence in each for name in evidence.names}
    table = _select_parameters(drawing.mechanism.parameters, names)
    geometry = {robot: [_to_tolerances(e, table) for e in each] for robot, each in whole.items()}
    drifts, changed = _find_changes(own, geometry, table)
    for robot in (*(one.robot for one in drifts), *(one.robot for one in changed)):
        # Only its last recording describes the robot as it is now.
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
        effects=tuple(_find_effects(own, robots, drawing)),
        drifts=tuple(drifts),
        changed=tuple(changed),
    )


def _select_parameters(table: ParameterTable, names: Collection[str]) -> ParameterTable:
    return ParameterTable(p for p in table if p.name in names)


def _to_tolerances(evidence: Evidence, table: ParameterTable) -> Evidence:
    return evidence.recentre(table.names, table.nominal, table.tolerance)


def _combine_evidence(recordings: Sequence[Evidence], table: ParameterTable) -> Evidence:
    """Combine the evidence of all recordings of a robot."""
    return sum(recordings, Evidence.uninformative(table.names))


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


def _find_changes(
    own: Recordings, geometry: Mapping[str, Sequence[Evidence]], table: ParameterTable
) -> tuple[list[Drift], list[Change]]:
    """Find the robots that drift, and those whose recordings contradict each other."""
    trends: dict[str, Trend] = {}
    for robot, evidence in geometry.items():
        timed = [(e, t) for e, row in zip(evidence, own[robot], strict=True) if (t := row["time"])]
        if one := trend([e for e, _ in timed], [time for _, time in timed]):
            trends[robot] = one
    trends = _select_significant(trends, [one.p_value for one in trends.values()])
    alike = {robot: _find_comparable_recordings(own[robot]) for robot in geometry}
    jumps = _find_jumps({robot: [geometry[robot][k] for k in alike[robot]] for robot in geometry})
    for robot in set(trends) & set(jumps):  # keep the one that explains more
        del (trends if trends[robot].gain < jumps[robot].gain else jumps)[robot]
    drifts, changes = list[Drift](), list[Change]()
    for robot, drift in trends.items():
        p = table[drift.parameter]
        rate, sigma = p.tolerance * drift.rate, p.tolerance * drift.sigma
        drifts.append(Drift(robot, p.name, p.unit, rate, sigma, drift.p_value))
    for robot, change in jumps.items():
        p = table[change.parameter]
        size, sigma = p.tolerance * change.size, p.tolerance * change.sigma
        before, after = (
            own[robot][k]["recording"] for k in alike[robot][change.after : change.after + 2]
        )
        changes.append(Change(robot, p.name, p.unit, before, after, size, sigma))
    return drifts, changes


def _find_jumps(recordings: Mapping[str, Sequence[Evidence]]) -> dict[str, Jump]:
    """Find the robots whose recordings differ by more than chance, and by more than those of the
    other robots usually do: a model that lacks an effect makes all of them differ."""
    from scipy.stats import chi2

    found = {robot: one for robot, evidence in recordings.items() if (one := jump(evidence))}
    usual = np.median([one.between / one.dof for one in found.values()]) if found else 1.0
    scale = max(1.0, float(usual))
    return _select_significant(
        found, [chi2.sf(one.between / scale, one.dof) for one in found.values()]
    )


def _find_comparable_recordings(rows: Sequence[Row]) -> list[int]:
    """Return the numbers of the recordings in which the same effects were found: the most frequent
    set of effects, or the latest of several. Different effects change the geometry, too."""
    found = [frozenset(row["effects"]) for row in rows]
    most = max(reversed(found), key=found.count)
    return [k for k, effects in enumerate(found) if effects == most]


def _select_significant(found: dict[str, T], p_values: Sequence[float]) -> dict[str, T]:
    """Select the robots so that at most the share SIGNIFICANCE_LEVEL of them is there by chance."""
    from scipy.stats import false_discovery_control

    if not found:
        return {}
    named = false_discovery_control(p_values) < SIGNIFICANCE_LEVEL
    return {robot: one for (robot, one), real in zip(found.items(), named, strict=True) if real}


def _find_effects(own: Recordings, robots: list[str], drawing: Model) -> Iterator[EffectOfFleet]:
    """Yield the effects that diagnoses named, the most frequent first."""
    named: dict[str, list[str]] = {}
    for robot in robots:  # a robot has an effect if most of its recordings name it
        times = Counter(name for row in own[robot] for name in row["effects"])
        for name, n in sorted(times.items()):
            if n > len(own[robot]) / 2:
                named.setdefault(name, []).append(robot)
    for name, those in sorted(named.items(), key=lambda item: (-len(item[1]), item[0])):
        yield _classify_effect(name, those, own, robots, drawing)


def _classify_effect(
    name: str, those: list[str], own: Recordings, robots: list[str], drawing: Model
) -> EffectOfFleet:
    """Decide whether an effect belongs to the design or to single robots."""
    recorded = {
        robot: [e for row in own[robot] if (e := _get_effect_evidence(row, name))]
        for robot in robots
    }
    names = {number for each in recorded.values() for evidence in each for number in evidence.names}
    most = len(those) > MIN_DESIGN_SHARE * len(robots)
    try:
        table = _select_parameters(drawing.with_effect(name).table, names)
    except ModelError:  # an effect of a sensor that the drawing lacks
        table = ParameterTable(())
    if not len(table):
        return EffectOfFleet(name, "each" if most else "doubtful", tuple(those), len(robots))
    each = separate_outliers(
        [
            _combine_evidence([_to_tolerances(e, table) for e in one], table)
            for one in recorded.values()
        ],
        SIGNIFICANCE_LEVEL,
    )
    p = _compute_zero_mean_p_value(each.population, len(robots) - len(each.outlying))
    apart = tuple(d for d in _deviations(each, robots, table) if most or d.robot in those)
    if most:
        kind = "design" if p < SIGNIFICANCE_LEVEL else "each"
    else:
        kind = "fault" if apart else "doubtful"
    spreads = _spreads(each.population, table)
    return EffectOfFleet(name, kind, tuple(those), len(robots), p, spreads, apart)


def _get_effect_evidence(row: Row, name: str) -> Evidence | None:
    """Return a recording's evidence of an effect's coefficients, in its model or not; None if the
    recording cannot tell."""
    if name in row["effects"]:
        whole = Evidence.from_document(row["evidence"])
        return whole.marginalise(n for n in whole.names if n.startswith(f"{name}."))
    document = row["effects_evidence"].get(name)
    return Evidence.from_document(document) if document else None


def _compute_zero_mean_p_value(found: Population, robots: int) -> float:
    """Test whether the mean is zero (Hotelling's T^2, with the covariance of the mean)."""
    from scipy.stats import f

    n = len(found.mean)
    squares = float(found.mean @ np.linalg.solve(found.covariance, found.mean))
    dof = max(robots - n, 1)
    return float(f.sf(squares * dof / (n * max(robots - 1, 1)), n, dof))
