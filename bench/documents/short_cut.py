"""Short-cut set-up (4.2.7, 5.4.5): the error left in the whole Delta, beside a pose device.

Random robots, each of model 54's 42 dimensions off by its tolerance; encoders 25". Loops cannot
see where the robot stands, so errors are told twice: in {B} as it comes, and with {B} laid where
it fits best. Medians over the robots of the mean over the workspace (12 x 12 x 12 cm). Usage:
`python -m bench.documents.short_cut [robots]`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import virtual_short_cut as vs
from tied import JOINTS, blind

from parallel_cal.base.rotation import rotation_vector
from parallel_cal.identification.fit import fit
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import Model, new_model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.short_cut.identify import Combination, short_cut
from parallel_cal.short_cut.loop import Loop
from parallel_cal.virtual import robot as vr

NOISE = vr.THESIS_NOISE
RODS_1 = ("chain1.Lb", "chain1.dLb")
BARS = tuple(f"chain{i}.{name}" for i in (1, 2, 3) for name in ("dalpha", "dbeta"))


@dataclass(frozen=True)
class Case:
    """Which loops, how many places of each, and what was measured otherwise."""

    name: str
    loops: tuple[str, ...]
    places: int = 40
    known: tuple[str, ...] = RODS_1
    relinearise: bool = True


CASES = (
    Case("3 loops", vs.THREE),
    Case("6 loops", vs.SIX),
    Case("12 loops", vs.TWELVE),
    Case("12 loops, combined by covariance only", vs.TWELVE, relinearise=False),
    Case("12 loops, no rod measured", vs.TWELVE, known=()),
    Case("12 loops, platform's bars known, too", vs.TWELVE, known=(*RODS_1, *BARS)),
    Case("12 loops, 10 places", vs.TWELVE, 10),
    Case("12 loops, 20 places", vs.TWELVE, 20),
    Case("12 loops, 80 places", vs.TWELVE, 80),
)


def from_loops(case: Case, seed: int) -> Combination:
    """The robot as its loops show it."""
    robot, recordings = vs.random_delta(seed), []
    known = {name: robot.parameters[name] for name in case.known}
    for k, loop in enumerate(case.loops):
        q = vs.tied(robot, loop).places(case.places)
        q = q + np.random.default_rng([seed, k]).normal(0, NOISE.joint, q.shape)
        recordings.append((Loop.parse(loop), blind(q, NOISE.joint, {})))
    start = new_model("delta54", known)
    return short_cut(start, recordings, fix=known, relinearise=case.relinearise)


def from_device(seed: int) -> Model:
    """The same robot by a pose device (10 um, 15") at 120 poses all over the workspace."""
    robot = vs.random_delta(seed)
    joints, r = vs.workspace(robot, 120)
    q, dr, w = NOISE.draw(np.random.default_rng(seed), 120)
    data = Dataset.from_arrays(
        JOINTS,
        joints + q,
        r + dr,
        vr.turn(w) @ robot.inverse(r)[1],
        pose_cov=np.diag([NOISE.position**2] * 3 + [NOISE.orientation**2] * 3),
        joint_sigma=[NOISE.joint] * 3,
    )
    return fit(new_model("delta54"), data, prior=True, hold_out=0).model


def errors(model: Model, seed: int) -> tuple[float, float, float]:
    """Mean position error in {B} and with {B} fitted (um), and how much the platform's turning
    changes over the workspace beside the truth (arcmin, rms)."""
    robot = vs.random_delta(seed)
    r = np.random.default_rng(7).uniform((-0.06, -0.06, 0.14), (0.06, 0.06, 0.26), (200, 3))
    joints, R = robot.inverse(r)
    found = Kinematics(model).direct(joints)
    apart = [p - r for p in (found.position, vs.moved_onto(found.position, r))]
    turned = rotation_vector(found.rotation @ R.transpose(0, 2, 1))
    varying = np.linalg.norm(turned - turned.mean(axis=0), axis=1)
    straight, fitted = (float(np.linalg.norm(a, axis=1).mean()) * 1e6 for a in apart)
    return straight, fitted, float(np.sqrt(np.mean(varying**2))) * 60 * 180 / np.pi


def line(name: str, model: Callable[[int], Model], robots: int, seen: str = "") -> str:
    """One row: medians over the robots, and the worst of them with {B} fitted."""
    rows = np.array([errors(model(seed), seed) for seed in range(robots)])
    straight, fitted, turning = np.median(rows, axis=0)
    return (
        f"{name:40s} {seen:>12s} {straight:10.0f} {fitted:10.1f} {rows[:, 1].max():10.1f} "
        f"{turning:10.2f}"
    )


def case_line(case: Case, robots: int) -> str:
    found = [from_loops(case, seed) for seed in range(robots)]
    ranks = {loop.rank for combination in found for loop in combination.loops}
    seen = f"{'/'.join(map(str, sorted(ranks)))}, {found[0].spectrum.rank}"
    return line(case.name, lambda seed: found[seed].model, robots, seen)


def main() -> None:
    robots = int(sys.argv[1]) if len(sys.argv) > 1 else 10
    print(f"{robots} robots; loops of 40 places and two measured rods where nothing else is said")
    print(
        f"{'':40s} {'seen: a loop,':>12s} {'in {B}':>9s} {'{B} fitted':>10s} {'worst':>10s} turning"
    )
    print(f"{'':40s} {'together':>12s} {'um':>10s} {'um':>10s} {'um':>10s} {'arcmin':>10s}")
    print(line("nominal", lambda seed: new_model("delta54"), robots), flush=True)
    for case in CASES:
        print(case_line(case, robots), flush=True)
    print(line("pose device (10 um, 15 arcsec), 120 poses", from_device, robots), flush=True)


if __name__ == "__main__":
    main()
