"""The blind study: data sets drawn by seed, the tool called as a user calls it, judged by truth.

Robots, sessions, physics and noise come from the independent virtual robots. A case is `fit`,
`diagnose`, and, where it names something, `add` on the command line; the truth is the error of
the served robot at poses that nobody measured, before and after. With `--results` every outcome is
kept as a line of a file, and a case that stands there already is not run again: a long study can
be made in slices (`--minutes`). `--page` only writes the table of docs/validation.md
from docs/blind_study.jsonl, to which such lines are added. Usage: `python -m
bench.truth.blind [--draws N] [--first SEED] [--jobs N] [--see WHAT,WHAT] [--results FILE]
[--minutes M] [--page] [FAMILY ...]`; WHAT is pose, position, orientation, plane or ball_bar.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import math
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import findings
import numpy as np
import virtual_blind as vb
import virtual_findings as vf
from printers import PRINTERS

from parallel_cal.base.files import write_atomically
from parallel_cal.fleet.cluster import cluster, run_each
from parallel_cal.virtual import robot as vr

ROOT = Path(__file__).resolve().parents[2]
PAGE, STUDY = ROOT / "docs" / "validation.md", ROOT / "docs" / "blind_study.jsonl"
START, END = "<!-- study: written by bench/truth/blind.py --page -->", "<!-- end of study -->"
HIDDEN = {  # family -> what the page calls it, and what it counts as correct
    "null": ("nothing", "no effect named"),
    "single": ("one effect of 0.4, 0.8 or 2 sigmas", "named, and nothing else"),
    "pairs": ("two effects of 0.8 sigmas", "both named, and nothing else"),
    "outside": ("physics outside the catalogue", "not `explained`"),
    "device": ("a measuring device with errors", "the robot not worse"),
    "noise": (
        "noise larger than stated, correlated, or growing",
        "this noise reported, no effect named",
    ),
    "printers": ("errors of five delta printers", "the hidden error named, and nothing else"),
}
MEASURED = {
    "pose": "poses",
    "position": "positions",
    "orientation": "orientations",
    "plane": "touches on a plane",
    "ball_bar": "a ball-bar",
    "touches": "touches of the bed",
}

CLEARLY = 1.1  # of the true error before: its own uncertainty at 80 poses
SEES = {
    "pose": "111111",
    "position": "111000",
    "orientation": "000111",
    "plane": "000000",
    "ball_bar": "000000",
}
CENTRE = np.array([0.02, -0.01, 0.05])  # of the ball-bar's fixed ball (m): under the workspace
HEIGHT = 0.2  # of the plate that a gauge stands on (m)
HARMLESS = (("robot worse", "<=", 0.0), ("contradicted", "<=", 0.0))
GOALS = {  # family -> what is counted, and the share that it must (not) reach
    "null": (("named", "<=", 0.01), *HARMLESS),
    "single": (("right", ">=", 0.98), *HARMLESS),
    "pairs": (("right", ">=", 0.98), *HARMLESS),
    "outside": (("explained", "<=", 0.02), *HARMLESS),
    "device": HARMLESS,
    "noise": (("right", ">=", 0.9), *HARMLESS),
    "printers": (("right", ">=", 0.98), *HARMLESS),
}


@dataclass(frozen=True)
class Case:
    """One data set: who hides, how large (sigmas of the residual), what the device sees."""

    family: str
    seed: int
    kinds: tuple[str, ...] = ()
    size: float = 0.0
    device: str = ""
    noise: str = ""
    sees: str = "pose"


@dataclass(frozen=True)
class Outcome:
    """What the tool said, and the true error (m, rms) of the robot without and with it."""

    case: Case
    verdict: str
    named: tuple[str, ...]
    before: float
    after: float
    error: str = ""
    summary: str = ""
    seconds: float = 0.0  # of the processor
    uncertain: float = 0.0  # m, rms: what the served model says of its own positions
    against: tuple[str, ...] = ()  # why `diagnose` itself advises against what it names

    @property
    def contradicted(self) -> bool:
        """Whether `add` refused what `diagnose` named without a word against it."""
        return self.verdict != "error" and bool(self.error) and not self.against

    @property
    def worse(self) -> bool:
        """Whether the served robot errs more than before, by more than chance, a micrometre, and
        the uncertainty of its model: that of one number a pose leaves much open."""
        return self.after > self.before + max((CLEARLY - 1) * self.before, self.uncertain) + 1e-6

    @property
    def right(self) -> bool:
        """Whether everything hidden was named, alone or in an `A or B`, and nothing else.

        Noise that is not as stated is to be called so; of what is no effect of the robot none may
        be called the whole explanation, nor make the robot worse.
        """
        if self.verdict == "error":
            return False
        if self.case.device:
            whole = self.verdict == "explained" and not {*self.named} <= vb.OF_DEVICE
            return not whole and not self.worse
        if self.case.noise and vb.CALLED[self.case.noise] not in self.summary:
            return False
        if self.case.family == "printers":
            wanted = [{name} for name in PRINTERS[self.case.kinds[0]].names]
        else:
            wanted = [set(vf.KINDS[k].names) for k in self.case.kinds]
        called = [set(name.split(" or ")) for name in self.named]
        return len(called) == len(wanted) and all(any(w & c for c in called) for w in wanted)


def families(draws: int, first: int = 0) -> dict[str, Callable[[str], Iterator[Case]]]:
    """Name -> the cases of a family, for what the device sees; seeds from `first` on."""

    def seeds(n: int) -> range:
        return range(first, first + n)

    def null(sees: str) -> Iterator[Case]:
        yield from (Case("null", s, sees=sees) for s in seeds(10 * draws))

    def single(sees: str) -> Iterator[Case]:
        for kind in vf.KINDS:
            for size in (0.4, 0.8, 2.0):
                yield from (Case("single", s, (kind,), size, sees=sees) for s in seeds(draws))

    def pairs(sees: str) -> Iterator[Case]:
        for pair in combinations(vf.KINDS, 2):
            yield from (Case("pairs", s, pair, 0.8, sees=sees) for s in seeds(max(draws // 3, 1)))

    def outside(sees: str) -> Iterator[Case]:
        for name in vf.OUTSIDE:
            yield from (Case("outside", s, (), 1.5, name, sees=sees) for s in seeds(draws))

    def device(sees: str) -> Iterator[Case]:
        for name in vb.DEVICE:
            yield from (Case("device", s, (), 1.5, name, sees=sees) for s in seeds(draws))

    def noise(sees: str) -> Iterator[Case]:
        for name in vb.NOISE:
            yield from (Case("noise", s, noise=name, sees=sees) for s in seeds(draws))

    def printers(sees: str) -> Iterator[Case]:
        for name in PRINTERS:
            yield from (Case("printers", s, (name,), sees="touches") for s in seeds(draws))

    return {f.__name__: f for f in (null, single, pairs, outside, device, noise, printers)}


def session(case: Case) -> tuple[Any, list[vr.Effect], vr.Noise]:
    """The day, what hides, and the instruments; a gauge needs more poses than a tracker."""
    visits = (360, 60) if SEES[case.sees] == "000000" else (120, 30)
    day, rng = vf.session(case.seed, *visits), np.random.default_rng(case.seed)
    kinds = [vf.KINDS[k] for k in case.kinds]
    noise = min((k.noise for k in kinds), key=lambda n: n.position, default=vr.THESIS_NOISE)
    effects = [findings.sized(k.make, k.size, case.size, day, noise, case.seed) for k in kinds]
    if case.device:
        noise = vf.FINE if case.device in vb.DEVICE else noise
        make = (vb.DEVICE | vf.OUTSIDE)[case.device]
        first = 2e-5 if case.device in vb.DEVICE else 0.5e-3
        effects.append(findings.sized(make, first, case.size, day, noise, rng.integers(1 << 20)))
    return day, effects, noise


def measured(case: Case, day: Any, effects: list[vr.Effect], noise: vr.Noise) -> Any:
    """The session as the device tells it, as samples of the package."""
    quiet = vf.samples(day, effects, findings.quiet(0.0), 0)
    draw = vb.NOISE.get(case.noise, vb.white)
    units = draw(len(quiet["q"]), quiet["r"], np.random.default_rng([case.seed, 5]))
    q, r, w = vb.draw(noise, units)
    seen = quiet | {"q": quiet["q"] + q, "r": quiet["r"] + r, "R": vr.turn(w) @ quiet["R"]}
    data = findings.dataset(seen, noise)
    mask = np.tile(np.array(list(SEES[case.sees])) == "1", (len(data), 1))
    read = {
        "plane": {"reading.probe": quiet["r"][:, 2] - HEIGHT},
        "ball_bar": {"reading.ball_bar": np.linalg.norm(quiet["r"] - CENTRE, axis=1)},
    }.get(case.sees, {})
    return replace(
        data,
        conditions=data.conditions | {k: v + noise.position * units[:, 3] for k, v in read.items()},
        measured=mask,
        r=np.where(mask[:, :3], data.r, 0.0),
        R=np.where(mask[:, 3:].all(axis=1)[:, None, None], data.R, np.eye(3)),
    )


def setup(case: Case, noise: vr.Noise) -> list[str]:
    """What `new` is told of a gauge over a plate, or of a ball-bar roughly where it stands."""
    centre = [float(v) for v in np.round(CENTRE, 2)]
    sensors = {
        "plane": f"probe: {{height: {HEIGHT}, sigma: {noise.position}}}",
        "ball_bar": f"ball_bar: {{centre: {centre}, sigma: {noise.position}}}",
    }
    return ["--sensor", sensors[case.sees]] if case.sees in sensors else []


def true_error(
    model_file: Path, effects: list[vr.Effect], day: Any, seed: int
) -> tuple[float, float]:
    """Rms position error (m) of the served robot at unseen poses under unseen circumstances, and
    how large the model believes it to be."""
    from parallel_cal.kinematics.kinematics import Kinematics
    from parallel_cal.model.file.modelfile import read_model

    other = vf.session(seed + 10_000, 80, 0)
    at = other.at(other.arrive + other.dwell / 2)
    at = replace(at, time=at.time * day.end / other.end)
    own = [e for e in effects if type(e).device is vr.Effect.device]  # what is the robot's
    _, r, _ = vr.truth(vr.MOCK_UP, own, other.reading, at)
    ways = np.diff(other.reading, axis=0, prepend=other.home[None])
    names = ("joint1", "joint2", "joint3")
    conditions = {f"direction.{j}": at.direction[:, i] for i, j in enumerate(names)}
    conditions |= {f"travel.{j}": findings.travel(ways[:, i]) for i, j in enumerate(names)}
    conditions |= {"temperature": at.temperature, "payload": at.payload, "time": at.time}
    served = Kinematics(read_model(model_file).robot())
    found = served.direct(other.reading, conditions)
    error = np.sqrt(np.mean(np.sum((found.position - r) ** 2, axis=1)))
    some = [{k: v[i] for k, v in conditions.items()} for i in range(10)]
    own = [np.trace(served.direct_covariance(found[i], at)[:3, :3]) for i, at in enumerate(some)]
    return float(error), float(np.sqrt(np.mean(own)))


def called(*arguments: object) -> Any:
    """The command line's JSON document; RuntimeError with its one line of an error."""
    from parallel_cal.cli.main import main

    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main([*map(str, arguments), "--json"])
        except SystemExit as ended:
            if ended.code:
                raise RuntimeError(err.getvalue().strip().splitlines()[-1]) from None
    return json.loads(out.getvalue())


def run(case: Case) -> Outcome:
    """The outcome of a case, and what it cost."""
    begin = time.process_time()
    return replace(outcome(case), seconds=round(time.process_time() - begin, 2))


def added(model: Path, data: Path, effects: list[str]) -> str:
    """Why one of the effects was not taken into the model file; empty where all were."""
    refused = ""
    for name in effects:
        try:
            called("add", model, name, data, "-o", model)
        except RuntimeError as error:
            refused = str(error)
    return refused


def printed(case: Case) -> Outcome:
    """A delta printer known by touches of its bed: errors are those of heights not touched."""
    from parallel_cal.diagnosis.comparison import compare
    from parallel_cal.model.file.modelfile import read_model

    kind = PRINTERS[case.kinds[0]]
    fresh = kind.touches(300, case.seed, draw=1, noise=0.0)
    with tempfile.TemporaryDirectory() as folder:
        data, model = Path(folder) / "data.json", Path(folder) / "model.yaml"
        kind.touches(200, case.seed).to_json(data)

        def height() -> float:
            return compare(read_model(model), fresh).errors.summary.reading_rms or np.nan

        called("new", kind.mechanism, "--sensor", f"probe: {kind.sensor}", "-o", model)
        try:
            called("fit", model, data, "-o", model)
            before = height()
            found = called("diagnose", model, data)
        except RuntimeError as error:
            return Outcome(case, "error", (), np.nan, np.nan, str(error))
        named, refused = tuple(found["effects"]), added(model, data, found["effects"])
        words, against = found["summary"], tuple(found["against"])
        return Outcome(
            case, found["verdict"], named, before, height(), refused, words, against=against
        )


def outcome(case: Case) -> Outcome:
    if case.family == "printers":
        return printed(case)
    day, effects, noise = session(case)
    with tempfile.TemporaryDirectory() as folder:
        data, model = Path(folder) / "data.json", Path(folder) / "model.yaml"
        measured(case, day, effects, noise).to_json(data)
        called("new", "delta54", *setup(case, noise), "-o", model)
        try:
            called("fit", model, data, "-o", model)
            before, _ = true_error(model, effects, day, case.seed)
            found = called("diagnose", model, data)
        except RuntimeError as error:
            return Outcome(case, "error", (), np.nan, np.nan, str(error))
        swaps = found["swaps"]
        named = tuple(" or ".join([n, *swaps.get(n, [])]) for n in found["effects"])
        refused = added(model, data, found["effects"])
        after, own = true_error(model, effects, day, case.seed)
    words, against = found["summary"], tuple(found["against"])
    return Outcome(
        case,
        found["verdict"],
        named,
        before,
        after,
        refused,
        words,
        uncertain=own,
        against=against,
    )


def table(outcomes: list[Outcome]) -> None:
    """A row for each kind of case: right names, verdicts, what the robot gained or lost."""
    groups: dict[str, list[Outcome]] = {}
    for o in outcomes:
        c = o.case
        what = " + ".join(c.kinds) or c.device or c.noise or "nothing"
        groups.setdefault(f"{c.family}: {what} {c.size:g} ({c.sees})", []).append(o)
    for name, some in groups.items():
        verdicts = dict(Counter(o.verdict for o in some))
        worse = sum(o.worse for o in some)
        before, after = (
            1e6 * np.nanmedian([getattr(o, side) for o in some]) for side in ("before", "after")
        )
        names = dict(Counter(n for o in some for n in o.named).most_common(4))
        print(
            f"{name}: right {sum(o.right for o in some)} of {len(some)}; {verdicts}; true error "
            f"{before:.1f} -> {after:.1f} um, worse in {worse}; {names}"
        )
        for error in sorted({o.error for o in some if o.error})[:2]:
            print(f"    {error[:160]}")


def shares(outcomes: list[Outcome]) -> None:
    """What the whole must show, by family and what the device sees: counts, their 95 %, goals."""
    for key in dict.fromkeys((o.case.family, o.case.sees) for o in outcomes):
        some = [o for o in outcomes if (o.case.family, o.case.sees) == key]
        counts = {
            "right": sum(o.right for o in some),
            "named": sum(bool(o.named) for o in some),
            "explained": sum(o.verdict == "explained" for o in some),
            "robot worse": sum(o.worse for o in some),
            "contradicted": sum(o.contradicted for o in some),
            "error": sum(o.verdict == "error" for o in some),
        }
        told = [f"{name} {k} ({interval(k, len(some))})" for name, k in counts.items()]
        seconds = np.mean([o.seconds for o in some if o.seconds] or [0.0])
        print(f"{key[0]} ({key[1]}), {len(some)}: {', '.join(told)}; {seconds:.1f} s a draw")
        for name, sign, goal in GOALS.get(key[0], ()):
            share = counts[name] / len(some)
            reached = share >= goal if sign == ">=" else share <= goal
            print(f"    goal: {name} {sign} {goal:.0%}: {'reached' if reached else 'MISSED'}")


def how_named(named: Iterable[str], names: Iterable[str]) -> str:
    """Whether one of `names` was named `alone`, in an `or` with others, or `not`; `named` are
    effects, or several that fit as well: "a or b"."""
    wanted = {*names}
    groups = [group for words in named if (group := {*words.split(" or ")}) & wanted]
    return "not" if not groups else "alone" if any(g <= wanted for g in groups) else "or"


def select_others(named: Iterable[str], names: Iterable[str]) -> tuple[str, ...]:
    """Those of `named` that contain none of `names`."""
    wanted = {*names}
    return tuple(words for words in named if not {*words.split(" or ")} & wanted)


def rms(values: Any) -> float:
    """Root of the mean square; of vectors, that of their lengths."""
    squares = np.square(values)
    return float(np.sqrt(np.mean(squares.sum(axis=1) if squares.ndim > 1 else squares)))


def interval(k: int, n: int) -> str:
    """The exact 95 % interval of a share k / n (Clopper and Pearson 1934)."""
    from scipy.stats import beta

    low = beta.ppf(0.025, k, n - k + 1) if k else 0.0
    high = beta.ppf(0.975, k + 1, n - k) if k < n else 1.0
    return f"{low:.1%}..{high:.1%}"


def correct(outcome: Outcome) -> bool:
    """Whether an outcome is what the page counts as correct for its family."""
    of_family = {
        "null": not outcome.named,
        "outside": outcome.verdict != "explained",
        "device": not outcome.worse,
    }
    return outcome.verdict != "error" and of_family.get(outcome.case.family, outcome.right)


def table_lines(outcomes: list[Outcome]) -> list[str]:
    """Return the lines of the page's table: a row for each family and what the device sees."""
    lines = [
        "| hidden | measured | correct means | correct | interval | robot worse | contradictions "
        "| errors |",
        "| --- | --- | --- | --: | --: | --: | --: | --: |",
    ]
    for family, (hidden, means) in HIDDEN.items():
        for sees, measured in MEASURED.items():
            some = [o for o in outcomes if (o.case.family, o.case.sees) == (family, sees)]
            if not some:
                continue
            right = sum(correct(o) for o in some)
            cells = [hidden, measured, means, f"{right} of {len(some)}", interval(right, len(some))]
            cells += [str(sum(o.worse for o in some)), str(sum(o.contradicted for o in some))]
            cells += [str(sum(o.verdict == "error" for o in some))]
            lines.append(f"| {' | '.join(cells)} |")
    return lines


def put_between(page: Path, start: str, end: str, text: str) -> None:
    """Write a text between two marks of a page."""
    before, _, rest = page.read_text(encoding="utf-8").partition(start)
    _, _, after = rest.partition(end)
    write_atomically(page, f"{before}{start}\n\n{text}\n\n{end}{after}")


def kept(file: Path | None) -> dict[Case, Outcome]:
    """The outcomes that a file of earlier slices holds."""
    if file is None or not file.exists():
        return {}
    found = {}
    for line in file.read_text().splitlines():
        row = json.loads(line)
        case = Case(**(row["case"] | {"kinds": tuple(row["case"]["kinds"])}))
        found[case] = Outcome(
            **(row | {"case": case, "named": tuple(row["named"]), "against": tuple(row["against"])})
        )
    return found


def made(
    cases: list[Case], file: Path | None, jobs: int, scheduler: str | None, until: float
) -> Iterable[Outcome]:
    """The outcomes of cases one by one, written as they come, while there is time."""
    with cluster(scheduler, jobs) as client:
        for _, outcome in run_each(client, run, [(case,) for case in cases]):
            if file is not None:
                with file.open("a") as lines:
                    lines.write(json.dumps(asdict(outcome)) + "\n")
            yield outcome
            if time.monotonic() > until:
                return


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--draws", type=int, default=5)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--jobs", type=int, default=1, help="processes on this machine")
    parser.add_argument("--scheduler", help="a Dask cluster's address, in place of this machine")
    parser.add_argument("--see", type=lambda text: text.split(","), default=["pose"])
    parser.add_argument("--results", type=Path)
    parser.add_argument("--minutes", type=float, default=math.inf)
    parser.add_argument("--page", action="store_true", help=f"only write the table of {PAGE.name}")
    parser.add_argument("family", nargs="*")
    given = parser.parse_args()
    if given.page:
        return put_between(PAGE, START, END, "\n".join(table_lines([*kept(STUDY).values()])))
    if unknown := [see for see in given.see if see not in SEES]:
        parser.error(f"--see {','.join(unknown)}: expected some of {','.join(SEES)}")
    all_of = families(given.draws, given.first)
    cases = [c for s in given.see for name in given.family or all_of for c in all_of[name](s)]
    outcomes = {c: o for c, o in kept(given.results).items() if c in set(cases)}
    until = time.monotonic() + 60 * given.minutes
    new = [c for c in cases if c not in outcomes]
    outcomes |= {o.case: o for o in made(new, given.results, given.jobs, given.scheduler, until)}
    done = [outcomes[c] for c in cases if c in outcomes]
    table(done)
    shares(done)


if __name__ == "__main__":
    main()
