"""Keep the assembly mode along a trajectory, and warn before it is lost (6.2.4).

Prefer it for the points of one trajectory: each stays on the branch of the one before.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from parallel_cal.base.errors import SolveError
from parallel_cal.base.rotation import rotation_matrix, rotation_vector
from parallel_cal.kinematics.branch import MIN_STEP_FRACTION, is_short_step
from parallel_cal.kinematics.evaluating import get_kinematics, select_conditions
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.kinematics.singularity import distances
from parallel_cal.kinematics.solutions import (
    Solutions,
    Status,
    concatenate_solutions,
    stack_solutions,
)
from parallel_cal.model.model import Model

MIN_SAFE_DISTANCE = 0.02  # scaled singular value; below it the assembly mode is in danger
WARN_POINTS_AHEAD = 5  # danger is announced if the branch will end within so many points
SOLVED = (Status.CONVERGED, Status.OUTSIDE_LIMITS)
# Driven joints leave the platform free in a direct singularity only. A commanded platform brings
# the robot into either kind.
SINGULARITY_KINDS = {"direct": ("direct",), "inverse": ("direct", "inverse")}

# (k, t, here) -> the solution at t between points k - 1 and k, from a solution nearby
Step = Callable[[int, float, Solutions | None], Solutions]


@dataclass(frozen=True)
class Track:
    """Solutions along a trajectory on one branch.

    `distance` (N,): distance from the singularity that ends the branch. `danger`: the first point
    near a singularity, or None. `lost`: the first point beyond it, or None.
    """

    solutions: Solutions
    distance: np.ndarray
    danger: int | None
    lost: int | None

    @property
    def message(self) -> str:
        if self.lost == 0:
            return "point 0 of the trajectory has no solution"
        if self.lost is not None:
            return f"the assembly mode is lost between points {self.lost - 1} and {self.lost}"
        if self.danger is not None:
            size = self.distance[self.danger]
            return f"a singularity is near point {self.danger} (distance {size:.2g})"
        return "the assembly mode is kept"


def direct(model: Model, q: np.ndarray, at: Mapping[str, Any] | None = None) -> Solutions:
    """Find poses along joints (N, nq), each on the branch of the pose before.

    Points beyond the end of the branch are not converged.
    """
    q = np.atleast_2d(q)
    nowhere = np.full((len(q), 3), np.nan)
    return _fill_lost_points(model, follow_joints(get_kinematics(model), q, at), q, nowhere)


def inverse(
    model: Model,
    position: np.ndarray,
    rotation: np.ndarray | None = None,
    at: Mapping[str, Any] | None = None,
) -> Solutions:
    """Find joints along positions (N, 3) and rotations (N, 3, 3), like `direct`."""
    r = np.atleast_2d(position)
    nowhere = np.full((len(r), len(model.joints)), np.nan)
    track = follow_poses(get_kinematics(model), r, rotation, at)
    return _fill_lost_points(model, track, nowhere, r)


def follow_joints(
    kinematics: Kinematics, joints: np.ndarray, at: Mapping[str, Any] | None = None
) -> Track:
    """Find poses for joints (N, nq), each on the branch of the pose before."""
    q = np.asarray(joints, dtype=float)

    def solve(k: int, t: float, here: Solutions | None) -> Solutions:
        conditions = select_conditions(at, k)
        return kinematics.direct(_interpolate(q, k, t), conditions, here, keep_branch=True)

    return _follow(kinematics, len(q), "direct", at, solve)


def follow_poses(
    kinematics: Kinematics,
    positions: np.ndarray,
    rotations: np.ndarray | None = None,
    at: Mapping[str, Any] | None = None,
) -> Track:
    """Find joints for positions (N, 3) and rotations (N, 3, 3), each on the branch of those before.

    Passive coordinates follow from the closure.
    """
    r = np.asarray(positions, dtype=float)
    R = None if rotations is None else np.reshape(rotations, (-1, 3, 3))

    def solve(k: int, t: float, here: Solutions | None) -> Solutions:
        if R is None:
            turned = None if here is None else np.asarray(here.rotation)
        else:
            begin = R[max(k - 1, 0)]
            turned = rotation_matrix(t * rotation_vector(R[k] @ begin.T)) @ begin
        conditions = select_conditions(at, k)
        return kinematics.inverse(_interpolate(r, k, t), turned, conditions, here, keep_branch=True)

    return _follow(kinematics, len(r), "inverse", at, solve)


def _interpolate(points: np.ndarray, k: int, t: float) -> np.ndarray:
    """The point at t between points k - 1 and k; point 0 if k is 0."""
    begin = points[max(k - 1, 0)]
    return np.asarray(begin + t * (points[k] - begin))


def _follow(
    kinematics: Kinematics, count: int, kind: str, at: Mapping[str, Any] | None, solve: Step
) -> Track:
    if count == 0:
        raise SolveError("a trajectory needs at least one point")
    found = [solve(0, 0.0, None)]
    lost = None if found[0].status in SOLVED else 0
    while lost is None and len(found) < count:
        k = len(found)
        after = _walk(kinematics.model, k, found[-1], kind, select_conditions(at, k), solve)
        if after is None:
            lost = k
        else:
            found.append(after)
    solutions = stack_solutions(found)
    conditions = {name: np.resize(values, len(found)) for name, values in (at or {}).items()}
    here = distances(kinematics.model, solutions, conditions)
    distance = np.min([getattr(here, end) for end in SINGULARITY_KINDS[kind]], axis=0)
    # Two branches meet like a square root, so distance^2 falls linearly to zero: extrapolate it.
    square = distance**2
    ends = square + WARN_POINTS_AHEAD * np.diff(square, prepend=square[:1]) <= 0
    near = np.flatnonzero((distance < MIN_SAFE_DISTANCE) | ends)
    return Track(solutions, distance, int(near[0]) if len(near) else None, lost)


def _walk(
    model: Model, k: int, start: Solutions, kind: str, at: Mapping[str, Any] | None, solve: Step
) -> Solutions | None:
    """Go to point k in steps small enough to stay on the branch; None if the branch ends."""
    here, t, step = start, 0.0, 1.0
    while t < 1:
        target = min(t + step, 1.0)
        there = solve(k, target, here)
        if _is_same_branch(model, here, there, kind, at):
            here, t, step = there, target, 2 * step
        else:
            step /= 2
            if step < MIN_STEP_FRACTION:
                return None
    return here


def _is_same_branch(
    model: Model, here: Solutions, there: Solutions, kind: str, at: Mapping[str, Any] | None
) -> bool:
    """Whether `there` is solved, no determinant changed its sign, and the step is short."""
    if there.status not in SOLVED:
        return False
    both = distances(model, stack_solutions([here, there]), at)
    signs = [getattr(both, f"{end}_sign") for end in SINGULARITY_KINDS[kind]]
    if any(before != after for before, after in signs):
        return False
    ends = here.configuration.rows, there.configuration.rows
    return bool(is_short_step(model, *ends))


def _fill_lost_points(
    model: Model, track: Track, joints: np.ndarray, positions: np.ndarray
) -> Solutions:
    """The track's solutions, then the given coordinates and NaN for the points beyond its end."""
    n = len(track.solutions)
    beyond = len(joints) - n
    nan = np.full((beyond, 3, 3), np.nan)
    ended = np.full(beyond, Status.NOT_CONVERGED, dtype=np.int8)
    passive = np.full((beyond, len(model.mechanism.passive)), np.nan)
    rest = Solutions(joints[n:], positions[n:], nan, nan[:, 0, 0], ended, passive=passive)
    return replace(concatenate_solutions([track.solutions, rest]), message=track.message)
