"""Keep the assembly mode along a trajectory, and say when it is about to be lost (6.2.4)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from parallel_cal.kinematics import Kinematics
from parallel_cal.singularity import distances
from parallel_cal.solutions import Solutions, Status, stacked

NEAR = 0.02  # scaled singular value below which the mode is called in danger
AHEAD = 5  # points: danger is announced when the branch will end within so many
SMALLEST = 2.0**-12  # of a way between two points: finer steps mean that the branch has ended


@dataclass(frozen=True)
class Track:
    """Solutions along a trajectory on one branch; `distance` (N,) to the singularity that ends
    it; `danger` the first point that is near one, `lost` the first that is beyond, or None."""

    solutions: Solutions
    distance: np.ndarray
    danger: int | None
    lost: int | None

    @property
    def message(self) -> str:
        if self.lost is not None:
            return f"the assembly mode is lost between points {self.lost - 1} and {self.lost}"
        if self.danger is not None:
            size = self.distance[self.danger]
            return f"a singularity is near at point {self.danger} (distance {size:.2g})"
        return "the assembly mode is kept"


def direct(
    kinematics: Kinematics, joints: np.ndarray, at: Mapping[str, Any] | None = None
) -> Track:
    """Poses (N, ...) for joints (N, nq), each on the branch of the one before."""
    first = kinematics.direct(joints[0], at)
    return _follow(kinematics, joints, first, "direct", at, kinematics.direct)


def inverse(
    kinematics: Kinematics, positions: np.ndarray, at: Mapping[str, Any] | None = None
) -> Track:
    """Joints for positions (N, 3), each on the branch of the one before; passive coordinates
    follow. (For robots that control orientation, pose by pose with `Kinematics.inverse`.)"""

    def solve(position: np.ndarray, at: Any, start: Solutions) -> Solutions:
        return kinematics.inverse(position, np.asarray(start.rotation), at, start)

    first = kinematics.inverse(positions[0], None, at)
    return _follow(kinematics, positions, first, "inverse", at, solve)


def _follow(
    kinematics: Kinematics,
    points: np.ndarray,
    first: Solutions,
    kind: str,
    at: Mapping[str, Any] | None,
    solve: Callable[..., Solutions],
) -> Track:
    points = np.asarray(points, dtype=float)
    found, lost = [first], None
    for k in range(1, len(points)):
        after = _walk(kinematics, points[k - 1], points[k], found[-1], kind, at, solve)
        if after is None:
            lost = k
            break
        found.append(after)
    solutions = stacked(found)
    distance = getattr(distances(kinematics.model, solutions, at), kind)
    return Track(solutions, distance, _first_danger(distance), lost)


def _first_danger(distance: np.ndarray) -> int | None:
    """The first point near a singularity, or on the way to one.

    Two branches meet like a square root, so distance^2 falls in a straight line to zero.
    """
    square = distance**2
    ends = square + AHEAD * np.diff(square, prepend=square[:1]) <= 0
    near = np.flatnonzero((distance < NEAR) | ends)
    return int(near[0]) if len(near) else None


def _walk(
    kinematics: Kinematics,
    begin: np.ndarray,
    end: np.ndarray,
    start: Solutions,
    kind: str,
    at: Mapping[str, Any] | None,
    solve: Callable[..., Solutions],
) -> Solutions | None:
    """From one point to the next in steps small enough to stay on the branch; None if it ends."""
    here, way, step = start, 0.0, 1.0
    while way < 1:
        target = min(way + step, 1.0)
        there = solve(begin + target * (end - begin), at, here)
        if _same_branch(kinematics, here, there, kind, at):
            here, way, step = there, target, 2 * step
        else:
            step /= 2
            if step < SMALLEST:
                return None
    return here


def _same_branch(
    kinematics: Kinematics, here: Solutions, there: Solutions, kind: str, at: Any
) -> bool:
    """Solved, no determinant's sign changed, and the step no longer than what it led to."""
    if there.status not in (Status.CONVERGED, Status.OUTSIDE_LIMITS):
        return False
    both = distances(kinematics.model, stacked([here, there]), at)
    signs = getattr(both, f"{kind}_sign")
    if signs[0] != signs[1]:
        return False
    size = kinematics.model.mechanism.length
    moved = np.abs(there.position - here.position).max() / size
    turned = np.abs(there.rotation - here.rotation).max()
    swung = np.abs(there.joints - here.joints).max()
    # A jump to another branch is a finite one; a fair step is much shorter than that.
    return bool(max(moved / 4, turned, swung / 2) < 0.25)
