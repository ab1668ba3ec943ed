"""Newton's method with a chosen number of steps, with or without Jacobian updates (6.4.1).

Eq. 6.31 is one step with the Jacobian of the start. Without updating, a step costs one
evaluation of the closure and converges linearly; with updating it converges quadratically.

Kept as the thesis' own; prefer it where a controller shall take a fixed number of steps.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.compiled import dense
from parallel_cal.base.errors import SolveError
from parallel_cal.kinematics.elimination import Elimination, find_blocks
from parallel_cal.kinematics.evaluating import check_step_count, evaluate_solver, match_shape
from parallel_cal.kinematics.kinematics import Solutions
from parallel_cal.kinematics.newton import apply_change, split
from parallel_cal.kinematics.rows import joint_rows, pose_rows
from parallel_cal.model.model import Model
from parallel_cal.model.structure import Structure

STEPS = 5
TOLERANCE = 1e-6  # m: expected accuracy after so few steps
STARTS = ("mechanism", "home")  # model 24's solution for a Delta; the centre of the workspace


def direct(
    model: Model,
    q: np.ndarray,
    at: Mapping[str, Any] | None = None,
    steps: int = STEPS,
    update: bool = False,
    start: str = "mechanism",
    tolerance: float = TOLERANCE,
) -> Solutions:
    """Find poses for joints (nq,) or (N, nq) by a number of steps."""
    solve = newton_steps(model.structure, "direct", check_step_count(steps), update, start)
    return match_shape(
        evaluate_solver(model, solve, joint_rows(model, q), at, tolerance, "direct"), q
    )


def inverse(
    model: Model,
    position: np.ndarray,
    rotation: np.ndarray | None = None,
    at: Mapping[str, Any] | None = None,
    steps: int = STEPS,
    update: bool = False,
    start: str = "mechanism",
    tolerance: float = TOLERANCE,
) -> Solutions:
    """Find joints for positions (3,) or (N, 3) and rotations by a number of steps."""
    solve = newton_steps(model.structure, "inverse", check_step_count(steps), update, start)
    given = pose_rows(model, position, rotation)
    return match_shape(evaluate_solver(model, solve, given, at, tolerance, "inverse"), position)


@lru_cache(maxsize=32)
def newton_steps(
    s: Structure, problem: str, steps: int, update: bool = False, start: str = "mechanism"
) -> ca.Function:
    """Build (configuration, a, v) -> configuration after a number of steps of eq. 6.31."""
    if start not in STARTS:
        raise SolveError(f"no start '{start}'; there are {', '.join(STARTS)}")
    columns, _, begin = split(s, problem)
    # The given rows contain the given coordinates, and home for all others (`rows`).
    x = begin if start == "mechanism" else s.configuration
    J = s.differentiate_closure(columns)
    if J.shape[0] != J.shape[1]:
        raise SolveError(f"{s.mechanism.name} has more closure rows than unknowns; use newton")
    blocks = find_blocks(s, J, np.array(s.mechanism.home.configuration))
    inputs = [s.configuration, s.a, s.v]
    phi, slope = dense("phi", inputs, [s.phi]), dense("slope", inputs, [J])
    solver = Elimination(slope(x, s.a, s.v), blocks)
    for k in range(steps):
        if update and k:
            solver = Elimination(slope(x, s.a, s.v), blocks)
        x = apply_change(s, x, columns, solver(-phi(x, s.a, s.v)))
    return dense(f"newton_{problem}", inputs, [x])
