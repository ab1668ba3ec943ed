"""The study of the camera: robots identified from pixels, beside a tracker of 30 um.

Robots, lenses and pixels come from the independent virtual robots and camera; every run has another
robot, other errors of its lengths and other poses. A run with nothing hidden fits the same poses
once from the camera and once from the tracker, and counts how often the 95 % intervals hold the
truth. A run with something hidden is a diagnosis. With `--results` every outcome becomes a line of
a file, and a run that stands there already is not repeated: a long study can be made in slices
(`--minutes`). `--page` only writes the tables of docs/camera_model.md from
docs/camera_study.jsonl, to which such lines are added. Usage: `python -m bench.truth.camera
[--runs N] [--sizes S,S] [--results FILE] [--minutes M] [--page] [ROW ...]`; a ROW is a part of the
name of a row, such as `nothing on delta`, and a size is a multiple of the usual one.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import virtual_arm as va
from camera_cells import Cell
from virtual_effects_hidden import JointCompliance

from bench.truth.blind import how_named, interval, put_between, rms, select_others
from bench.truth.slices import add_options, run_missing
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.identification.fit import fit
from parallel_cal.virtual.robot import Backlash, EncoderEccentricity

ROOT = Path(__file__).resolve().parents[2]
PAGE, STUDY = ROOT / "docs" / "camera_model.md", ROOT / "docs" / "camera_study.jsonl"
MARKS = {  # the tables of the page
    name: (f"<!-- {name}: written by bench/truth/camera.py --page -->", f"<!-- end of {name} -->")
    for name in ("accuracy", "effects")
}
ROBOTS = {"delta": "Delta (`delta54`)", "stewart": "hexapod (`stewart42`)", "ur5": "arm (UR5)"}
LENS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
HELD = 1.96  # sigmas of a 95 % interval
UNSEEN = 200  # poses at which a model is judged
BOARD_AT = ((-0.06, -0.06, -0.1), (0.06, 0.06, 0.05))  # m, its middle in {P}, at least and at most


@dataclass(frozen=True)
class Kind:
    """Hidden physics: the robot, its names in the catalogue, the usual size (SI) and how a size
    and a draw make one; the payloads (kg) that the robot carries in turns."""

    robot: str
    names: tuple[str, ...]
    size: float
    make: Callable[[float, np.random.Generator], tuple[Any, ...]]
    payloads: tuple[float, ...] = ()


def positive(size: float, rng: np.random.Generator, n: int = 3) -> tuple[float, ...]:
    """n numbers near `size`, all of one sign."""
    return tuple(size * rng.uniform(0.6, 1.4, n))


def loose_gears(size: float, rng: np.random.Generator) -> tuple[Any, ...]:
    return (Backlash(positive(size, rng)),)


def eccentric_discs(size: float, rng: np.random.Generator) -> tuple[Any, ...]:
    amplitude, phase = np.array(positive(size, rng)), rng.uniform(-np.pi, np.pi, 3)
    sine, cosine = amplitude * np.sin(phase), amplitude * np.cos(phase)
    return (EncoderEccentricity(tuple(sine), tuple(cosine)),)


def soft_shafts(size: float, rng: np.random.Generator) -> tuple[Any, ...]:
    return (JointCompliance(positive(size, rng)),)


def faulty_arm(fault: str, size: float, rng: np.random.Generator) -> tuple[Any, ...]:
    """A fault of `va.Play` at the two joints that carry the arm."""
    return tuple(va.Play(k, **{fault: width}) for k, width in enumerate(positive(size, rng, 2)))


KINDS = {
    "backlash": Kind("delta", ("backlash",), 1e-3, loose_gears),
    "eccentricity": Kind("delta", ("encoder_eccentricity",), 8e-3, eccentric_discs),
    "compliance": Kind("delta", ("joint_compliance",), 1e-3, soft_shafts, (0.0, 1.5, 3.0)),
    "backlash of an arm": Kind("ur5", ("backlash",), 1e-3, partial(faulty_arm, "backlash")),
    "eccentricity of an arm": Kind(
        "ur5", ("encoder_eccentricity",), 8e-3, partial(faulty_arm, "eccentric")
    ),
}


@dataclass(frozen=True)
class Case:
    """One run: the robot, what hides in it (a key of KINDS, empty for nothing), the size as a
    multiple of the usual one, and the seed."""

    robot: str
    hidden: str
    size: float
    seed: int

    @property
    def row(self) -> str:
        return f"{self.hidden or 'nothing'} on {self.robot}"


@dataclass(frozen=True)
class Accuracy:
    """Rms position errors (m) at poses that no fit has seen: of the robot as drawn, identified by
    the camera, as its fit states, identified by the tracker. Shares of the 95 % intervals that hold
    the truth: of the positions and of the numbers of the lens."""

    case: Case
    drawn: float
    camera: float
    stated: float
    tracker: float
    positions: float
    lens: float


@dataclass(frozen=True)
class Finding:
    """What a diagnosis said about something hidden, and rms position errors (m) at other poses: the
    `effect` by itself, and the robot identified without and with what the diagnosis found. If no
    geometry alone is plausible, the verdict is `refused`, `named` is what the error proposes, and
    the robot as drawn is the one without it."""

    case: Case
    verdict: str
    named: tuple[str, ...]  # "a" or "a or b"
    effect: float
    before: float
    after: float
    seconds: float  # of the processor

    @property
    def how(self) -> str:
        """Whether what hides was named `alone`, in an `or`, or `not`."""
        return how_named(self.named, KINDS[self.case.hidden].names)

    @property
    def others(self) -> tuple[str, ...]:
        """What was named besides what hides."""
        return select_others(self.named, KINDS[self.case.hidden].names)


Outcome = Accuracy | Finding


def run(case: Case) -> Outcome:
    return look_for(case) if case.hidden else measure(case)


def place_board(case: Case) -> tuple[float, float, float]:
    """Where the middle of the board sits on the platform (m); the program is not told."""
    x, y, z = np.random.default_rng([case.seed, 8]).uniform(*BOARD_AT)
    return x, y, z


def measure(case: Case) -> Accuracy:
    """Identify one robot by the camera and by the tracker, and compare both with the truth."""
    cell = Cell(case.robot, case.seed, board_at=place_board(case))
    model = cell.drawn.with_sensors((cell.sensor(),))
    seen = fit(model, cell.seen_by_camera(seed=case.seed), hold_out=0)
    tracked = fit(cell.drawn, cell.seen_by_tracker(seed=case.seed), hold_out=0)
    away, sigma = cell.errors_at_unseen_poses(seen.model, UNSEEN)
    assert sigma is not None
    shape, numbers = cell.lens, seen.parameters()
    true = (shape.fx, shape.fy, shape.cx, shape.cy, *shape.k)
    found = [numbers[f"camera.{name}"] for name in LENS]
    lens = [
        abs(one.value - t) < HELD * (one.sigma or 0.0) for one, t in zip(found, true, strict=True)
    ]
    return Accuracy(
        case,
        cell.error_at_unseen_poses(cell.drawn, UNSEEN),
        rms(away),
        rms(sigma),
        cell.error_at_unseen_poses(tracked.model, UNSEEN),
        float(np.mean(np.abs(away) < HELD * sigma)),
        float(np.mean(lens)),
    )


def look_for(case: Case) -> Finding:
    """Diagnose a robot in which something hides, as the camera sees it."""
    kind = KINDS[case.hidden]
    effects = kind.make(case.size * kind.size, np.random.default_rng([case.seed, 7]))
    cell = Cell(
        case.robot,
        case.seed,
        effects=effects,
        board_at=place_board(case),
        payloads=kind.payloads,
    )
    begin = time.process_time()
    model = cell.drawn.with_sensors((cell.sensor(),))
    seen = cell.seen_by_camera(seed=case.seed)
    found = diagnose(model, seen)
    verdict = found.verdict.word
    named = tuple(" or ".join([name, *found.swaps.get(name, ())]) for name in found.effects)
    models = found.base.fitted.model, found.best.fitted.model
    seconds = time.process_time() - begin
    before, after = (cell.error_at_unseen_poses(one, UNSEEN) for one in models)
    moved = cell.moved_by_effects(UNSEEN)
    return Finding(case, verdict, named, moved, before, after, round(seconds, 2))


def rows() -> list[tuple[str, str]]:
    """(robot, what hides) of every row, first those of nothing."""
    return [(at, "") for at in ROBOTS] + [(kind.robot, name) for name, kind in KINDS.items()]


def list_cases(runs: int, sizes: list[float], wanted: list[str]) -> list[Case]:
    """Cases in the order in which to run them: the first seed of every row, then the second."""
    cases = [
        Case(at, name, size, seed)
        for seed in range(1, runs + 1)
        for at, name in rows()
        for size in (sizes if name else [1.0])
    ]
    return [c for c in cases if not wanted or any(w in c.row for w in wanted)]


def kept(file: Path) -> dict[Case, Outcome]:
    """The outcomes that a file of earlier slices holds."""
    if not file.exists():
        return {}
    found: dict[Case, Outcome] = {}
    for line in file.read_text(encoding="utf-8").splitlines():
        row = json.loads(line)
        case = Case(**row["case"])
        row |= {"case": case}
        found[case] = (
            Finding(**row | {"named": (*row["named"],)}) if case.hidden else Accuracy(**row)
        )
    return found


def grouped(outcomes: list[Any], by: Callable[[Any], Any]) -> dict[Any, list[Any]]:
    """Outcomes in groups, the keys in order."""
    keys = dict.fromkeys(sorted(map(by, outcomes)))
    return {key: [o for o in outcomes if by(o) == key] for key in keys}


def accuracy_lines(outcomes: list[Accuracy]) -> list[str]:
    """Return the lines of the table of errors and intervals: a row for each robot, and one for
    all."""
    lines = [
        "| robot | runs | as drawn | camera | uncertainty that the fit states | tracker of 30 um | "
        "positions in their 95 % interval | numbers of the lens in theirs |",
        "| --- | --: | --: | --: | --: | --: | --: | --: |",
    ]
    order = [*ROBOTS]
    for index, some in grouped(outcomes, lambda o: order.index(o.case.robot)).items():
        errors = [
            rms([getattr(o, n) for o in some]) for n in ("drawn", "camera", "stated", "tracker")
        ]
        cells = [ROBOTS[order[index]], str(len(some)), *(f"{1e6 * e:.0f} um" for e in errors)]
        lines.append(f"| {' | '.join([*cells, *shares(some)])} |")
    cells = ["together", str(len(outcomes)), "", "", "", "", *shares(outcomes)]
    return [*lines, f"| {' | '.join(cells)} |"]


def shares(some: list[Accuracy]) -> list[str]:
    """Mean shares of the intervals that hold the truth, with the sigma of the mean over runs."""
    found = np.array([(o.positions, o.lens) for o in some])
    if len(some) < 2:
        return [f"{share:.1%}" for share in found[0]]
    sigma = found.std(axis=0, ddof=1) / np.sqrt(len(some))
    return [f"{m:.1%} +- {s:.1%}" for m, s in zip(found.mean(axis=0), sigma, strict=True)]


def effect_lines(outcomes: list[Finding]) -> list[str]:
    """Return the lines of the table of hidden effects: a row for each effect and size."""
    lines = [
        "| hidden | size | at the platform | runs | named alone | in an `A or B` | not named | "
        "named, interval | other names | true error, without and with what was named |",
        "| --- | --- | --: | --: | --: | --: | --: | --: | --: | --: |",
    ]
    order = [*KINDS]
    groups = grouped(outcomes, lambda o: (order.index(o.case.hidden), o.case.size))
    for (index, size), some in groups.items():
        kind, hows = KINDS[order[index]], Counter(o.how for o in some)
        moved, before, after = (
            1e6 * rms([getattr(o, n) for o in some]) for n in ("effect", "before", "after")
        )
        unit = "mrad/(N m)" if kind.payloads else "mrad"
        cells = [
            f"{order[index]} (`{'` or `'.join(kind.names)}`)",
            f"{1e3 * size * kind.size:.3g} {unit}",
            f"{moved:.0f} um",
            str(len(some)),
            *(str(hows[how]) for how in ("alone", "or", "not")),
            interval(len(some) - hows["not"], len(some)),
            str(sum(len(o.others) for o in some)),
            f"{before:.0f} -> {after:.0f} um",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def tables(outcomes: list[Outcome]) -> dict[str, list[str]]:
    """Return the lines of both tables by the name of their marks; no lines for a table without
    rows."""
    accuracy = [o for o in outcomes if isinstance(o, Accuracy)]
    effects = [o for o in outcomes if isinstance(o, Finding)]
    found = {}
    if accuracy:
        found["accuracy"] = accuracy_lines(accuracy)
    if effects:
        found["effects"] = effect_lines(effects)
    return found


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--runs", type=int, default=67)
    parser.add_argument("--sizes", default="1", help="multiples of the usual size of an effect")
    parser.add_argument("--page", action="store_true", help=f"only write the tables of {PAGE.name}")
    parser.add_argument("row", nargs="*")
    add_options(parser)
    given = parser.parse_args()
    if given.page:
        for name, lines in tables([*kept(STUDY).values()]).items():
            put_between(PAGE, *MARKS[name], "\n".join(lines))
        return
    cases = list_cases(given.runs, [float(s) for s in given.sizes.split(",")], given.row)
    outcomes = kept(given.results) if given.results else {}
    done = run_missing(cases, outcomes, run, given.results, given.minutes)
    for lines in tables(done).values():
        print("\n".join(lines))


if __name__ == "__main__":
    main()
