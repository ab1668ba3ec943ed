"""Model 54 in half steps: position from G1, orientation from G2, in turn (6.4.2-6.4.4).

For mechanisms whose first three closure rows are spheres in the position and whose last three
give the orientation (Delta 54). Both halves come from the closure itself: G1 by the closed
forms of chapter 6, G2 linearised about the orientation reached so far.

Kept as the thesis' own; prefer it where a controller must answer in a fixed number of operations.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.errors import SolveError
from parallel_cal.base.rotation import cayley, left_generators
from parallel_cal.kinematics.evaluating import (
    check_step_count,
    evaluate_solver,
    half_step_function,
    is_pose_unaffected,
    match_shape,
)
from parallel_cal.kinematics.kinematics import Solutions
from parallel_cal.kinematics.rows import joint_rows, pose_rows
from parallel_cal.model.closed_form import joint_angles, positions
from parallel_cal.model.effect import Seen
from parallel_cal.model.mechanism import POSE, nearest
from parallel_cal.model.model import Model
from parallel_cal.model.parameters import Named
from parallel_cal.model.structure import Structure

HALF_STEPS = 3  # G1, G2, G1: one and a half iterations (6.4.5)
TOLERANCE = 1e-6  # m: expected accuracy after so few steps
PERFECT = "P1"  # the group of parameters that vanish in a perfect parallelogram
N_EFFECT_PASSES = 3  # passes that undo joint effects; each one multiplies the error by their slope


def direct(
    model: Model,
    q: np.ndarray,
    at: Mapping[str, Any] | None = None,
    half_steps: int = HALF_STEPS,
    rough: bool = False,
    tolerance: float = TOLERANCE,
) -> Solutions:
    """Find poses for joints (nq,) or (N, nq) by half steps; `rough` uses eq. 6.33 instead."""
    solve = direct_function(model.structure, 0 if rough else check_step_count(half_steps))
    return match_shape(
        evaluate_solver(model, solve, joint_rows(model, q), at, tolerance, "direct"), q
    )


def inverse(
    model: Model,
    position: np.ndarray,
    rotation: np.ndarray | None = None,
    at: Mapping[str, Any] | None = None,
    half_steps: int = HALF_STEPS,
    rough: bool = False,
    tolerance: float = TOLERANCE,
) -> Solutions:
    """Find joints, and the resulting orientation, for positions (3,) or (N, 3)."""
    solve = inverse_function(model.structure, 0 if rough else check_step_count(half_steps))
    given = pose_rows(model, position, None)
    return match_shape(evaluate_solver(model, solve, given, at, tolerance, "inverse"), position)


@lru_cache(maxsize=32)
def direct_function(s: Structure, half_steps: int) -> ca.Function:
    """Build (configuration, a, v) -> configuration with the solved pose; 0 half steps: eq. 6.33."""
    ideal = _check_structure(s)
    p = ideal.p if half_steps else _perfect(ideal.p, s)
    turn, r, R = _orientation(s, ideal.q, p, ideal.p), s.r, ca.SX.eye(3)
    near = s.mechanism.start(ideal.q, p)[0]  # on the branch of home
    for k in range(max(half_steps, 2)):
        if k % 2:
            R = turn(r, R)
        else:
            r = nearest(positions(s.mechanism, ideal.q, p, R), lambda x: ca.sumsqr(x - near))
    return half_step_function("cascaded_direct", s, s.q, r, R)


@lru_cache(maxsize=32)
def inverse_function(s: Structure, half_steps: int) -> ca.Function:
    """Build (configuration, a, v) -> configuration with solved joints and orientation."""
    if set(s.mechanism.joint_units) != {"rad"}:
        raise SolveError(
            "the cascaded inverse problem needs revolute joints (eqs 6.36-6.37); "
            f"those of {s.mechanism.name} are prismatic: use --solver newton"
        )
    seen, q, R = _check_structure(s), ca.SX(ca.DM(s.mechanism.home.joints)), ca.SX.eye(3)
    for k in range(max(half_steps, 2)):
        for _ in range(N_EFFECT_PASSES if s.effects and k % 2 == 0 else 1):
            # The mechanism's joints and geometry at the current joint readings q
            ideal_q, vector = ca.substitute([seen.q, ca.SX(seen.p._vector)], [s.q], [q])
            complete = Named(seen.p._names, vector)
            p = complete if half_steps else _perfect(complete, s)
            if k % 2:
                R = _orientation(s, ideal_q, p, complete)(s.r, R)
            else:
                both = joint_angles(s.mechanism, s.r, R, p)  # eqs 6.36-6.37
                change = s.mechanism.select_home_branch(both) - ideal_q
                q = q + ca.atan2(ca.sin(change), ca.cos(change))  # without whole turns
    return half_step_function("cascaded_inverse", s, q, s.r, R)


def _orientation(s: Structure, q: Any, p: Named, complete: Named) -> Any:
    """Make (r, R) -> R, one linear solution of G2 (eq. 6.39).

    Parameters of `complete` that differ from p enter to first order. Like eq. 6.33, this omits
    all products of small quantities.
    """
    r, R9, missing = ca.SX.sym("r", 3), ca.SX.sym("R", 9), complete._vector - p._vector
    R = ca.reshape(R9, 3, 3).T
    v = ca.SX.sym("p", missing.shape[0])
    rows = s.mechanism.closure(q, r, R, Named(p._names, v))[3:]
    J = ca.jacobian(rows, R9) @ left_generators(R)
    value = rows if complete is p else rows + ca.jtimes(rows, v, missing)
    value, J = ca.substitute([value, J], [v], [p._vector])

    def turned(r_now: Any, R_now: Any) -> Any:
        here = [r_now, ca.densify(ca.vec(ca.SX(R_now).T))]
        phi, slope = ca.substitute([value, J], [r, R9], here)
        return cayley(-ca.inv_minor(slope) @ phi) @ R_now

    return turned


def _perfect(p: Named, s: Structure) -> Named:
    """Geometry with perfect parallelograms (model 24), for the first set of eq. 6.33."""
    errors = {row.name: 0.0 for row in s.mechanism.parameters if row.group == PERFECT}
    if not errors:
        raise SolveError(f"mechanism {s.mechanism.name} has no rough model (no group {PERFECT})")
    return p.replaced(errors)


def _rotation_rank(s: Structure, rows: Any) -> int:
    """Count the directions of rotation that change some rows of the nominal robot at home."""
    slope = ca.jacobian(rows, s.R9) @ left_generators(s.R)
    at_home = ca.Function("slope", [s.configuration, s.v], [slope])(
        s.mechanism.home.configuration, s.table.nominal
    )
    return int(np.linalg.matrix_rank(np.array(at_home)))


def _check_structure(s: Structure) -> Seen:
    """Inputs of the mechanism after the effects; SolveError if cascading is impossible."""
    rows = s.mechanism.closure(*s.mechanism.arguments(s.q, s.u, s.r, s.R, s.geometry))
    halves = s.mechanism.moves == POSE and rows.shape[0] == 6 and len(s.q.nz) == 3
    curvature = [ca.hessian(row, s.r)[0] for row in ca.vertsplit(rows)] if halves else []
    spheres = all(c.sparsity().is_diag() for c in curvature[:3])
    planes = all(c.is_zero() for c in curvature[3:])
    if not (halves and spheres and planes and _rotation_rank(s, rows[3:]) == 3):
        raise SolveError(
            "the cascaded solver needs three closure rows that are spheres and three "
            f"that determine the orientation; {s.mechanism.name} has not: use "
            "--solver newton"
        )
    if not is_pose_unaffected(s):
        raise SolveError("an effect depends on the pose: use --solver newton for this model")
    return s.seen
