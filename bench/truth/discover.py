"""The study of `discover`: laws of nobody's catalogue drawn by seed, and sessions without any law.

Robots, sessions, laws and noise come from the independent virtual robots. The laws are drawn from
physics, not from the terms that the search knows (test/helpers/virtual_laws.py). The families are:

- `laws`: each kind of law on a Delta, a hexapod and an arm,
- `catalogue`: each effect of the catalogue, with the effect and its lookalikes taken out of it;
  `pose` are those that depend on the pose alone, `larger` those that a larger model describes,
- `null`: white noise,
- `noise`: correlated noise, noise that grows outwards, noise twice as large as stated,
- `quantised`: readings and positions in steps of three standard deviations,
- `outliers`, and `payload`, which is recorded one change late,
- `device`: errors of the measuring device, which the robot must not learn.

With `--results` every outcome is kept as a line of a file; a case that stands there already is not
run again. `--page` only writes the table of docs/discover.md from docs/discover_study.jsonl, to
which such lines are added. Usage: `python -m bench.truth.discover [--draws N] [--first SEED]
[--jobs N] [--scheduler ADDRESS] [--results FILE] [--minutes M] [--page] [FAMILY ...]`.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import catalogue_sessions as cs
import law_sessions as ls
import numpy as np
import virtual_blind as vb

from bench.truth import blind
from parallel_cal.base.errors import ParallelCalError
from parallel_cal.discovery.discovery import discover
from parallel_cal.discovery.law import Discovery
from parallel_cal.fleet.cluster import cluster, run_each
from parallel_cal.identification.fit import fit
from parallel_cal.model.model import new_model
from parallel_cal.session.steps import add

ROOT = Path(__file__).resolve().parents[2]
PAGE, STUDY = ROOT / "docs" / "discover.md", ROOT / "docs" / "discover_study.jsonl"
START, END = "<!-- study: written by bench/truth/discover.py --page -->", "<!-- end of study -->"
SHOWN = {  # family -> its sessions in words, and what is counted in words
    "catalogue": (
        "a hidden effect of the catalogue; it and its lookalikes were removed from the catalogue",
        {"place": "place right", "driver": "driver right", "as good": "error at most 1.25 times"},
    ),
    "pose": (
        "an effect that depends on the pose alone, as an error of a device does, hidden",
        {"said": "verdict `robot_or_device`, or place and driver right"},
    ),
    "larger": (
        "unequal parallelograms hidden from the model that has equal ones",
        {"larger": "the larger model asked for"},
    ),
    "laws": (
        "a hidden law that is in no catalogue",
        {
            "place": "place right",
            "driver": "driver right",
            "worse": "true error larger than without the law",
        },
    ),
    "null": ("white noise, no law", {"law": "a law found"}),
    "noise": ("noise that is not as stated, no law", {"law": "a law found"}),
    "quantised": ("readings and positions in coarse steps, no law", {"law": "a law found"}),
    "outliers": ("outliers, no law", {"law": "a law found"}),
    "payload": ("payload recorded late, no law", {"law": "a law found"}),
    "device": ("an error of the device", {"learned": "learned by the robot"}),
}
# The first seed of the sessions that the present version searched, and those of families that the
# last change does not concern.
FIRST_SEED = 6000
FIRST_SEEDS = {"pose": 5000, "larger": 5000}
MAX_ERROR_RATIO = 1.25  # of the true error with a found law to that with the true effect
CLEARLY = 1.1  # of the true error before: its own uncertainty at 60 poses
STEP = 3.0  # sigmas, of readings that are quantised
SIGMAS = (1.0, 2.0)  # of the residual that the geometry leaves of a law
GOALS = {  # family -> what is counted, and the share that it must (not) reach
    "laws": (("place", ">=", 0.85), ("driver", ">=", 0.85), ("worse", "<=", 0.0)),
    "catalogue": (("place", ">=", 0.95), ("driver", ">=", 0.9), ("as good", ">=", 0.9)),
    "pose": (("said", ">=", 0.9),),
    "larger": (("larger", ">=", 0.9),),
    "null": (("law", "<=", 0.01),),
    "noise": (("law", "<=", 0.02),),
    "quantised": (("law", "<=", 0.02),),
    "outliers": (("law", "<=", 0.02),),
    "payload": (("law", "<=", 0.02),),
    "device": (("learned", "<=", 0.0),),
}


@dataclass(frozen=True)
class Case:
    """One session: what hides in it, on which robot, by how many sigmas."""

    family: str
    seed: int
    kind: str = ""
    robot: str = "delta"
    sigmas: float = 0.0


@dataclass(frozen=True)
class Outcome:
    """What was found, and the true error (m, rms) of the robot without it, with it, and with the
    hidden effect of the catalogue; NaN where nothing was hidden."""

    case: Case
    verdict: str
    laws: tuple[str, ...]
    of_robot: tuple[str, ...]  # those that the robot would learn
    place: bool = False
    driver: bool = False
    before: float = math.nan
    after: float = math.nan
    error: str = ""
    seconds: float = 0.0  # of the processor
    with_effect: float = math.nan
    # Residuals at held-out poses with the laws if each fold chooses their forms itself, over those
    # with forms that all poses chose: above 1 where the choice was too good to be true.
    optimism: float = math.nan
    needs_larger_model: bool = False

    @property
    def as_good(self) -> bool:
        """Whether the found law is nearly as good for the robot as the true effect."""
        return self.after <= MAX_ERROR_RATIO * self.with_effect

    @property
    def worse(self) -> bool:
        return self.after > CLEARLY * self.before + 1e-6


def families(draws: int, first: int) -> dict[str, Callable[[], Iterator[Case]]]:
    def seeds(n: int) -> range:
        return range(first, first + n)

    def laws() -> Iterator[Case]:
        for s in seeds(draws):
            for name, robot in ls.ROBOTS.items():
                for kind in robot.kinds:
                    yield Case("laws", s, kind.__name__, name, SIGMAS[s % len(SIGMAS)])

    def hidden(family: str, names: Iterable[str]) -> Iterator[Case]:
        for s in seeds(draws):
            for name in names:
                machine = cs.EFFECTS[name].machine
                yield Case(family, s, name, machine, SIGMAS[s % len(SIGMAS)])

    def catalogue() -> Iterator[Case]:
        others = {*cs.OF_POSE_ALONE, *cs.OF_LARGER_MODEL}
        return hidden("catalogue", [name for name in cs.EFFECTS if name not in others])

    def pose() -> Iterator[Case]:
        return hidden("pose", cs.OF_POSE_ALONE)

    def larger() -> Iterator[Case]:
        return hidden("larger", cs.OF_LARGER_MODEL)

    def null() -> Iterator[Case]:
        yield from (Case("null", s) for s in seeds(10 * draws))

    def noise() -> Iterator[Case]:
        for kind in vb.NOISE:
            yield from (Case("noise", s, kind) for s in seeds(3 * draws))

    def quantised() -> Iterator[Case]:
        yield from (Case("quantised", s) for s in seeds(3 * draws))

    def outliers() -> Iterator[Case]:
        yield from (Case("outliers", s) for s in seeds(3 * draws))

    def payload() -> Iterator[Case]:
        yield from (Case("payload", s) for s in seeds(3 * draws))

    def device() -> Iterator[Case]:
        for kind in vb.DEVICE:
            yield from (Case("device", s, kind, sigmas=1.5) for s in seeds(3 * draws))

    some = (catalogue, pose, larger, laws, null, noise, quantised, outliers, payload, device)
    return {f.__name__: f for f in some}


def without_law(case: Case) -> Any:
    """A session of the Delta without a law of the robot."""
    if case.family in ("noise", "device"):
        named = {"noise": {"noise": case.kind}, "device": {"device": case.kind}}[case.family]
        drawn = blind.Case(case.family, case.seed, size=case.sigmas, **named)
        day, effects, noise = blind.session(drawn)
        return blind.measured(drawn, day, effects, noise)
    robot, rng = ls.ROBOTS[case.robot], np.random.default_rng([case.seed, 8])
    data = ls.measured(robot, robot.day(case.seed), [], robot.noise, case.seed)
    if case.family == "quantised":
        q_step, r_step = STEP * robot.noise.joint, STEP * robot.noise.position
        q, r = (step * np.round(own / step) for own, step in ((data.q, q_step), (data.r, r_step)))
        return replace(data, q=q, r=r)
    if case.family == "outliers":
        some = rng.choice(len(data), 5, replace=False)
        r = data.r.copy()
        r[some] += 10 * robot.noise.position * rng.standard_normal((5, 3))
        return replace(data, r=r)
    if case.family == "payload":  # the notes of the loads are one change late
        wrong = np.roll(data.conditions["payload"], 25)
        return replace(data, conditions=data.conditions | {"payload": wrong})
    return data


def run(case: Case) -> Outcome:
    begin = time.process_time()
    try:
        found = outcome(case)
    except ParallelCalError as error:
        found = Outcome(case, "error", (), (), error=str(error))
    return replace(found, seconds=round(time.process_time() - begin, 2))


def find_hidden_effect(case: Case) -> Outcome:
    """The outcome of a session that hides an effect of the catalogue."""
    machine = cs.MACHINES[case.robot]
    effect = cs.draw_effect(case.kind, case.seed, case.sigmas)
    data = cs.measure(machine, effect, case.seed)
    with cs.without_effects(cs.list_lookalikes(case.kind)):
        found = discover(machine.model(), data)
    models = (
        fit(machine.model(), data, hold_out=0).model,
        found.described,
        add(machine.model(), case.kind, data, force=True).model,
    )
    before, after, with_effect = (
        cs.compute_true_error(case.kind, model, effect, case.seed) for model in models
    )
    place, driver = cs.is_named(found.laws, case.kind, machine.model().joints)
    return Outcome(
        case,
        found.verdict,
        tuple(law.name for law in found.laws),
        tuple(law.name for law in found.laws if not law.of_device),
        place,
        driver,
        before,
        after,
        with_effect=with_effect,
        optimism=compute_optimism(found),
        needs_larger_model=found.needs_larger_model,
    )


def compute_optimism(found: Discovery) -> float:
    """How much larger residuals at held-out poses are if each fold chooses the forms itself."""
    ratios = [law.choice.ratio_anew / law.choice.ratio for law in found.laws]
    return float(np.prod(ratios)) if ratios else math.nan


def outcome(case: Case) -> Outcome:
    if case.family in ("catalogue", "pose", "larger"):
        return find_hidden_effect(case)
    if case.family != "laws":
        found = discover(new_model("delta54"), without_law(case))
        robots = tuple(law.name for law in found.laws if not law.of_device)
        return Outcome(case, found.verdict, tuple(law.name for law in found.laws), robots)
    robot = ls.ROBOTS[case.robot]
    kind = next(k for k in robot.kinds if k.__name__ == case.kind)
    data, hidden, effect = ls.hiding(case.robot, kind, case.seed, case.sigmas)
    found = discover(robot.model(), data)
    plain = fit(robot.model(), data, hold_out=0).model
    end = float(data.time.max())
    before, after = (
        ls.compute_true_error(case.robot, model, effect, case.seed, end)
        for model in (plain, found.described)
    )
    names = tuple(law.name for law in found.laws)
    place, driver = ls.is_named(found.laws, hidden)
    optimism = compute_optimism(found)
    return Outcome(
        case, found.verdict, names, names, place, driver, before, after, optimism=optimism
    )


def report(outcomes: list[Outcome]) -> None:
    """A row for each kind of case, then counts with their exact intervals, and the goals."""
    groups: dict[str, list[Outcome]] = {}
    for one in outcomes:
        c = one.case
        groups.setdefault(f"{c.family} {c.robot} {c.kind}".strip(), []).append(one)
    for name, some in groups.items():
        before, after = (
            1e6 * np.median([getattr(o, k) for o in some]) for k in ("before", "after")
        )
        print(
            f"{name}: {len(some)} sessions, place {sum(o.place for o in some)}, driver "
            f"{sum(o.driver for o in some)}, with a law {sum(bool(o.laws) for o in some)}, true "
            f"error {before:.1f} -> {after:.1f} um"
        )
        for o in some:
            hidden = o.case.family in ("laws", "catalogue", "pose", "larger")
            if o.error or hidden != (o.place and o.driver and bool(o.laws)):
                print(f"    seed {o.case.seed}: {o.verdict}; {', '.join(o.laws)} {o.error[:120]}")
    for family in dict.fromkeys(o.case.family for o in outcomes):
        some = [o for o in outcomes if o.case.family == family]
        counts = count(some)
        told = [f"{name} {k} ({blind.interval(k, len(some))})" for name, k in counts.items()]
        seconds = np.mean([o.seconds for o in some])
        print(f"{family}, {len(some)}: {', '.join(told)}; {seconds:.1f} s a session")
        for name, sign, goal in GOALS[family]:
            share = counts[name] / len(some)
            reached = share >= goal if sign == ">=" else share <= goal
            print(f"    goal: {name} {sign} {goal:.0%}: {'reached' if reached else 'MISSED'}")


def count(some: list[Outcome]) -> dict[str, int]:
    return {
        "place": sum(o.place for o in some),
        "driver": sum(o.driver for o in some),
        "law": sum(bool(o.laws) for o in some),
        "learned": sum(bool(o.of_robot) for o in some),
        "worse": sum(o.worse for o in some),
        "as good": sum(o.as_good for o in some),
        "said": sum(o.verdict == "robot_or_device" or (o.place and o.driver) for o in some),
        "larger": sum(o.needs_larger_model for o in some),
        "error": sum(bool(o.error) for o in some),
    }


def is_present(case: Case) -> bool:
    """Whether the present version searched a session."""
    return case.seed >= FIRST_SEEDS.get(case.family, FIRST_SEED)


def make_table(outcomes: list[Outcome]) -> str:
    """The table of the page: counts with their exact intervals, by family, of the present version
    and of earlier ones; then the effects that were hidden in no session of the present one."""
    rows = [
        "| sessions | what | this version | share, 95 % interval | earlier versions |",
        "|---|---|--:|---|--:|",
    ]
    present = [o for o in outcomes if is_present(o.case)]
    for family, (sessions, counted) in SHOWN.items():
        now = [o for o in present if o.case.family == family]
        before = [o for o in outcomes if o.case.family == family and not is_present(o.case)]
        for name, words in counted.items():
            shown = [
                f"{count(some)[name]} of {len(some)}" if some else "-" for some in (now, before)
            ]
            share = blind.interval(count(now)[name], len(now)) if now else "-"
            share = share.replace("..", " to ")
            rows.append(f"| {sessions} | {words} | {shown[0]} | {share} | {shown[1]} |")
    missing = ", ".join(sorted({*cs.EFFECTS} - {o.case.kind for o in present}))
    note = f"\n\nThis version was not tested with: {missing}." if missing else ""
    return "\n".join(rows) + note


def kept(file: Path | None) -> dict[Case, Outcome]:
    """The outcomes that a file of earlier slices holds."""
    if file is None or not file.exists():
        return {}
    rows = [json.loads(line) for line in file.read_text().splitlines()]
    outcomes = [
        Outcome(
            **row
            | {
                "case": Case(**row["case"]),
                "laws": tuple(row["laws"]),
                "of_robot": tuple(row["of_robot"]),
            }
        )
        for row in rows
    ]
    return {one.case: one for one in outcomes}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--draws", type=int, default=5)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--jobs", type=int, default=1, help="processes on this machine")
    parser.add_argument("--scheduler", help="a Dask cluster's address, in place of this machine")
    parser.add_argument("--results", type=Path)
    parser.add_argument("--minutes", type=float, default=math.inf)
    parser.add_argument("family", nargs="*")
    parser.add_argument("--page", action="store_true", help="write the page from kept outcomes")
    given = parser.parse_args()
    if given.page:
        return blind.put_between(PAGE, START, END, make_table([*kept(STUDY).values()]))
    all_of = families(given.draws, given.first)
    if unknown := [name for name in given.family if name not in all_of]:
        parser.error(f"{', '.join(unknown)}: expected some of {', '.join(all_of)}")
    cases = [case for name in given.family or all_of for case in all_of[name]()]
    outcomes = {c: o for c, o in kept(given.results).items() if c in set(cases)}
    until = time.monotonic() + 60 * given.minutes
    with cluster(given.scheduler, given.jobs) as client:
        left = [(case,) for case in cases if case not in outcomes]
        for _, one in run_each(client, run, left):
            outcomes[one.case] = one
            if given.results is not None:
                with given.results.open("a") as lines:
                    lines.write(json.dumps(asdict(one)) + "\n")
            if time.monotonic() > until:
                break
    report([outcomes[case] for case in cases if case in outcomes])


if __name__ == "__main__":
    main()
