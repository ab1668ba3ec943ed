"""Tables 5.7, 5.9 and 5.11, figures 5.5 to 5.10: every method on the slider-crank (5.3).

The thesis prints neither its 30 points nor its noise. Here x is evenly spaced from 33 to 127 mm on
the branch of positive crank angles: the whole workspace across the direct singularity at 62.4 mm,
as figure 5.5 has it, whose points 8 to 13 then lie about that singularity as in 5.3.4.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from bench.documents.tables import optimisers
from bench.documents.tables.common import (
    ARCMIN,
    ARCSECOND,
    DEGREE,
    MM,
    UM,
    distribution,
    plain_forward,
    plain_inverse,
)
from parallel_cal.identification.methods import implicit
from parallel_cal.identification.methods.implicit import Estimate
from parallel_cal.identification.observations import Observations
from parallel_cal.model.model import Model, new_model
from parallel_cal.thesis.methods import cascaded, linear, semiparametric

TRUTH = np.array([80.2 * MM, 50.1 * MM, 1 * DEGREE])  # a, b, q0 (eq. 5.13)
SIGMA_X, SIGMA_Q = 0.02 * MM, 2 * ARCMIN  # eq. 5.14
POINTS, FIRST, LAST = 30, 33 * MM, 127 * MM
AWAY = np.array([i for i in range(POINTS) if not 7 <= i <= 12])  # without points 8 to 13 (5.3.4)
Method = Callable[[Model, Observations, np.ndarray], Estimate]

METHODS: dict[str, Method] = {
    "implicit": partial(implicit.estimate, weighted=False),
    "forward": lambda model, observations, free: plain_forward(
        model, observations.select(AWAY), free
    ),
    "inverse": plain_inverse,
    "linear": partial(linear.estimate, weighted=False),
    "cascaded": cascaded.estimate,
    "semiparametric": semiparametric.estimate,
    "implicit, weighted (ours)": implicit.estimate,
}
QUANTITIES = {"a": "um", "b": "um", "q0": "arcsec", "Q": "mm^4", "F_pos": "", "F_joint": ""}
TABLE_5_11 = {  # truth minus estimate of a, b, q0; merit Q; factors of improvement
    "implicit": (4, -7, -35, 614, 17.9, 29.3),
    "forward": (34, 40, -141, 745, 18.4, 28.4),
    "inverse": (-8, -15, -54, 625, 17.1, 29.3),
    "linear": (16, 13, -43, 749, 12.1, 26.2),
    "cascaded": (-24, -56, -181, 688, 12.1, 26.2),
    "semiparametric": (4, -7, -35, 614, 17.9, 29.3),
}
TABLE_5_7 = {
    "newton": 4,
    "gauss_newton_normal": 3,
    "gauss_newton_svd": 3,
    "levenberg_marquardt": 3,
    "steepest_descent": 72,
}
EQ_5_19 = np.array([80.196 * MM, 50.107 * MM, 1.010 * DEGREE])
MERIT_BEFORE = 319_829.0  # mm^4 (figure 5.8)


def joints_of(x: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Eq. 5.12, positive branch."""
    a, b, q0 = values
    return np.asarray(np.arccos(np.clip((a**2 + x**2 - b**2) / (2 * x * a), -1, 1)) - q0)


def position_errors(values: np.ndarray, q: np.ndarray, x: np.ndarray) -> np.ndarray:
    """|dx| (m) by eq. 5.11 and its nearer branch. Where a crank angle is out of the identified
    mechanism's reach the root is complex, and its modulus counts, as Mathematica would have it."""
    a, b, q0 = values
    root = np.sqrt((b**2 - a**2 * np.sin(q + q0) ** 2).astype(complex))
    return np.asarray(np.abs(a * np.cos(q + q0) + np.array([[1], [-1]]) * root - x).min(axis=0))


def residuals(values: np.ndarray, q: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Eq. 5.16 in mm^2."""
    a, b, q0 = values
    return np.asarray((a**2 + x**2 - b**2 - 2 * a * x * np.cos(q + q0)) / MM**2)


def measured(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Figure 5.4: evenly spaced x, its crank angles, and noise on both: q (rad), x (m)."""
    rng, x = np.random.default_rng(seed), np.linspace(FIRST, LAST, POINTS)
    q = joints_of(x, TRUTH) + SIGMA_Q * rng.standard_normal(POINTS)
    return q, x + SIGMA_X * rng.standard_normal(POINTS)


def as_observations(q: np.ndarray, x: np.ndarray) -> Observations:
    n = len(q)
    rows = np.hstack([q[:, None], x[:, None], np.zeros((n, 2)), np.tile(np.eye(3).ravel(), (n, 1))])
    S = np.tile(np.diag([SIGMA_Q**2] + [SIGMA_X**2] * 6), (n, 1, 1))
    none = np.zeros((n, 0))
    return Observations(rows, S, np.ones((n, 7), dtype=bool), none, np.arange(n), none, {})


def numbers(draws: int = 1000) -> dict[str, Any]:
    """Everything of this chapter over noise draws with the seeds 0, 1, ..."""
    model, data = new_model("slider_crank"), [measured(seed) for seed in range(draws)]
    found = {name: np.array([one(model, f, *d) for d in data]) for name, f in METHODS.items()}
    before = np.array([np.sum(residuals(model.values, *d) ** 2) for d in data])
    return {
        "draws": draws,
        "points": {"number": POINTS, "first_mm": FIRST / MM, "last_mm": LAST / MM},
        "merit_before_mm4": distribution(before, MERIT_BEFORE),
        "iterations": optimiser_table(model, data[: min(draws, 200)]),
        "methods": {name: row(name, values[:, 3:]) for name, values in found.items()},
        "figures": figures(model, data[0], found["implicit"][:, :3]),
    }


def one(model: Model, method: Method, q: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Estimate; truth minus estimate (um, um, arcsec); Q (mm^4); F^Pos and F^Joint (table 5.9)."""
    found = method(model, as_observations(q, x), np.ones(3, dtype=bool)).values
    error = (TRUTH - found) / [UM, UM, ARCSECOND]
    sums = [
        np.array([position_errors(v, q, x).sum(), np.abs(q - joints_of(x, v)).sum()])
        for v in (model.values, found)
    ]
    return np.array([*found, *error, np.sum(residuals(found, q, x) ** 2), *(sums[0] / sums[1])])


def row(name: str, values: np.ndarray) -> dict[str, Any]:
    printed = TABLE_5_11.get(name, (None,) * len(QUANTITIES))
    return {
        key: distribution(sample, number)
        for key, sample, number in zip(QUANTITIES, values.T, printed, strict=True)
    }


def optimiser_table(model: Model, data: list[tuple[np.ndarray, np.ndarray]]) -> dict[str, Any]:
    """Iterations until Q changes by less than 1e-4 of itself, lengths in units of a (5.3.2)."""
    unit, twice_b = np.array([80 * MM, 80 * MM, 1.0]), 2 * model.structure.v[1]
    counts: dict[str, list[float]] = {name: [] for name in TABLE_5_7}
    for q, x in data:
        problem = optimisers.closure_problem(model, as_observations(q, x), unit, twice_b)
        for name, steps in counts.items():
            end = getattr(optimisers, name)(problem, model.values / unit, epsilon=1e-4)
            steps.append(end.iterations)
    return {name: distribution(np.array(steps), TABLE_5_7[name]) for name, steps in counts.items()}


def figures(
    model: Model, data: tuple[np.ndarray, np.ndarray], found: np.ndarray
) -> dict[str, dict[str, Any]]:
    """What figures 5.5, 5.8 (draw 0) and 5.10 (all draws) show."""
    x = np.linspace(FIRST, LAST, 48)
    true = joints_of(x, TRUTH)
    off = np.array([true - joints_of(x, values) for values in found]) / ARCMIN
    return {
        "5.5": {"q_deg": (data[0] / DEGREE).tolist(), "x_mm": (data[1] / MM).tolist()},
        "5.8": {
            "before_mm2": residuals(model.values, *data).tolist(),
            "after_mm2": residuals(found[0], *data).tolist(),
        },
        "5.10": {
            "x_mm": (x / MM).tolist(),
            "printed_arcmin": ((true - joints_of(x, EQ_5_19)) / ARCMIN).tolist(),
            "quantiles_arcmin": np.percentile(off, [0.5, 5, 95, 99.5], axis=0).tolist(),
        },
    }
