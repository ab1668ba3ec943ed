"""How often the 95 % intervals of a fit hold the truth, in simulated sessions of a five-bar.

A session is a five-bar whose parameters are drawn from their tolerances, by formulas that share
nothing with the package (`foreign_five_bar.py`); only the compliance is that of a Delta,
which the package simulates. Noise is normal. A parameter's interval is its value +- 1.96 sigma; one
parameter of each session counts, drawn by the seed, so that the sessions are independent trials.
The interval of the error at held-out poses must hold the error at 2,000 further poses. Every
session is kept as a line of docs/coverage_study.jsonl, and one that stands there is not run again.
Usage: `python -m bench.truth.coverage [--minutes M] [--sessions N] [CASE ...]`; `--page` only
writes the table of docs/validation.md. Session k of a case has the seed [5102, k].
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from bench.truth.blind import interval
from bench.truth.foreign_five_bar import position
from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.files import write_atomically
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.identification.fit import FitResult, fit
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import Model, Noise, new_model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.simulate import simulate

ROOT = Path(__file__).resolve().parents[2]
PAGE, STUDY = ROOT / "docs" / "validation.md", ROOT / "docs" / "coverage_study.jsonl"
START, END = (
    "<!-- coverage: written by bench/truth/coverage.py --page -->",
    "<!-- end of coverage -->",
)
SEED = 5102
JOINT_SIGMA, POSITION_SIGMA = 2e-5, 5e-6  # rad, m
POSES, FEW_POSES, REPLICATES, FURTHER_POSES = 40, 12, 10, 2000
SIGMAS = 1.959964  # of a normal number: 95 % are within
SMALL_WIDTH = 6e-5  # rad of backlash in the left drive: a search finds it in a part of the sessions
DELTA_NOISE, DELTA_POSES, PAYLOAD = Noise(1e-4, 1e-5, 1e-4), 60, 0.5  # rad, m, rad; kg
XY = np.arange(6) < 2


@dataclass(frozen=True)
class Session:
    """The true parameters (2, 5), what was measured at (n, 2) joints, and the widths (2,) of the
    backlash."""

    true: np.ndarray
    data: Dataset
    widths: np.ndarray


@dataclass(frozen=True)
class Outcome:
    """Whether the intervals of a session hold: of the parameter drawn (None: there was no fit that
    counts), of all parameters (their number), and of the error at held-out poses."""

    case: str
    session: int
    parameter: bool | None
    parameters: int = 0
    of: int = 0
    held_out: bool | None = None


def draw_session(
    rng: np.random.Generator,
    poses: int = POSES,
    replicates: int = 0,
    share: float = 1.0,
    widths: Sequence[float] = (0.0, 0.0),
) -> Session:
    """Draw a robot from its tolerances and measure it at poses in a `share` of the workspace."""
    model = new_model("five_bar")
    table, count = model.table, len(model.table.names)
    true = (table.nominal + table.tolerance * rng.normal(size=count)).reshape(2, 5)
    nominal = Kinematics(model).inverse(_draw_targets(model, rng, poses, share)).joints
    index = np.r_[:poses, :replicates]
    joints = nominal[index]
    direction = rng.choice([-1.0, 1.0], size=joints.shape)
    moved = joints - np.asarray(widths) / 2 * direction
    r = np.zeros((len(joints), 3))
    r[:, :2] = position(true, moved) + POSITION_SIGMA * rng.normal(size=joints.shape)
    conditions = {f"direction.{name}": direction[:, k] for k, name in enumerate(model.joints)}
    data = Dataset.from_arrays(
        model.joints,
        joints + JOINT_SIGMA * rng.normal(size=joints.shape),
        r,
        measured=XY,
        pose_cov=np.eye(6) * POSITION_SIGMA**2,
        joint_sigma=JOINT_SIGMA,
        conditions=conditions,
        pose_id=index,
    )
    return Session(true, data, np.asarray(widths))


def _draw_targets(
    model: Model, rng: np.random.Generator, poses: int, share: float = 1.0
) -> np.ndarray:
    low, high = np.array(model.mechanism.workspace.low), np.array(model.mechanism.workspace.high)
    middle, half = (low + high) / 2, share * (high - low) / 2
    return np.column_stack([middle + half * rng.uniform(-1, 1, (poses, 2)), np.zeros(poses)])


def judge(
    case: str,
    number: int,
    session: Session,
    result: FitResult,
    rng: np.random.Generator,
    own: Sequence[str] = (),
) -> Outcome:
    """Compare the intervals of a fit with the truth; of the parameters `own` only, if given."""
    values = dict(zip(new_model("five_bar").table.names, session.true.ravel(), strict=True))
    joints = session.data.joint_names
    values |= {f"backlash.{j}.width": w for j, w in zip(joints, session.widths, strict=True)}
    names = own or [n for n in result.parameters() if not result.parameters()[n].fixed]
    inside = []
    for name in names:
        found = result.parameters()[name]
        away = abs(found.value - values[name])
        inside.append(bool(found.sigma is not None and away <= SIGMAS * found.sigma))
    drawn = bool(inside[int(rng.integers(len(inside)))])
    return Outcome(case, number, drawn, sum(inside), len(inside), _holds(result, session, rng))


def _holds(result: FitResult, session: Session, rng: np.random.Generator) -> bool | None:
    """Whether the interval of the error at held-out poses holds the error at further poses, in {B}
    even if the fit took the device to be displaced."""
    sigma = result.rms_sigmas(result.held_out).get("position")
    rms = result.held_out.summary.position_rms
    if sigma is None or rms is None:
        return None
    model = new_model("five_bar")
    joints = Kinematics(model).inverse(_draw_targets(model, rng, FURTHER_POSES)).joints
    direction = rng.choice([-1.0, 1.0], size=joints.shape)
    seen = position(session.true, joints - session.widths / 2 * direction)
    seen = seen + POSITION_SIGMA * rng.normal(size=seen.shape)
    at = {f"direction.{name}": direction[:, k] for k, name in enumerate(model.joints)}
    at = {name: at[name] for name in result.model.conditions}
    read = joints + JOINT_SIGMA * rng.normal(size=joints.shape)
    predicted = Kinematics(result.model).direct(read, at).position[:, :2]
    error = float(np.sqrt(np.mean(np.sum((seen - predicted) ** 2, axis=1))))
    return bool(abs(error - rms) <= SIGMAS * sigma)


def with_stated_noise(case: str, number: int, rng: np.random.Generator) -> Outcome:
    session = draw_session(rng)
    return judge(case, number, session, fit(new_model("five_bar"), session.data), rng)


def with_noise_of_residuals(case: str, number: int, rng: np.random.Generator) -> Outcome:
    session = draw_session(rng)
    unstated = replace(
        session.data, pose_cov=np.full_like(session.data.pose_cov, np.nan), joint_sigma=None
    )
    return judge(case, number, session, fit(new_model("five_bar"), unstated), rng)


def with_noise_of_replicates(case: str, number: int, rng: np.random.Generator) -> Outcome:
    """The user states the noise that `info` prints for visits of one pose."""
    session = draw_session(rng, replicates=REPLICATES)
    noise = session.data.replicate_noise()
    sigma = float(np.sqrt(np.mean(noise.pose[:2] ** 2)))
    covariance = np.broadcast_to(np.eye(6) * sigma**2, session.data.pose_cov.shape)
    stated = replace(
        session.data,
        pose_cov=covariance.copy(),
        joint_sigma=np.full(2, np.sqrt(np.mean(noise.joint**2))),
    )
    return judge(case, number, session, fit(new_model("five_bar"), stated), rng)


def with_weak_directions(case: str, number: int, rng: np.random.Generator) -> Outcome:
    """Few poses in a small part of the workspace: tolerances decide some combinations."""
    session = draw_session(rng, poses=FEW_POSES, share=0.1)
    result = fit(new_model("five_bar"), session.data)
    if not result.estimate.spectrum.weak:
        return Outcome(case, number, None)
    return replace(judge(case, number, session, result, rng), held_out=None)


def with_width_at_its_bound(case: str, number: int, rng: np.random.Generator) -> Outcome:
    """A width of 0, which cannot be less: its estimate may be, and has an interval as any other."""
    session = draw_session(rng)
    result = fit(new_model("five_bar"), session.data, effects=["backlash"])
    names = [f"backlash.{joint}.width" for joint in session.data.joint_names]
    return judge(case, number, session, result, rng, names)


def with_compliance_at_its_bound(case: str, number: int, rng: np.random.Generator) -> Outcome:
    """A compliance of 0 of a Delta that the package itself simulates, with two payloads."""
    model = replace(new_model("delta24"), noise=DELTA_NOISE)
    errors = model.table.tolerance * rng.normal(size=len(model.values)) * ~np.asarray(model.fixed)
    data = simulate(model.with_values(model.table.nominal + errors), DELTA_POSES, number).dataset()
    payload = rng.choice([0.0, PAYLOAD], len(data))
    data = replace(data, conditions={**data.conditions, "payload": payload})
    result = fit(model, data, effects=["joint_compliance"], hold_out=0)
    found = [p for name, p in result.parameters().items() if name.endswith(".compliance")]
    inside = [one.sigma is not None and abs(one.value) <= SIGMAS * one.sigma for one in found]
    return Outcome(case, number, inside[int(rng.integers(len(inside)))], sum(inside), len(inside))


def after_a_search(case: str, number: int, rng: np.random.Generator) -> Outcome:
    """A backlash that a diagnosis finds in a part of the sessions: the others do not count."""
    session = draw_session(rng, replicates=REPLICATES, widths=(SMALL_WIDTH, 0.0))
    found = diagnose(new_model("five_bar"), session.data)
    if found.effects != ("backlash",):
        return Outcome(case, number, None)
    result = fit(new_model("five_bar"), session.data, effects=found.additions)
    return judge(case, number, session, result, rng, ["backlash.left.width"])


@dataclass(frozen=True)
class Case:
    """What is printed in the table, and what runs a session."""

    words: str
    run: Callable[[str, int, np.random.Generator], Outcome]


CASES = {
    "stated": Case("noise stated", with_stated_noise),
    "residuals": Case("noise estimated from the residuals", with_noise_of_residuals),
    "replicates": Case(
        f"noise stated as {REPLICATES} pairs of visits show it", with_noise_of_replicates
    ),
    "weak": Case("weak directions held by tolerances", with_weak_directions),
    "bound": Case("a width that is 0", with_width_at_its_bound),
    "compliance": Case("a compliance that is 0 (Delta)", with_compliance_at_its_bound),
    "search": Case("a width after a search found the effect", after_a_search),
}


def run(names: Sequence[str], sessions: int, minutes: float) -> None:
    """Run the sessions that are not kept yet, one of each case in turn."""
    done = {(one.case, one.session) for one in read_study()}
    end = time.monotonic() + 60 * minutes
    for number in range(sessions):
        for name in names:
            if (name, number) in done:
                continue
            if time.monotonic() > end:
                return
            rng = np.random.default_rng([SEED, number])
            try:
                outcome = CASES[name].run(name, number, rng)
            except ParallelCalError as error:
                print(f"{name} {number}: {error}")
                outcome = Outcome(name, number, None)
            with STUDY.open("a") as file:
                file.write(json.dumps(asdict(outcome)) + "\n")


def read_study() -> list[Outcome]:
    """Read the sessions that were run."""
    lines = STUDY.read_text().splitlines() if STUDY.exists() else []
    return [Outcome(**json.loads(line)) for line in lines]


def _format_share(held: Sequence[bool]) -> str:
    if not held:
        return ""
    return f"{sum(held) / len(held):.1%} ({interval(sum(held), len(held))})"


def make_table(outcomes: Sequence[Outcome]) -> str:
    """Write the table of the page in Markdown."""
    rows = [
        "| sessions with | sessions | parameter | error at held-out poses |",
        "|---|---|---|---|",
    ]
    for name, case in CASES.items():
        own = [one for one in outcomes if one.case == name]
        parameter = [one.parameter for one in own if one.parameter is not None]
        held_out = [one.held_out for one in own if one.held_out is not None]
        cells = [_format_share(some) for some in (parameter, held_out)]
        count = f"{len(own)}" if len(parameter) == len(own) else f"{len(parameter)} of {len(own)}"
        rows.append(f"| {case.words} | {count} | {' | '.join(cells)} |")
    return "\n".join(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", metavar="CASE", help=", ".join(CASES))
    parser.add_argument("--sessions", type=int, default=10_000)
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--page", action="store_true")
    given = parser.parse_args()
    if unknown := set(given.cases) - set(CASES):
        parser.error(f"{', '.join(sorted(unknown))}: expected {', '.join(CASES)}")
    if not given.page:
        run(given.cases or list(CASES), given.sessions, given.minutes)
    table = make_table(read_study())
    if given.page:
        before, rest = PAGE.read_text().split(START)
        text = f"{before}{START}\n\n{table}\n\n{END}{rest.split(END)[1]}"
        write_atomically(PAGE, text)
    print(table)


if __name__ == "__main__":
    main()
