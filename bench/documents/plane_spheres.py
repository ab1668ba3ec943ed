"""Plane/spheres without a device (4.2.6, 5.4.4): 100 random robots, and where it fails.

The thesis found hundreds of minima. Here every fit is made twice, from the nominal and from the
true dimensions: a robot is trapped where the two disagree. Errors are those of the direct problem
all over the workspace (12 x 12 x 12 cm), not on the plate only. Usage:
`python -m bench.documents.plane_spheres [robots]`.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field

import numpy as np
import virtual_setups as vs
from tied import dataset

from parallel_cal.base.errors import FitError
from parallel_cal.base.threads import single_threaded
from parallel_cal.identification.methods.implicit import Estimate, estimate
from parallel_cal.identification.observations import observe
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import Model, new_model
from parallel_cal.model.shelf import load_sensor
from parallel_cal.recordings.dataset import Dataset

HOLES = vs.Plate.holes


@dataclass(frozen=True)
class Case:
    """A variation of the set-up: what the plate is, and what of it is believed unknown."""

    name: str
    plate: vs.Plate = field(default_factory=vs.Plate)
    poses: int = 40
    free: tuple[str, ...] = ()
    spread: float = 1.0
    prior: bool = True


CASES = (
    Case("as stated: 3 x 40 poses, bars 70 mm, holes 60 mm apart"),
    Case("the same, robots 0.6 times as far off", spread=0.6),
    Case("the same, robots 3 times as far off", spread=3.0),
    Case("without priors", prior=False),
    Case("3 x 20 poses", poses=20),
    Case("3 x 12 poses", poses=12),
    Case("3 x 8 poses, without priors", poses=8, prior=False),
    Case("bars of 50 mm", vs.Plate(bar=0.05)),
    Case("bars of 30 mm", vs.Plate(bar=0.03)),
    Case("bars of 15 mm", vs.Plate(bar=0.015)),
    Case("hole distance unknown (1 mm)", free=("*.hole2.x",)),
    Case("bar lengths unknown (1 mm)", free=("*.bar?.length",)),
    Case("hole distance and bar lengths unknown", free=("*.hole2.x", "*.bar?.length")),
    Case("holes 20 mm apart", vs.Plate(holes=((-0.01, 0.0), (0.01, 0.0)))),
    Case("one hole", vs.Plate(holes=HOLES[:1])),
    Case("no hole: Hornick's plane alone, 40 poses", vs.Plate(holes=())),
    Case("no hole, 120 poses", vs.Plate(holes=()), poses=120),
)


def model_of(case: Case) -> Model:
    """Model 24 with the case's plate."""
    plate = case.plate
    bars = (plate.bar,) * len(plate.holes)
    sensor = load_sensor(
        "plane_spheres", height=plate.height, holes=plate.holes, bars=bars, sigma=plate.sigma
    )
    return new_model("delta24", sensors=[sensor])


def one(case: Case, seed: int) -> tuple[float, float, bool, Estimate]:
    """Errors before and after (m) of one robot, whether it was trapped, and the estimate."""
    robot, model = vs.random_delta(seed, case.spread), model_of(case)
    free = ~model.fixed | (model.table.matching(case.free) if case.free else False)
    readings, ties = case.plate.session(robot, case.poses, seed)
    observations = observe(model, dataset(case.plate, readings, ties))
    found = estimate(model, observations, free, prior=case.prior)
    truth = model.table.vector({n: robot.parameters[n] for n in model.mechanism.parameters.names})
    from_truth = estimate(model.with_values(truth), observations, free, prior=case.prior)
    joints, where = vs.workspace(robot)
    before, after = (
        error(model.with_values(v), joints, where) for v in (model.values, found.values)
    )
    return before, after, abs(found.chi2 - from_truth.chi2) > 0.01, found


def error(model: Model, joints: np.ndarray, where: np.ndarray) -> float:
    """Mean position error of a model (m)."""
    return float(np.linalg.norm(Kinematics(model).direct(joints).position - where, axis=1).mean())


def with_device(robots: int) -> str:
    """The same robots by a position device (10 um) at 120 poses all over the workspace."""
    after, model = [], new_model("delta24")
    for seed in range(robots):
        robot, rng = vs.random_delta(seed), np.random.default_rng(seed)
        joints, where = vs.workspace(robot, 120, seed + 1000)
        data = Dataset.from_arrays(
            model.joints,
            joints + rng.normal(0, vs.Plate.joint, joints.shape),
            where + rng.normal(0, 10e-6, where.shape),
            pose_cov=np.diag([1e-10] * 3 + [1.0] * 3),
            joint_sigma=[vs.Plate.joint] * 3,
        )
        found = estimate(model, observe(model, data), ~model.fixed, prior=True)
        after.append(error(model.with_values(found.values), *vs.workspace(robot)))
    return (
        f"{'a position device (10 um), 120 poses everywhere':56s} {'':10s} "
        f"{np.median(after) * 1e6:8.0f} {np.quantile(after, 0.95) * 1e6:8.0f} "
        f"{np.max(after) * 1e6:8.0f}"
    )


def line(case: Case, robots: int) -> str:
    """One row of the table."""
    rows, failed = [], 0
    for seed in range(robots):
        try:
            rows.append(one(case, seed))
        except (FitError, ValueError):
            failed += 1
    if not rows:
        return f"{case.name:56s} no fit: too few equations, or not converged"
    before, after = (np.array([row[k] for row in rows]) for k in (0, 1))
    last = rows[-1][3].spectrum
    return (
        f"{case.name:56s} {before.min() * 1e3:5.2f}-{before.max() * 1e3:.2f} "
        f"{np.median(after) * 1e6:8.0f} {np.quantile(after, 0.95) * 1e6:8.0f} "
        f"{after.max() * 1e6:8.0f} {sum(row[2] for row in rows):5d} {failed:5d} "
        f"{last.rank:5d} {len(last.unidentifiable):5d} {len(last.weak):5d}"
    )


def main() -> None:
    robots = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    print(f"{robots} robots a row; errors of the whole workspace")
    print(f"{'':56s} before/mm  median/um   95%/um   max/um trapped none rank lost weak")
    with single_threaded():
        print(with_device(robots), flush=True)
        for case in CASES:
            print(line(case, robots), flush=True)


if __name__ == "__main__":
    main()
