"""General pose problem (6.2.4): every solution of a direct problem that stands on six rods.

For mechanisms with a method `rods(q, p) -> (C, B, L)`: six points C of the base and B of the
platform, (3, 1) each, and the distances L that the joints q impose (Delta 54, Stewart 42).

Prefer it where every assembly mode of six rods is wanted, as --all does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any, cast

import casadi as ca
import numpy as np

from parallel_cal.base.compiled import Single, dense
from parallel_cal.base.errors import SolveError
from parallel_cal.kinematics.kinematics import Solutions
from parallel_cal.kinematics.rows import joint_rows
from parallel_cal.kinematics.solvers._common import (
    home_first,
    kinematics_of,
    on_home_branch,
    pose_is_seen_as_it_is,
)
from parallel_cal.kinematics.solvers._platform import PoseSet, all_poses
from parallel_cal.model.model import Model
from parallel_cal.model.structure import Structure

__all__ = ["PoseSet", "all_poses", "direct", "direct_all", "inverse", "pose_set"]


def pose_set(model: Model, q: np.ndarray, at: Mapping[str, Any] | None = None) -> PoseSet:
    """Every pose of the model at joints q (nq,), the home branch first among the real ones.

    They are the poses of six rods, refined on the whole closure: the same where the effects act
    on joints and geometry, and their continuation where an effect depends on the pose too.
    """
    q = np.asarray(q, dtype=float)
    C, B, L = rods(model, q, at)
    found = all_poses(C, B, L)
    m = len(found.real)
    if m == 0:
        return replace(found, real=replace(found.real, joints=np.empty((0, len(q)))))
    start = replace(found.real, joints=np.tile(q, (m, 1)))
    real = kinematics_of(model).direct(start.joints, at, start)
    return replace(found, real=real[home_first(model, real, at)])


def direct_all(model: Model, q: np.ndarray, at: Mapping[str, Any] | None = None) -> Solutions:
    """Every real pose of the model at joints q (nq,), the home branch first; maybe none."""
    found = pose_set(model, q, at)
    complete = found.complete and pose_is_seen_as_it_is(model.structure)
    return replace(found.real, count_complex=found.count_complex, complete=complete)


def direct(model: Model, q: np.ndarray, at: Mapping[str, Any] | None = None) -> Solutions:
    """The pose on the home branch for joints (nq,) or (N, nq); unreachable where none is real."""
    return on_home_branch(model, q, at, direct_all)


def inverse(
    model: Model,
    position: np.ndarray,
    rotation: np.ndarray | None = None,
    at: Mapping[str, Any] | None = None,
) -> Solutions:
    """Not offered: a rod's direct problem is the hard one; the inverse has other solvers."""
    raise SolveError("the homotopy solves direct problems only; use --solver newton or cascaded")


def has_rods(model: Model) -> bool:
    return hasattr(model.mechanism, "rods")


def rods(
    model: Model, q: np.ndarray, at: Mapping[str, Any] | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """C and B (6, 3) and L (6,) in m at joints q, as the ideal mechanism sees them."""
    if not has_rods(model):
        raise SolveError(
            f"mechanism {model.mechanism.name} has no method `rods`, so its direct problem is "
            f"not known to be one of six rods; use --solver newton"
        )
    given = joint_rows(model, q)[0]
    C, B, L = _rods(model.structure)(given, model.condition_rows(at, 1)[0], model.values)
    return C.reshape(6, 3), B.reshape(6, 3), L


@lru_cache(maxsize=16)
def _rods(s: Structure) -> Single:
    """(configuration, a, v) -> C, B, L after the effects; the pose matters only to effects."""
    ideal, mechanism = s.seen, cast(Any, s.mechanism)  # `rods` is no duty of a mechanism
    C, B, L = mechanism.rods(ideal.q, ideal.p)
    outputs = [ca.horzcat(*C), ca.horzcat(*B), ca.vertcat(*L)]
    return Single(dense("rods", [s.configuration, s.a, s.v], [ca.SX(o) for o in outputs]))
