"""Tables 5.7, 5.9 and 5.11 again: every method on the slider-crank, beside the thesis.

The thesis prints neither its 30 points nor its noise. Here x is evenly spaced from 33 to 127 mm on
the branch of positive crank angles: the whole workspace across the direct singularity at 62.4 mm,
as figure 5.5 has it. That range gives Q(nominal) = 321000 mm^4 where figure 5.8 says 319829.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from time import perf_counter

import numpy as np
from rich.console import Console
from rich.table import Table

from parallel_cal.errors import ParallelCalError
from parallel_cal.evidence import Evidence
from parallel_cal.identification import single_threaded
from parallel_cal.methods import _optimisers as optimisers
from parallel_cal.methods import cascaded, forward, implicit, inverse, linear, semiparametric
from parallel_cal.model import Model, new_model

MM, DEGREE, ARCSECOND = 1e-3, np.pi / 180, np.pi / 180 / 3600
TRUTH = {"a": 80.2 * MM, "b": 50.1 * MM, "q0": 1 * DEGREE}
SIGMA_X, SIGMA_Q = 0.02 * MM, 2 / 60 * DEGREE
POINTS, FIRST, LAST = 30, 33 * MM, 127 * MM
DRAWS = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
UNITS = np.array([MM, MM, DEGREE])
Estimator = Callable[..., implicit.Estimate]

METHODS: dict[str, tuple[Estimator, str]] = {  # and what table 5.11 prints
    "implicit (thesis: no weights)": (
        partial(implicit.estimate, weighted=False),
        "4, -7, -35 | 614, 17.9, 29.3",
    ),
    "implicit, weighted": (implicit.estimate, "-"),
    "forward, weighted": (forward.estimate, "34, 40, -141 | 745, 18.4, 28.4"),
    "inverse, weighted": (inverse.estimate, "-8, -15, -54 | 625, 17.1, 29.3"),
    "linear (no weights)": (
        partial(linear.estimate, weighted=False),
        "16, 13, -43 | 749, 12.1, 26.2",
    ),
    "cascaded": (cascaded.estimate, "-24, -56, -181 | 688, 12.1, 26.2"),
    "semiparametric": (semiparametric.estimate, "4, -7, -35 | 614, 17.9, 29.3"),
}
OPTIMISERS = {  # iterations in table 5.7
    "newton": 4,
    "gauss_newton_normal": 3,
    "gauss_newton_svd": 3,
    "levenberg_marquardt": 3,
    "steepest_descent": 72,
}


def joints_of(x: np.ndarray, a: float, b: float, q0: float) -> np.ndarray:
    """Eq. 5.12, positive branch."""
    return np.asarray(np.arccos(np.clip((a**2 + x**2 - b**2) / (2 * x * a), -1, 1)) - q0)


def slider_of(q: np.ndarray, near: np.ndarray, a: float, b: float, q0: float) -> np.ndarray:
    """Eq. 5.11, of both branches the nearer; where there is none, the singularity between."""
    away = np.sqrt(np.maximum(b**2 - a**2 * np.sin(q + q0) ** 2, 0))
    both = a * np.cos(q + q0) + np.array([1, -1])[:, None] * away
    return np.asarray(np.where(np.abs(both[0] - near) < np.abs(both[1] - near), *both))


def measured(rng: np.random.Generator) -> Evidence:
    """Figure 5.4: even x, its joint angles, and noise on both."""
    x = np.linspace(FIRST, LAST, POINTS)
    q = joints_of(x, **TRUTH) + SIGMA_Q * rng.standard_normal(POINTS)
    rows = np.zeros((POINTS, 13))
    rows[:, 0], rows[:, 1] = q, x + SIGMA_X * rng.standard_normal(POINTS)
    rows[:, 4:] = np.eye(3).ravel()
    S = np.tile(np.diag([SIGMA_Q**2] + [SIGMA_X**2] * 6), (POINTS, 1, 1))
    seen = np.ones((POINTS, 7), dtype=bool)
    return Evidence(
        rows, S, seen, np.zeros((POINTS, 0)), np.arange(POINTS), np.zeros((POINTS, 0)), {}
    )


def merit(values: np.ndarray, evidence: Evidence) -> float:
    """Q of eq. 5.16 in mm^4."""
    (a, b, q0), q, x = values, evidence.x[:, 0], evidence.x[:, 1]
    return float(np.sum((a**2 + x**2 - b**2 - 2 * a * x * np.cos(q + q0)) ** 2) / MM**4)


def error_sums(values: np.ndarray, evidence: Evidence) -> np.ndarray:
    """Sums of |dx| and |dq| over all points (table 5.9)."""
    q, x = evidence.x[:, 0], evidence.x[:, 1]
    return np.array(
        [np.abs(x - slider_of(q, x, *values)).sum(), np.abs(q - joints_of(x, *values)).sum()]
    )


def optimiser_table(model: Model, console: Console) -> None:
    table = Table("table 5.7", "iterations", "thesis", "ms", "Q, mm^4", title="Optimisers")
    unit = np.array([80 * MM, 80 * MM, 1.0])
    evidence = measured(np.random.default_rng(0))
    problem = optimisers.closure_problem(model, evidence, unit, 2 * model.structure.v[1])
    for name, printed in OPTIMISERS.items():
        start = perf_counter()
        end = getattr(optimisers, name)(problem, model.values / unit, epsilon=1e-4)
        ms = f"{(perf_counter() - start) * 1e3:.2f}"
        table.add_row(name, str(end.iterations), str(printed), ms, f"{end.merit / MM**4:.3f}")
    console.print(table)


def one_draw(model: Model, estimator: Estimator, evidence: Evidence) -> np.ndarray:
    """Truth minus estimate (mm, mm, degrees), Q, F^Pos, F^Joint; NaN where the method fails."""
    try:
        found = estimator(model, evidence, np.ones(3, dtype=bool)).values
    except (ParallelCalError, np.linalg.LinAlgError):
        return np.full(6, np.nan)
    factors = error_sums(model.values, evidence) / error_sums(found, evidence)
    return np.array(
        [*(np.array([*TRUTH.values()]) - found) / UNITS, merit(found, evidence), *factors]
    )


def method_table(model: Model, console: Console) -> None:
    table = Table(
        "tables 5.9, 5.11", "spread a, b (um), q0 (\")", "bias", "Q mm^4", "F^Pos", "F^Joint",
        "failed", "ms", "thesis, one draw: p0-p | Q, F^Pos, F^Joint",
        title=f"{DRAWS} noise draws: median (and 5..95 %)",
    )  # fmt: skip
    evidences = [measured(np.random.default_rng(seed)) for seed in range(DRAWS)]
    for name, (estimator, printed) in METHODS.items():
        start = perf_counter()
        rows = np.array([one_draw(model, estimator, e) for e in evidences])
        ms = (perf_counter() - start) / DRAWS * 1e3
        failed = int(np.isnan(rows[:, 0]).sum())
        rows = rows[np.isfinite(rows).all(axis=1)]
        errors = rows[:, :3] * [1000, 1000, 3600]
        spread, bias = errors.std(axis=0, ddof=1), errors.mean(axis=0)
        low, mid, high = np.percentile(rows[:, 3:], [5, 50, 95], axis=0)
        cells = [f"{m:.3g} ({l:.3g}..{h:.3g})" for l, m, h in zip(low, mid, high, strict=True)]
        words = [", ".join(f"{v:.0f}" for v in part) for part in (spread, bias)]
        table.add_row(name, *words, *cells, str(failed), f"{ms:.2f}", printed)
    console.print(table)


def main() -> None:
    console, model = Console(width=170), new_model("slider_crank")
    draws = [merit(model.values, measured(np.random.default_rng(s))) for s in range(100)]
    console.print(f"Q(nominal) = {np.mean(draws):.0f} mm^4 (thesis 319829)")
    with single_threaded():
        optimiser_table(model, console)
        method_table(model, console)


if __name__ == "__main__":
    main()
