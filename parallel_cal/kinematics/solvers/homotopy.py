"""General pose problem (6.2.4): every solution of a direct problem with six rods.

For mechanisms with a method `rods(q, p) -> (C, B, L)`: six points C of the base and B of the
platform, (3, 1) each, and the distances L that the joints q impose (Delta 54, Stewart 42).

Prefer it where every assembly mode of six rods is wanted, as --all does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from parallel_cal.base.errors import SolveError
from parallel_cal.kinematics.evaluating import (
    get_kinematics,
    is_pose_unaffected,
    order_from_home,
    parts,
    solve_on_home_branch,
)
from parallel_cal.kinematics.kinematics import Solutions
from parallel_cal.kinematics.solvers._platform import PoseSet, all_poses
from parallel_cal.model.model import Model

RODS = 6  # that determine a pose; more of them agree on one only by a model without errors


def pose_set(model: Model, q: np.ndarray, at: Mapping[str, Any] | None = None) -> PoseSet:
    """Find every pose of the model at joints q (nq,); the home branch is the first real one.

    They are the poses of six rods, refined on the whole closure. They are exact if the effects act
    on joints and geometry alone, and continuations if an effect depends on the pose, too.
    """
    q = np.asarray(q, dtype=float)
    C, B, L = parts(model, "rods", q, at)
    if len(C) != RODS:
        raise SolveError(f"{len(C)} rods hold the platform, expected {RODS}; use --solver newton")
    found = all_poses(C, B, L)
    m = len(found.real)
    if m == 0:
        return replace(found, real=replace(found.real, joints=np.empty((0, len(q)))))
    start = replace(found.real, joints=np.tile(q, (m, 1)))
    real = get_kinematics(model).direct(start.joints, at, start, keep_branch=True)
    return replace(found, real=order_from_home(model, real, at))


def direct_all(model: Model, q: np.ndarray, at: Mapping[str, Any] | None = None) -> Solutions:
    """Find every real pose of the model at joints q (nq,), the home branch first."""
    found = pose_set(model, q, at)
    complete = found.complete and is_pose_unaffected(model.structure)
    return replace(found.real, count_complex=found.count_complex, complete=complete)


def direct(model: Model, q: np.ndarray, at: Mapping[str, Any] | None = None) -> Solutions:
    """Find the pose on the home branch for joints (nq,) or (N, nq); unreachable if none is real."""
    return solve_on_home_branch(model, q, at, direct_all)
