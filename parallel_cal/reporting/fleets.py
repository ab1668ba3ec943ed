"""The results of a fleet as text."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator

from parallel_cal.base.units import ERROR_UNITS
from parallel_cal.fleet.findings import Change, EffectOfFleet, Findings
from parallel_cal.fleet.fleet import Fleet
from parallel_cal.fleet.rows import ERRORS
from parallel_cal.reporting.readable import columns, format_fixed, in_unit

ERROR_KINDS = ("position", "reading", "orientation")  # the first that was measured is shown
DAY = 86400.0
MAX_WORST_RECORDINGS = 10  # recordings that are listed
MAX_NAMED_ROBOTS = 5
MAX_FAULT_SHARE = 0.25  # share of the robots above which an effect is no fault of single robots


def format_fleet(fleet: Fleet) -> str:
    """Format the verdicts, the worst recordings, the findings and the failures."""
    robots = {row["robot"] for row in fleet.rows}
    return "\n".join(
        [
            f"{len(robots)} robots, {len(fleet.rows)} recordings, {len(fleet.failed)} failed",
            *([verdicts_in_words(fleet)] if fleet.judged else []),
            *_worst(fleet),
            *_format_findings(fleet),
            *(
                f"failed: {row['robot']} {row['recording']}: {row['reason']}"
                for row in fleet.failed
            ),
        ]
    )


def verdicts_in_words(fleet: Fleet, name: Callable[[str], str] = str) -> str:
    """Count the recordings with each verdict; `name` translates the word of a verdict."""
    verdicts = Counter(name(row["verdict"]) for row in fleet.judged)
    return (
        ", ".join(f"{word}: {n}" for word, n in verdicts.most_common()) or "no recording was judged"
    )


def kind_of(fleet: Fleet) -> str | None:
    """Return the kind of error of the fleet: position if it was measured."""
    return next(
        (kind for kind in ERROR_KINDS if any(row["after"][f"{kind}_rms"] for row in fleet.judged)),
        None,
    )


def _worst(fleet: Fleet) -> Iterator[str]:
    """List the recordings with the largest remaining error."""
    kind = kind_of(fleet)
    if kind is None:
        return
    (unit, factor), key = ERROR_UNITS[kind], f"{kind}_rms"
    worst = sorted(fleet.judged, key=lambda row: -(row["after"][key] or 0.0))[:MAX_WORST_RECORDINGS]
    header = ("robot", "recording", f"{kind} error [{unit}]", "fitted", "with effects")
    yield columns(
        (*header, "effects"),
        [
            (
                row["robot"],
                row["recording"],
                *(format_fixed(row[when][key], factor, 1) for when in ERRORS),
                ", ".join(row["effects"]),
            )
            for row in worst
        ],
    )


def _format_findings(fleet: Fleet) -> Iterator[str]:
    """Format the findings that need many robots."""
    found = fleet.findings
    if found is None:
        yield "fewer than four robots: no findings on the fleet as a whole"
        return
    for robot in found.others:
        yield f"{robot}: another mechanism than the other robots ({found.mechanism})"
    yield from together_in_words(found, _with_sigma)
    header = ("parameter", "nominal", "fleet mean", "sigma", "tolerance", "fleet spread")
    rows = [
        (
            one.name,
            *(in_unit(v, one.unit)[0] for v in (one.nominal, one.mean, one.sigma, one.tolerance)),
            *in_unit(one.spread, one.unit)[:1],
            f"{in_unit(one.low, one.unit)[0]}..{in_unit(one.high, one.unit)[0]}",
            in_unit(0.0, one.unit)[1],
        )
        for one in found.parameters
    ]
    yield columns((*header, "95 %", "unit"), rows)


def together_in_words(found: Findings, told: Callable[[float, float, str], str]) -> Iterator[str]:
    """Describe the effects, the outliers and the changes; `told` formats value, sigma and unit."""
    yield from map(effect_in_words, found.effects)
    for one in found.outlying:
        yield (
            f"{one.robot}: {one.name} is an outlier: it deviates by "
            f"{told(one.size, one.sigma, one.unit)}"
        )
    for drift in found.drifts:
        rate = told(DAY * drift.rate, DAY * drift.sigma, drift.unit)
        yield f"{drift.robot}: {drift.name} drifts by {rate} per day"
    for change in found.changed:
        yield change_in_words(change, told(change.size, change.sigma, change.unit))


def change_in_words(one: Change, size: str) -> str:
    """Describe a contradiction between recordings of a robot and its consequence."""
    return (
        f"{one.robot}: its recordings contradict each other, most in {one.name}, by {size} "
        f"between {one.before} and {one.after}; only the last recording is used"
    )


def effect_in_words(effect: EffectOfFleet) -> str:
    """Describe how many robots have an effect, and the likely origin."""
    apart = dict.fromkeys(one.robot for one in effect.deviations)
    robots = list(apart) if effect.kind == "fault" else list(effect.robots)
    few = ", ".join(robots[:MAX_NAMED_ROBOTS]) + (", ..." if len(robots) > MAX_NAMED_ROBOTS else "")
    share = f"{len(effect.robots)} of {effect.of} robots"
    doubt = f"found in {few}, but its parameters are no outliers there"
    if len(robots) > effect.of * MAX_FAULT_SHARE:
        doubt = (
            f"found in {share} ({few}): neither a single fault nor the whole design; check what "
            "these robots share (batch, supplier, date)"
        )
    faulty = "this robot" if len(robots) == 1 else "these robots"
    description = {
        "design": f"in {share}, with similar parameters: caused by the design or the workshop",
        "each": f"in {share}, but not proven to have one size and sign in all",
        "fault": f"only in {few}: a fault of {faulty}",
        "doubtful": doubt,
    }[effect.kind]
    return f"{effect.name}: {description}"


def _with_sigma(value: float, sigma: float, unit: str) -> str:
    number, name = in_unit(value, unit)
    return f"{number} +- {in_unit(sigma, unit)[0]} {name}"
