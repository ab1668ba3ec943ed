"""Configurations from given joints or poses, with the unknown part at home."""

from __future__ import annotations

import numpy as np

from parallel_cal.base.arguments import require
from parallel_cal.base.errors import SolveError
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.model import Model

LIMIT_ROUNDING = 1e-9  # rad or m, that a solution of the equations may be wrong


def joint_rows(model: Model, q: np.ndarray) -> np.ndarray:
    """Build configurations (N, nq + 12 + nu) with joints (nq,) or (N, nq), the platform at home."""
    require("q", q, "ArrayLike", SolveError)
    q = np.atleast_2d(np.asarray(q, dtype=float))
    n = len(model.joints)
    if q.shape[1] != n:
        raise SolveError(
            f"{q.shape[1]} joint values given, but {model.mechanism.name} has {n} "
            f"joints: {', '.join(model.joints)}"
        )
    rows = np.tile(model.mechanism.home.configuration, (len(q), 1))
    rows[:, :n] = q
    return rows


def pose_rows(model: Model, position: np.ndarray, rotation: np.ndarray | None) -> np.ndarray:
    """Build configurations (N, nq + 12 + nu) with the given poses and the joints at home."""
    require("position", position, "ArrayLike", SolveError)
    require("rotation", rotation, "ArrayLike | None", SolveError)
    r = np.atleast_2d(np.asarray(position, dtype=float))
    if r.shape[1] != 3:
        raise SolveError(f"a position has 3 coordinates (m), but {r.shape[1]} are given")
    n = len(model.joints)
    rows = np.tile(model.mechanism.home.configuration, (len(r), 1))
    rows[:, n : n + 3] = r
    if rotation is not None:
        R = np.asarray(rotation, dtype=float)
        if R.shape not in ((3, 3), (len(r), 3, 3)):
            raise SolveError(
                f"rotation has the shape {R.shape}; expected (3, 3) or ({len(r)}, 3, 3), as there "
                f"are {len(r)} positions"
            )
        rows[:, n + 3 : n + 12] = R.reshape(-1, 9)
    return rows


def limits_in(problem: str, mechanism: Mechanism) -> np.ndarray:
    """Return the limits (nq, 2) of the joints, rad or m; in the `inverse` problem wider by the
    rounding of a solution, because a machine that was homed stands exactly at its limits."""
    limits = np.array(mechanism.joint_limits, dtype=float).reshape(-1, 2)
    rounding = LIMIT_ROUNDING if problem == "inverse" else 0.0
    return limits + rounding * np.array([-1.0, 1.0])
