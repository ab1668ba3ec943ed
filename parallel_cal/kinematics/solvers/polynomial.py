"""General orientation problem (6.2.3) of a mechanism: every orientation, by one polynomial.

For mechanisms whose three closure rows fix the angle between a direction v_i of the platform and
a direction u_i of the base (Argos 9, section 6.6). Both follow from the closure itself.

Prefer it where every orientation of a spherical robot is wanted, as --all does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.compiled import Single, dense
from parallel_cal.base.errors import SolveError
from parallel_cal.kinematics.evaluating import (
    order_from_home,
    solve_on_home_branch,
    with_status,
)
from parallel_cal.kinematics.kinematics import Solutions
from parallel_cal.kinematics.rows import joint_rows
from parallel_cal.kinematics.solvers._orientation import orientations
from parallel_cal.model.configuration import Configuration
from parallel_cal.model.model import Model
from parallel_cal.model.structure import Structure

ROTATIONS = ("rx", "ry", "rz")
TOLERANCE = 1e-10  # m: a closure residual below this is a solution


def direct_all(
    model: Model,
    q: np.ndarray,
    at: Mapping[str, Any] | None = None,
    form: str = "eigenvalue",
) -> Solutions:
    """Find all real orientations, at most eight, at joints q (nq,), the home branch first."""
    u, v, c = circles(model, q, at)
    R = orientations(u, v, c, form)
    x = Configuration(np.asarray(q), np.array(model.mechanism.home.position), R).rows
    found = with_status(model, x, at, TOLERANCE, "direct")
    return replace(order_from_home(model, found, at), complete=True)


def direct(
    model: Model,
    q: np.ndarray,
    at: Mapping[str, Any] | None = None,
    form: str = "eigenvalue",
) -> Solutions:
    """Find the orientation on the home branch for joints (nq,) or (N, nq); unreachable if none."""
    return solve_on_home_branch(model, q, at, partial(direct_all, form=form))


def circles(
    model: Model, q: np.ndarray, at: Mapping[str, Any] | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute u (3, 3), v (3, 3), c (3,) of u_i . R v_i = c_i at joints q, after the effects."""
    given = joint_rows(model, q)[0]
    slopes, rest = _circles(model.structure)(given, model.condition_rows(at, 1)[0], model.values)
    # A row of dphi/dR is u v^T, stored column by column; the rest of phi is -c.
    left, sizes, right = np.linalg.svd(slopes.reshape(9, 3).T.reshape(3, 3, 3))
    if (sizes[:, 1] > 1e-9 * sizes[:, 0]).any():
        raise _unfit(model.structure)
    return left[:, :, 0] * sizes[:, :1], right[:, 0], -rest


@lru_cache(maxsize=16)
def _circles(s: Structure) -> Single:
    """Compile (configuration, a, v) -> dphi/dR (3, 9) and the part of phi without R."""
    slopes = ca.jacobian(s.phi, s.R9)
    if s.mechanism.moves != ROTATIONS or s.phi.shape[0] != 3 or ca.depends_on(slopes, s.R9):
        raise _unfit(s)
    rest = ca.substitute(s.phi, s.R9, ca.DM.zeros(9))
    return Single(dense("circles", [s.configuration, s.a, s.v], [slopes, rest]))


def _unfit(s: Structure) -> SolveError:
    return SolveError(
        "the polynomial solver needs three closure rows u . R v = c that "
        f"determine the orientation; {s.mechanism.name} has not: use --solver "
        "newton"
    )
