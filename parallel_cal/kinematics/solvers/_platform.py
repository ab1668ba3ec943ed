"""All poses of one platform on six rods (6.2.4), by a homotopy from 40 stored poses.

Each rod is a quadric in the dual quaternion of the pose (eq. 6.19); seven quadrics have 40
proper zeros. The zeros of one generic platform are tracked to those of the given platform.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from parallel_cal.base.errors import SolveError
from parallel_cal.kinematics.kinematics import Solutions, Status
from parallel_cal.kinematics.solvers._quadrics import (
    MAX_CERTIFIED_ALPHA,
    Tracker,
    alpha,
    find_distinct,
    normalise,
    refine,
)
from parallel_cal.kinematics.solvers._study import poses, quadrics

START = Path(__file__).with_name("homotopy_start.json")
N_GENERIC_POSES = 40  # poses of a generic platform (Wampler, Husty, Raghavan)
NEARLY_REAL = 1e-3  # bound on the imaginary part of a real zero, even if ill-conditioned
AT_INFINITY = 1e-13  # |e.e| of a zero that is not a pose (e = 0 = g.g is a singular surface)


@dataclass(frozen=True)
class PoseSet:
    """All poses of one platform: the complex ones, and the real ones among them.

    position (k, 3) m and rotation (k, 3, 3) are complex; `certified` (k,) says which passed
    Smale's alpha test. `real` holds the real poses, certified to be real, residuals in m.
    `retries` counts how often the paths were tracked again; `complete`: all 40 were found, or
    other paths found no more.
    """

    position: np.ndarray
    rotation: np.ndarray
    certified: np.ndarray
    real: Solutions
    retries: int
    complete: bool

    @property
    def count_complex(self) -> int:
        return len(self.position)


def all_poses(C: np.ndarray, B: np.ndarray, L: np.ndarray, retries: int = 2) -> PoseSet:
    """Find every pose with |P + R B_i - C_i| = L_i: C and B (6, 3), L (6,), in m.

    Only regular poses count. At a singularity, or in a special geometry, some coincide or lie at
    infinity, and there are fewer than 40.
    """
    C, B, L = _check_platform(C, B, L)
    c, b = C.mean(axis=0), B.mean(axis=0)
    unit = np.sqrt((((C - c) ** 2).sum() + ((B - b) ** 2).sum() + (L**2).sum()) / 6)
    M = quadrics((C - c) / unit, (B - b) / unit, (L / unit) ** 2)
    X, used, complete = _zeros(M, retries)
    size, _ = alpha(X, M) if len(X) else (np.empty(0), None)
    position, rotation = poses(X)
    # A zero is known up to a complex factor: choose the factor that makes X.X real.
    square = (X**2).sum(axis=1)
    turned = X * np.sqrt(square.conj() / np.abs(square))[:, None]
    real = normalise(turned.real[np.abs(turned.imag).max(axis=1) < NEARLY_REAL])
    if len(real):  # Newton's method in real arithmetic proves each of them
        real = refine(real, M)
        real = real[alpha(real, M)[0] < MAX_CERTIFIED_ALPHA]
        real = real[find_distinct(real)]
    r, R = poses(real)
    # Undo the scaling and centring.
    position, r = position * unit + c - rotation @ b, r * unit + c - R @ b
    rods = r[:, None, :] + np.einsum("kij,nj->kni", R, B) - C
    residual = np.linalg.norm(np.linalg.norm(rods, axis=2) - L, axis=1)
    converged = np.full(len(r), Status.CONVERGED, dtype=np.int8)
    solutions = Solutions(np.empty((len(r), 0)), r, R, residual, converged)
    return PoseSet(position, rotation, size < MAX_CERTIFIED_ALPHA, solutions, used, complete)


@lru_cache(maxsize=1)
def start_system() -> tuple[np.ndarray, np.ndarray]:
    """The stored generic platform's quadrics (7, 8, 8) and their zeros (40, 8)."""
    stored = json.loads(START.read_text())
    # Complex numbers are stored as [real, imaginary].
    C, B, squares, zeros = (
        np.asarray(stored[k], dtype=float) @ np.array([1, 1j])
        for k in ("C", "B", "squares", "zeros")
    )
    return quadrics(C, B, squares), zeros


def _zeros(M: np.ndarray, retries: int) -> tuple[np.ndarray, int, bool]:
    """The distinct proper zeros of M, the number of retries, and whether the zeros are complete.

    A retry tracks other paths in shorter steps. It ends at 40 zeros, or if a retry adds none.
    """
    start, zeros = start_system()
    found = np.empty((0, 8), dtype=complex)
    for attempt in range(retries + 1):
        gamma = np.exp(2j * np.pi * np.random.default_rng(attempt).random())
        X, arrived = Tracker(start, M, gamma, 1e-5 * 0.1**attempt)(zeros)
        X = refine(X[arrived], M)
        # Proper zeros are regular and have a finite pose.
        size, beta = alpha(X, M)
        finite = np.abs((X[:, :4] ** 2).sum(axis=1)) > AT_INFINITY
        proper = X[finite & (size < MAX_CERTIFIED_ALPHA) & (beta < 1e-8)]
        before, found = len(found), np.concatenate([found, proper])
        found = found[find_distinct(found)]
        repeated = attempt > 0 and len(found) == before
        if len(found) >= N_GENERIC_POSES or (repeated and arrived.all()):
            break
    return found, attempt, len(found) >= N_GENERIC_POSES or repeated


def _check_platform(C: Any, B: Any, L: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    C, B, L = (np.asarray(a, dtype=float) for a in (C, B, L))
    if (C.shape, B.shape, L.shape) != ((6, 3), (6, 3), (6,)):
        raise SolveError(
            "a general pose problem has six base points (6, 3), platform points (6, "
            f"3) and lengths (6,); the given shapes are {C.shape}, {B.shape} and "
            f"{L.shape}"
        )
    if not all(np.isfinite(a).all() for a in (C, B, L)):
        raise SolveError("a point or length of the general pose problem is not a finite number")
    if not (np.ptp(C, axis=0).any() and np.ptp(B, axis=0).any()):
        raise SolveError("all six rods meet in one point: the orientation is not determined")
    return C, B, L
