"""How good the paper's approximate inverse IPR_C is over a Delta's workspace.

Joints from each solver are given to the full model's direct problem; the error is how far the
platform then is from where it was asked to be. One row a solver and size of geometric error.

    python -m bench.documents.ipr_compensation [--poses 1000] [--robots 10] [--json]
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from time import perf_counter

import numpy as np

from parallel_cal.kinematics.kinematics import Kinematics, Solutions
from parallel_cal.model.model import Model, new_model
from parallel_cal.model.shelf import load_mechanism
from parallel_cal.thesis.solvers import ipr_compensation
from parallel_cal.virtual.robot import TABLE_5_18

SPREADS = (0.125, 0.25, 0.5, 1.0, 2.0)  # in tolerances


def drawn(mechanism: str, spread: float, rng: np.random.Generator) -> Model:
    """A robot whose parameters are off by `spread` tolerances (1 sigma)."""
    model = new_model(load_mechanism(mechanism))
    t, free = model.table, ~model.fixed
    return model.with_values(t.nominal + spread * t.tolerance * free * rng.standard_normal(len(t)))


def positions(model: Model, n: int, rng: np.random.Generator) -> np.ndarray:
    """n positions (m) in the workspace; coordinates that follow are left at home."""
    m = model.mechanism
    asked = np.tile(np.array(m.home.position), (n, 1))
    asked[:, m.controlled] = m.sample(n, rng)
    return asked


def errors(model: Model, asked: np.ndarray) -> dict[str, np.ndarray]:
    """Distance (m) from the asked position to where each solver's joints bring the robot."""
    found = solutions(model, asked)
    return {name: _missed(model, asked[s.ok], s.joints[s.ok]) for name, s in found.items()}


def solutions(model: Model, asked: np.ndarray) -> dict[str, Solutions]:
    nominal = Kinematics(model.with_values(model.table.nominal))
    return {
        "nominal": nominal.inverse(asked),
        "compensated": ipr_compensation.inverse(model, asked),
        "exact": Kinematics(model).inverse(asked),
    }


def _missed(model: Model, asked: np.ndarray, joints: np.ndarray) -> np.ndarray:
    reached, controlled = Kinematics(model).direct(joints), model.mechanism.controlled
    return np.linalg.norm((reached.position - asked)[:, controlled], axis=1)[reached.ok]


def study(mechanism: str, poses: int, robots: int, seed: int = 0) -> list[dict[str, float | str]]:
    """Mean and largest error (um) of each solver, for each size of the geometric errors."""
    rows = []
    for spread in SPREADS:
        rng = np.random.default_rng(seed)
        models = [drawn(mechanism, spread, rng) for _ in range(robots)]
        rows += _rows(f"{spread} tolerances", [errors(m, positions(m, poses, rng)) for m in models])
    return rows


def mock_up(poses: int) -> list[dict[str, float | str]]:
    """The same for the thesis' calibrated mock-up (table 5.18)."""
    model = new_model("delta54", TABLE_5_18)
    return _rows("table 5.18", [errors(model, positions(model, poses, np.random.default_rng(0)))])


def _rows(robot: str, found: list[dict[str, np.ndarray]]) -> list[dict[str, float | str]]:
    rows: list[dict[str, float | str]] = []
    for solver in found[0]:
        e = 1e6 * np.concatenate([one[solver] for one in found])
        rows.append({"robot": robot, "solver": solver, "mean_um": e.mean(), "max_um": e.max()})
    return rows


def timing(mechanism: str, n: int = 10_000) -> dict[str, float]:
    """Microseconds a pose, in batches."""
    model = drawn(mechanism, 1.0, np.random.default_rng(0))
    asked = positions(model, n, np.random.default_rng(1))
    exact = Kinematics(model)
    calls = {
        "compensated": lambda: ipr_compensation.inverse(model, asked),
        "exact": lambda: exact.inverse(asked),
    }
    return {name: _best(call) / n * 1e6 for name, call in calls.items()}


def _best(call: Callable[[], object], repeats: int = 3) -> float:
    times = []
    for _ in range(repeats):
        begin = perf_counter()
        call()
        times.append(perf_counter() - begin)
    return min(times)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--mechanism", default="delta54")
    options.add_argument("--poses", type=int, default=1000)
    options.add_argument("--robots", type=int, default=10)
    options.add_argument("--json", action="store_true")
    chosen = options.parse_args()
    if "x" not in load_mechanism(chosen.mechanism).controls:
        options.error(f"{chosen.mechanism} controls no position; the error shown is one")
    rows = study(chosen.mechanism, chosen.poses, chosen.robots)
    if chosen.mechanism == "delta54":
        rows += mock_up(chosen.poses)
    times = timing(chosen.mechanism)
    if chosen.json:
        print(json.dumps({"errors": rows, "microseconds_a_pose": times}))
        return
    print(f"{'robot':>16} {'solver':>12} {'mean um':>10} {'max um':>10}")
    for row in rows:
        print("{robot:>16} {solver:>12} {mean_um:>10.3f} {max_um:>10.3f}".format(**row))
    print(", ".join(f"{name} {t:.1f} us a pose" for name, t in times.items()))


if __name__ == "__main__":
    main()
