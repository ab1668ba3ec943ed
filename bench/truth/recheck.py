"""How many poses tell whether a robot has drifted since its calibration, and how often wrongly.

A Delta and a hexapod of points and rods (parallel_cal/virtual, which shares nothing with the rest
of the package) are calibrated with 100 poses of a tracker (30 um). Later something may have
changed: nothing; the zero of one joint by 1, 3 or 10 times its usual drift (0.5 mrad or 50 um); all
zeros by it; the workshop by 15 K; a rod or leg by 0.2 mm; the tracker by 0.3 mm; a zero by 10 times
its usual drift and the tracker. The poses of
`plan --update` are measured in their order until `recheck` is certain; if the robot has drifted,
until a model updated with them is nearly as certain as the calibration was, as `calibrate --update`
does.

Usage: `python -m bench.truth.recheck [robots]` prints the tables of docs/recheck.md; `alarms` only
counts false alarms.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

import parallel_cal as pc
from parallel_cal.base.threads import single_threaded
from parallel_cal.campaign.updating import needs_more
from parallel_cal.identification.options import FitOptions
from parallel_cal.identification.recheck import (
    CHANGED,
    DEVICE_MOVED,
    DRIFTED,
    UNCHANGED,
    UNDECIDED,
    recheck,
)
from parallel_cal.model.model import Model, Noise, new_model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.virtual import robot as vr
from parallel_cal.virtual.stewart import Stewart

TRACKER_M, CALIBRATION, PLANNED, UNSEEN = 30e-6, 100, 24, 100
CERTAINTIES = (0.9, 0.95, 0.99, 0.999)
EXPANSION, WARMTH_K, ROD_M, STAND_M = 12e-6, 15.0, 0.2e-3, 0.3e-3
RIGHT = {"nothing": UNCHANGED, "tracker 0.3 mm": DEVICE_MOVED}
CHANGES = (
    *("nothing", "zero, 1", "zero, 3", "zero, 10", "all zeros, 1", "15 K", "rod 0.2 mm"),
    *("tracker 0.3 mm", "zero, 10; tracker 0.3 mm"),
)


@dataclass(frozen=True)
class State:
    """A robot on a day: its dimensions (m, rad), zeros (nq,) and the shift (3,) of the tracker."""

    dimensions: dict[str, float]
    zeros: np.ndarray
    shift: np.ndarray
    eccentricity: float = 0.0


@dataclass(frozen=True)
class Kind:
    """A kind of robot: the class of the truth, its model, and its usual drift of a zero."""

    name: str
    truth: type
    model: str
    sigma: float  # of a joint reading
    zero: float
    rod: str
    wave: float  # of an encoder's error

    def nominal(self) -> Model:
        return replace(new_model(self.model), noise=Noise(self.sigma, TRACKER_M, None))

    def build(self, seed: int) -> State:
        """A robot within the tolerances of its dimensions."""
        table, rng = new_model(self.model).table, np.random.default_rng([seed, 52])
        values = table.nominal + table.tolerance * rng.standard_normal(len(table))
        given = dict(vr.TABLE_5_12) if self.truth is vr.Delta else {}
        dimensions = given | dict(zip(table.names, values.tolist(), strict=True))
        return State(dimensions, np.zeros(3 if given else 6), np.zeros(3))

    def positions(self, state: State, q: np.ndarray) -> np.ndarray:
        """Where the platform is (N, 3) at joint readings q (N, nq)."""
        turned = q + state.eccentricity * np.sin(2 * np.pi * q / self.wave)
        return np.asarray(self.truth(state.dimensions).forward(turned - state.zeros)[0])

    def measure(self, state: State, q: np.ndarray, rng: np.random.Generator) -> Dataset:
        shown = self.positions(state, q) + state.shift + rng.normal(0, TRACKER_M, (len(q), 3))
        return Dataset.from_arrays(
            new_model(self.model).joints,
            q + rng.normal(0, self.sigma, q.shape),
            shown,
            pose_cov=np.diag([TRACKER_M**2] * 3 + [1e6] * 3),
            joint_sigma=self.sigma,
            pose_id=np.arange(len(q)),
            source="virtual tracker",
        )

    def change(self, state: State, name: str, rng: np.random.Generator) -> tuple[State, str]:
        """The robot after a change, and the part that it concerns; `;` joins two."""
        if "; " in name:
            first, then = name.split("; ")
            state, part = self.change(state, first, rng)
            state, other = self.change(state, then, rng)
            return state, f"{other} and {part}"
        zeros, joint = state.zeros.copy(), int(rng.integers(len(state.zeros)))
        if name.startswith("zero"):
            zeros[joint] += rng.choice([-1, 1]) * float(name.split(", ")[1]) * self.zero
            return replace(state, zeros=zeros), f"zero of {new_model(self.model).joints[joint]}"
        if name.startswith("all zeros"):
            return replace(state, zeros=zeros + rng.normal(0, self.zero, zeros.shape)), ""
        if name == "15 K":
            own = {p.name for p in new_model(self.model).table if p.unit == "m"}
            factor = {n: 1 + EXPANSION * WARMTH_K * (n in own) for n in state.dimensions}
            grown = {n: v * factor[n] for n, v in state.dimensions.items()}
            return replace(state, dimensions=grown), "temperature"
        if name.startswith("rod"):
            rod = self.rod.format(joint + 1)
            longer = state.dimensions | {rod: state.dimensions[rod] + ROD_M}
            return replace(state, dimensions=longer), rod
        if name.startswith("tracker"):
            away = rng.normal(size=3)
            return replace(state, shift=STAND_M * away / np.linalg.norm(away)), "measuring device"
        return state, ""


KINDS = (
    Kind("Delta", vr.Delta, "delta24", 2e-5, 0.5e-3, "chain{}.Lb", 0.5),
    Kind("hexapod", Stewart, "stewart42", 5e-6, 50e-6, "leg{}.L0", 20e-3),
)


@dataclass(frozen=True)
class Calibrated:
    """A robot when it was calibrated, its model, the joints (24, nq) of the planned poses in their
    order, how many of them `plan` names, and joints (100, nq) for the error."""

    state: State
    model: Model
    joints: np.ndarray
    enough: int
    unseen: np.ndarray


def calibrate(kind: Kind, seed: int, eccentricity: float = 0.0) -> Calibrated:
    state = replace(kind.build(seed), eccentricity=eccentricity)
    rng = np.random.default_rng([seed, 1])
    nominal = kind.nominal()
    drawn = pc.simulate(nominal, CALIBRATION + UNSEEN, seed=seed).dataset().q
    result = pc.fit(nominal, kind.measure(state, drawn[:CALIBRATION], rng), hold_out=0.0)
    model = replace(result.model, history=(result.history_entry(),))
    planned = pc.plan(model, PLANNED, pool=300, update=True)
    assert planned.update is not None
    unseen = drawn[CALIBRATION:]
    return Calibrated(state, model, planned.poses.joints, planned.update.enough or 0, unseen)


def rms(kind: Kind, model: Model, state: State, q: np.ndarray) -> float:
    """Rms position error (m) of a model at joint readings q."""
    away = pc.Kinematics(model).direct(q).position - kind.positions(state, q)
    return float(np.sqrt((away**2).sum(axis=1).mean()))


@dataclass(frozen=True)
class Outcome:
    """After how many poses it was decided how; how many a campaign took; whether the likeliest part
    is right then (None: no single part changed); and the errors (m) of the old model, and of it
    updated when it was decided, when the campaign ended, and by all planned poses."""

    poses: int
    verdict: str
    taken: int
    part: bool | None
    errors: tuple[float, ...]


def decide(kind: Kind, robot: Calibrated, name: str, seed: int) -> Outcome:
    rng = np.random.default_rng([seed, CHANGES.index(name), 2])
    today, part = kind.change(robot.state, name, rng)
    samples = kind.measure(today, robot.joints, rng)
    poses, verdict = recheck(robot.model, samples).decision
    for taken in range(poses, PLANNED + 1):
        found = recheck(robot.model, samples.select(np.arange(taken)))
        if not needs_more(found):
            break
    models = [robot.model]
    for count in (poses, taken, PLANNED):
        some = samples.select(np.arange(count))
        update = FitOptions(hold_out=0.0, update=True)
        drifted = verdict in (DRIFTED, CHANGED)
        models.append(pc.fit(robot.model, some, update).model if drifted else robot.model)
    errors = tuple(rms(kind, model, today, robot.unseen) for model in models)
    # The offset of a leg is its zero.
    likeliest = next(iter(found.parts))
    right = likeliest == part or (".L0" in part and likeliest == f"zero of {part.split('.')[0]}")
    return Outcome(poses, verdict, taken, right if part else None, errors)


def say_poses(counts: Sequence[int]) -> str:
    return f"{np.median(counts):.0f}, 90 %: {np.quantile(counts, 0.9, method='lower'):.0f}"


def say_fixed(shares: np.ndarray, certainty: float) -> str:
    """The fewest poses of a plan of fixed length that decide as often as the certainty says."""
    enough = np.flatnonzero(shares >= min(certainty, 0.95))
    return str(enough[0] + 1) if len(enough) else f"more than {PLANNED}"


def tabulate(kind: Kind, robots: Sequence[Calibrated]) -> None:
    enough = [one.enough for one in robots]
    print(f"{kind.name}: plan --update names {say_poses(enough)} poses")
    for name in CHANGES:
        found = [decide(kind, one, name, seed) for seed, one in enumerate(robots)]
        wanted = RIGHT.get(name, DRIFTED)
        right = [one for one in found if one.verdict == wanted]
        open_ = sum(one.verdict in (CHANGED, UNDECIDED) for one in found)
        wrong = len(found) - len(right) - open_
        parts = [one.part for one in right if one.part is not None]
        squares = np.mean([np.square(one.errors) for one in found], axis=0)
        errors = " | ".join(f"{1e6 * e:.0f}" for e in np.sqrt(squares))
        named = f"{sum(parts)} of {len(parts)}" if parts else ""
        print(
            f"| {kind.name} | {name} | {say_poses([one.poses for one in found])} | {len(right)} "
            f"| {open_} | {wrong} | {say_poses([one.taken for one in found])} | {named} "
            f"| {errors} |",
            flush=True,
        )


def count_alarms(kind: Kind, robots: Sequence[Calibrated], sessions: int, model: str) -> None:
    """Sessions without a change, at several certainties."""
    poses: dict[float, list[int]] = {c: [] for c in CERTAINTIES}
    fixed = {c: np.zeros(PLANNED) for c in CERTAINTIES}  # decided at just so many poses
    verdicts: dict[float, list[str]] = {c: [] for c in CERTAINTIES}
    for seed, robot in enumerate(robots):
        rng = np.random.default_rng([seed, 3])
        for _ in range(sessions):
            found = recheck(robot.model, kind.measure(robot.state, robot.joints, rng))
            for c in CERTAINTIES:
                n, verdict = replace(found, certainty=c).decision
                poses[c].append(n)
                verdicts[c].append(verdict)
                limit = np.log(1 / c - 1)
                fixed[c] += [one.rival[1] <= limit and 1 - one.unchanged < c for one in found.looks]
    for c in CERTAINTIES:
        n = len(verdicts[c])
        alarms = sum(v in (DRIFTED, DEVICE_MOVED) for v in verdicts[c])
        kept = sum(v == UNCHANGED for v in verdicts[c])
        print(
            f"| {kind.name} | {model} | {c:g} | {(1 - c) / c:.2%} | {alarms} of {n} "
            f"({alarms / n:.2%}) | {kept / n:.0%} | {say_poses(poses[c])} "
            f"| {say_fixed(fixed[c] / n, c)} |",
            flush=True,
        )


def main() -> None:
    asked = sys.argv[1:]
    robots = next((int(a) for a in asked if a.isdigit()), 40)
    with single_threaded():
        for kind in KINDS:
            made = [calibrate(kind, seed) for seed in range(robots)]
            if "alarms" not in asked:
                tabulate(kind, made)
            count_alarms(kind, made, 25, "complete")
            # An encoder's error that the model lacks, larger than the noise of a pose.
            lacking = [calibrate(kind, seed, 0.6 * kind.zero) for seed in range(robots)]
            misfit = np.median([one.model.history[0]["chi2_per_dof"] for one in lacking])
            count_alarms(kind, lacking, 25, f"lacks an effect, chi2/dof {misfit:.2g}")


if __name__ == "__main__":
    main()
