"""Are the probabilities of a diagnosis true? Sessions of fresh seeds, whose causes are known.

Robots, sessions, physics and noise come from the independent virtual robots of `blind.py` and
`new_effects.py`. Of all statements "the robot has one of these effects, with probability p",
the share that is true must be near p. A statement is one about each cause that the sum over all
sets of causes finds likelier than not: the effects that it may be, and their probability together.
With `--results` every session is kept as a line of a file, and is not run again. `--page` writes
the table and the figure of docs/understand.md from docs/probability_study.jsonl. Usage:
`python -m bench.truth.probabilities [--draws N] [--first SEED] [--results FILE]
[--minutes M] [--page]`.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import virtual_blind as vb
import virtual_findings as vf

from bench.truth import blind, new_effects
from parallel_cal.base.errors import FitError
from parallel_cal.causes.effects import list_effects_to_test
from parallel_cal.diagnosis.explanation import Explanation
from parallel_cal.diagnosis.search import Search
from parallel_cal.identification.fit import fit_unjudged
from parallel_cal.identification.given_model import GivenModel
from parallel_cal.identification.options import FitOptions
from parallel_cal.model.file.modelfile import read_model
from parallel_cal.model.model import Model, Noise
from parallel_cal.recordings.dataset import Dataset

ROOT = Path(__file__).resolve().parents[2]
STUDY = ROOT / "docs" / "probability_study.jsonl"
FIGURE = ROOT / "docs" / "probabilities.svg"
START, END = (
    "<!-- probabilities: written by bench/truth/probabilities.py --page -->",
    "<!-- end -->",
)
BINS = (0.5, 0.8, 0.95, 0.99, 1.0)
FAMILIES = ("null", "single", "pairs", "outside", "device", "noise")
# Families of which a quarter as many are diagnosed without stated noise, too.
UNSTATED_FAMILIES = ("null", "single", "outside")
AT_REST = 0.2  # of the noise of a joint: what it scatters within a dwell


def explain(model: Model, data: Dataset) -> Explanation:
    """The sum over all sets of causes, as a diagnosis computes it."""
    options = FitOptions(hold_out=0.0)
    given = GivenModel.of(model, data, options.joint_sigma, True)

    def refit(extended: Model, insist: bool, near: Any) -> Any:
        return fit_unjudged(extended, given.dataset, options, given=given)

    def place(extended: Model) -> Model:
        return given.place(extended, options)

    search = Search(given.start, refit, lambda stage, share: None, place=place)
    return Explanation.of(search, list_effects_to_test(given.start), lambda knocked: knocked)


def statements(found: Explanation) -> list[dict[str, Any]]:
    """What is stated of each effect in the likeliest set."""
    names = [one.block.name for one in found.posterior.chosen if one.block.kind == "effect"]
    return [one for one in found.missing(names) if one["probability"] > BINS[0]]


def sessions(draws: int, first: int) -> Iterator[tuple[str, list[list[str]], Any]]:
    """Yield a key, the names that are right for each hidden cause, and the model with its data."""
    of_blind = blind.families(draws, first)
    for family in FAMILIES:
        for case in of_blind[family]("pose"):
            yield f"{family} {case}", _right(case), lambda case=case: _of_blind(case)
    fewer = blind.families(max(draws // 4, 1), first)
    for stated, forget in {"nothing": _forget_noise, "device": _forget_joint_noise}.items():
        for family in UNSTATED_FAMILIES:
            for case in fewer[family]("pose"):
                yield (
                    f"{stated} stated, {family} {case}",
                    _right(case),
                    lambda case=case, forget=forget: forget(*_of_blind(case)),
                )
    for name, kind in new_effects.KINDS.items():
        for robot in kind.robots:
            for seed in range(first, first + max(draws // 4, 1)):
                yield (
                    f"{robot}: {name} {seed}",
                    [list(kind.names)],
                    lambda robot=robot, kind=kind, seed=seed: _of_new_effects(robot, kind, seed),
                )


def _right(case: blind.Case) -> list[list[str]]:
    """For each hidden cause, the effects that are right for it."""
    right = [list(vf.KINDS[kind].names) for kind in case.kinds]
    return right + ([list(vb.OF_DEVICE)] if case.device else [])


def _forget_noise(model: Model, data: Dataset) -> tuple[Model, Dataset]:
    """The session of somebody who states no noise, and visits each pose once."""
    once = data.select(np.unique(data.pose_id, return_index=True)[1])
    unstated = replace(once, joint_sigma=None, pose_cov=np.zeros_like(once.pose_cov))
    return replace(model, noise=Noise()), unstated


def _forget_joint_noise(model: Model, data: Dataset) -> tuple[Model, Dataset]:
    """The session of a device that states its noise, and of joints that show theirs at rest."""
    once = data.select(np.unique(data.pose_id, return_index=True)[1])
    joint = data.joint_sigma if data.joint_sigma is not None else model.joint_noise
    at_rest = np.tile(AT_REST * np.asarray(joint), (len(once), 1))
    return (
        replace(model, noise=replace(model.noise, joint=None)),
        replace(once, joint_sigma=None, scatter_q=at_rest),
    )


def _of_blind(case: blind.Case) -> tuple[Model, Dataset]:
    day, effects, noise = blind.session(case)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.yaml"
        blind.called("new", "delta54", *blind.setup(case, noise), "-o", path)
        return read_model(str(path)), blind.measured(case, day, effects, noise)


def _of_new_effects(name: str, kind: new_effects.Kind, seed: int) -> tuple[Model, Dataset]:
    robot = new_effects.ROBOTS[name]
    return robot.model(), robot.measured([new_effects.sized(robot, kind, seed)], seed)


def run(draws: int, first: int, results: Path, minutes: float) -> None:
    """Run the sessions that the file does not contain yet."""
    known = {row["session"] for row in kept(results)}
    until = time.monotonic() + 60 * minutes
    drawn = [one for one in sessions(draws, first) if one[0] not in known]
    # In a drawn order, so that a part of the study is one of all kinds of sessions.
    for k in np.random.default_rng(first).permutation(len(drawn)):
        key, right, make = drawn[k]
        if time.monotonic() > until:
            break
        row: dict[str, Any] = {"session": key, "right": right}
        started = time.process_time()
        try:
            found = explain(*make())
            row |= {"statements": statements(found), "laws": found.laws, "knocked": found.knocked}
        except FitError as error:
            row |= {"error": str(error)}
        row["seconds"] = round(time.process_time() - started, 2)
        with results.open("a") as file:
            file.write(json.dumps(row) + "\n")


def kept(results: Path) -> list[dict[str, Any]]:
    return (
        [json.loads(line) for line in results.read_text().splitlines()] if results.exists() else []
    )


def count(rows: list[dict[str, Any]]) -> list[tuple[float, float, int, int]]:
    """For each bin of probability: its ends, the number of statements, and of true ones."""
    found = []
    made = [
        (one["probability"], any({*one["effects"]} & {*names} for names in row["right"]))
        for row in rows
        for one in row.get("statements", ())
    ]
    for low, high in pairwise(BINS):
        inside = [true for p, true in made if low < p <= high or (high == 1 and p > low)]
        found.append((low, high, len(inside), sum(inside)))
    return found


def table_lines(rows: list[dict[str, Any]]) -> list[str]:
    lines = ["| stated | statements | true | share, 95 % interval |", "|---|--:|--:|---|"]
    for low, high, n, k in count(rows):
        share = f"{k / n:.1%} ({blind.interval(k, n)})" if n else "-"
        lines.append(f"| {low:.0%} to {high:.0%} | {n} | {k} | {share} |")
    return lines


def draw(rows: list[dict[str, Any]]) -> None:
    """The share of true statements over the stated probability."""
    import matplotlib

    matplotlib.use("svg")
    import matplotlib.pyplot as plt
    from scipy.stats import beta

    plt.rcParams["svg.hashsalt"] = "probabilities"
    figure, axes = plt.subplots(figsize=(4.2, 3.6))
    axes.plot([0.5, 1], [0.5, 1], color="0.6", linewidth=1)
    for low, high, n, k in count(rows):
        if not n:
            continue
        ends = beta.ppf(0.025, k, n - k + 1) if k else 0.0, beta.ppf(0.975, k + 1, n - k)
        ends = ends[0], 1.0 if k == n else ends[1]
        at = (low + high) / 2
        axes.plot([at, at], ends, color="tab:blue")
        axes.plot([at], [k / n], "o", color="tab:blue")
    axes.set_xlabel("stated probability")
    axes.set_ylabel("share of true statements")
    figure.tight_layout()
    figure.savefig(FIGURE, metadata={"Date": None})


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--draws", type=int, default=8, help="of each kind of session")
    parser.add_argument("--first", type=int, default=52_000, help="the first seed")
    parser.add_argument("--results", type=Path, default=STUDY)
    parser.add_argument("--minutes", type=float, default=np.inf)
    parser.add_argument("--page", action="store_true", help="only write the table and the figure")
    given = parser.parse_args()
    if not given.page:
        run(given.draws, given.first, given.results, given.minutes)
    rows = kept(given.results)
    lines = table_lines(rows)
    print("\n".join(lines))
    if given.page:
        draw(rows)
        blind.put_between(ROOT / "docs" / "understand.md", START, END, "\n".join(lines))


if __name__ == "__main__":
    main()
