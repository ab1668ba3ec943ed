"""Model 27 of the Argos in half steps: orientation from G1, position from G2, in turn (6.7).

The order is opposite to that of the Delta. If the centre is known, G1 gives the orientation (by
Newton's method) or the motors (in closed form). If these are known, G2 is three spheres for the
centre.

Kept as the thesis' own; prefer it where an Argos' controller must answer in fixed time.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.errors import SolveError
from parallel_cal.base.rotation import cayley
from parallel_cal.kinematics.evaluating import (
    check_step_count,
    evaluate_solver,
    half_step_function,
    match_shape,
)
from parallel_cal.kinematics.rows import joint_rows, pose_rows
from parallel_cal.kinematics.solutions import Solutions
from parallel_cal.model.closed_form import joint_angles, positions
from parallel_cal.model.mechanism import POSE, Mechanism, nearest
from parallel_cal.model.model import Model
from parallel_cal.model.parameters import Named
from parallel_cal.model.structure import Structure

HALF_STEPS = 12  # G1 and G2 six times: an error of about 10 nm within the tolerances
NEWTON_STEPS = 2  # per half step of G1
TOLERANCE = 1e-6  # m: expected accuracy after so few steps


def direct(
    model: Model,
    q: np.ndarray,
    at: Mapping[str, Any] | None = None,
    half_steps: int = HALF_STEPS,
    tolerance: float = TOLERANCE,
) -> Solutions:
    """Find poses for joints (nq,) or (N, nq) by half steps (6.7.2)."""
    solve = direct_function(model.structure, check_step_count(half_steps))
    return match_shape(
        evaluate_solver(model, solve, joint_rows(model, q), at, tolerance, "direct"), q
    )


def inverse(
    model: Model,
    position: np.ndarray,
    rotation: np.ndarray | None = None,
    at: Mapping[str, Any] | None = None,
    half_steps: int = HALF_STEPS,
    tolerance: float = TOLERANCE,
) -> Solutions:
    """Find joints, and the resulting position, for rotations (3, 3) or (N, 3, 3) (6.7.3)."""
    solve = inverse_function(model.structure, check_step_count(half_steps))
    given = pose_rows(model, position, rotation)
    return match_shape(evaluate_solver(model, solve, given, at, tolerance, "inverse"), position)


@lru_cache(maxsize=16)
def direct_function(s: Structure, half_steps: int) -> ca.Function:
    """Build (configuration, a, v) -> configuration with the solved pose."""
    ideal = _check_structure(s)
    _, R = s.mechanism.start(ideal.q, ideal.p)
    r = ca.SX(ca.DM(s.mechanism.home.position))
    w = ca.SX.sym("w", 3)
    for k in range(half_steps):
        if k % 2:
            r = _centre(s.mechanism, ideal.q, R, ideal.p, r)
        else:
            for _ in range(NEWTON_STEPS):  # on G1
                rows = s.mechanism.closure(ideal.q, r, R + ca.skew(w) @ R, ideal.p)[:3]
                phi, slope = ca.substitute([rows, ca.jacobian(rows, w)], [w], [ca.DM.zeros(3)])
                R = cayley(-ca.inv_minor(slope) @ phi) @ R
    return half_step_function("circles_direct", s, s.q, r, R)


@lru_cache(maxsize=16)
def inverse_function(s: Structure, half_steps: int) -> ca.Function:
    """Build (configuration, a, v) -> configuration with solved joints and position."""
    ideal = _check_structure(s)
    r, q = ca.SX(ca.DM(s.mechanism.home.position)), ca.SX(ca.DM(s.mechanism.home.joints))
    for k in range(half_steps):
        if k % 2:
            r = _centre(s.mechanism, q, s.R, ideal.p, r)
        else:
            q = s.mechanism.select_home_branch(joint_angles(s.mechanism, r, s.R, ideal.p))
    return half_step_function("circles_inverse", s, q, r, s.R)


def _centre(mechanism: Mechanism, q: Any, R: Any, p: Named, r: Any) -> Any:
    """The common point of G2's three spheres that is nearer to the current centre."""
    spheres: Any = _Spheres(mechanism)  # `positions` needs no more of a mechanism
    return nearest(positions(spheres, q, p, R), lambda x: ca.sumsqr(x - r))


class _Spheres:
    """A mechanism whose closure begins with G2, as `positions` expects."""

    def __init__(self, mechanism: Mechanism):
        self._mechanism = mechanism

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        return self._mechanism.closure(q, r, R, p)[3:]


def _check_structure(s: Structure) -> Any:
    """Inputs of the mechanism; SolveError unless it is an Argos without effects."""
    m = s.mechanism
    if not hasattr(m, "circles") or m.moves != POSE:
        raise SolveError(f"cascaded_circles is for argos27, not for {m.name}; use --solver newton")
    if s.effects:
        raise SolveError("cascaded_circles supports no effects; use --solver newton")
    return s.seen
