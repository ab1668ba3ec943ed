"""Identification of very many poses: time and memory grow with their number, no faster.

Model 24 with all parameters free and model 54 with its 42; every coordinate measured. Memory is
what the fit adds at its peak to the samples themselves. Other numbers of poses may be given: 1e6.
"""

from __future__ import annotations

import sys
import time
import tracemalloc

import numpy as np
from rich.console import Console
from rich.table import Table

from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.base.threads import single_threaded
from parallel_cal.identification.methods.implicit import estimate
from parallel_cal.identification.observations import Observations
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import Model, new_model

SIGMA = np.repeat([1e-4, 1e-5, 1e-4], 3)  # rad, m, rad
COUNTS = (1_000, 10_000, 100_000)
MEGABYTE = 2**20


def measured(model: Model, n: int) -> Observations:
    """n noisy samples of a robot that strays from nominal by its tolerances."""
    rng = np.random.default_rng(0)
    off = model.table.tolerance * rng.standard_normal(len(model.values)) * ~model.fixed
    robot = Kinematics(model.with_values(model.values + off))
    true = robot.inverse(model.mechanism.sample(n, rng))
    e = SIGMA * rng.standard_normal((n, 9))
    turned = (rotation_matrix(e[:, 6:]) @ true.rotation).reshape(-1, 9)
    x = np.hstack([true.joints + e[:, :3], true.position + e[:, 3:6], turned])
    return Observations(
        x,
        np.tile(np.diag(SIGMA**2), (n, 1, 1)),
        np.ones((n, 9), bool),
        np.zeros((n, 0)),
        np.arange(n),
        np.zeros((n, 0)),
        {},
    )


def seconds(model: Model, observations: Observations) -> float:
    """Of the processor, the best of three: what else the machine does is not the fit's."""
    times = []
    for _ in range(3):
        begin = time.process_time()
        estimate(model, observations, ~model.fixed)
        times.append(time.process_time() - begin)
    return min(times)


def peak(model: Model, observations: Observations) -> float:
    tracemalloc.start()
    estimate(model, observations, ~model.fixed)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return most / MEGABYTE


def main() -> None:
    table = Table(
        "model",
        "poses",
        "CPU s",
        "us a pose",
        "ratio",
        "MB",
        "kB a pose",
        title="Identification of many poses",
    )
    with single_threaded():
        for name in ("delta24", "delta54"):
            model, first = new_model(name), 0.0
            for n in [int(float(count)) for count in sys.argv[1:]] or COUNTS:
                observations = measured(model, n)
                spent, memory = seconds(model, observations), peak(model, observations)
                first = first or spent / n
                table.add_row(
                    name,
                    str(n),
                    f"{spent:.3f}",
                    f"{spent / n * 1e6:.1f}",
                    f"{spent / n / first:.2f}",
                    f"{memory:.0f}",
                    f"{memory * 1024 / n:.2f}",
                )
    Console().print(table)


if __name__ == "__main__":
    main()
