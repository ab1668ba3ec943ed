"""A fleet as a terminal shows it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator

from parallel_cal.fleet.findings import Change, EffectOfFleet, Findings
from parallel_cal.fleet.fleet import Fleet
from parallel_cal.fleet.rows import ERRORS
from parallel_cal.reporting.readable import ARCMIN, columns, format_fixed, in_unit

UNITS = {"position": ("um", 1e6), "reading": ("um", 1e6), "orientation": ("arcmin", ARCMIN)}
DAY = 86400.0
# recordings that a person reads
MAX_WORST_RECORDINGS = 10
MAX_NAMED_ROBOTS = 5
MAX_FAULT_SHARE = 0.25  # of the robots: more are nobody's own fault


def format_fleet(fleet: Fleet) -> str:
    """Verdicts, the worst recordings, and those that failed."""
    return "\n".join([*_verdicts(fleet), *_worst(fleet), *_format_findings(fleet), *_failed(fleet)])


def _verdicts(fleet: Fleet) -> Iterator[str]:
    robots = {row["robot"] for row in fleet.rows}
    yield f"{len(robots)} robots, {len(fleet.rows)} recordings, {len(fleet.failed)} failed"
    if fleet.judged:
        yield verdicts_in_words(fleet)


def verdicts_in_words(fleet: Fleet) -> str:
    """How many recordings have each verdict."""
    verdicts = Counter(row["verdict"] for row in fleet.judged)
    return ", ".join(f"{word}: {n}" for word, n in verdicts.most_common()) or "nothing was judged"


def kind_of(fleet: Fleet) -> str | None:
    """What a fleet's errors are given in: positions, where they were measured."""
    return next(
        (kind for kind in UNITS if any(row["after"][f"{kind}_rms"] for row in fleet.judged)), None
    )


def _worst(fleet: Fleet) -> Iterator[str]:
    """Those with the largest error that is left."""
    kind = kind_of(fleet)
    if kind is None:
        return
    (unit, factor), key = UNITS[kind], f"{kind}_rms"
    worst = sorted(fleet.judged, key=lambda row: -(row["after"][key] or 0.0))[:MAX_WORST_RECORDINGS]
    header = ("robot", "recording", f"{kind} error [{unit}]", "identified", "with effects")
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
    """What only many robots tell."""
    found = fleet.findings
    if found is None:
        yield "fewer than four robots: nothing is said of them together"
        return
    for robot in found.others:
        yield f"{robot}: of another kind than the others, which are {found.mechanism}"
    yield from together_in_words(found, _with_sigma)
    header = ("parameter", "drawing's mean", "fleet's", "sigma", "drawing's spread", "fleet's")
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
    """Whose each effect is, who stands apart, who changes; values, sigmas and units as `told`."""
    yield from map(effect_in_words, found.effects)
    for one in found.outlying:
        yield f"{one.robot}: {one.name} is off by {told(one.size, one.sigma, one.unit)}"
    for drift in found.drifts:
        rate = told(DAY * drift.rate, DAY * drift.sigma, drift.unit)
        yield f"{drift.robot}: {drift.name} changes by {rate} a day"
    for change in found.changed:
        yield change_in_words(change, told(change.size, change.sigma, change.unit))


def change_in_words(one: Change, size: str) -> str:
    """What of a robot's recordings contradicts each other, and what follows."""
    return (
        f"{one.robot}: its recordings contradict each other, most in {one.name}: by {size} from "
        f"{one.before} to {one.after}; only the last one counts"
    )


def effect_in_words(effect: EffectOfFleet) -> str:
    """Whose an effect is."""
    apart = dict.fromkeys(one.robot for one in effect.deviations)
    robots = list(apart) if effect.kind == "fault" else list(effect.robots)
    few = ", ".join(robots[:MAX_NAMED_ROBOTS]) + (", ..." if len(robots) > MAX_NAMED_ROBOTS else "")
    share = f"{len(effect.robots)} of {effect.of} robots"
    alike = "whose numbers do not stand apart from the others'"
    if len(robots) > effect.of * MAX_FAULT_SHARE:
        alike = f"{share}: too many for one robot's fault, too few for the design's; a batch's?"
    said = {
        "design": f"in {share}, and in all alike: the design's or the workshop's",
        "each": f"in {share}, though not proven to be of one size and sign in all",
        "fault": f"of {few}: {'its' if len(robots) == 1 else 'their'} own fault",
        "doubtful": f"named in {few}, {alike}",
    }[effect.kind]
    return f"{effect.name}: {said}"


def _with_sigma(value: float, sigma: float, unit: str) -> str:
    number, name = in_unit(value, unit)
    return f"{number} +- {in_unit(sigma, unit)[0]} {name}"


def _failed(fleet: Fleet) -> Iterator[str]:
    for row in fleet.failed:
        yield f"failed: {row['robot']} {row['recording']}: {row['reason']}"
