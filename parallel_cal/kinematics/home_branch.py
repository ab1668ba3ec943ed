"""Find the solution on the branch of home, where Newton's method found none or one in doubt."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from parallel_cal.kinematics.branch import (
    MAX_JOINED_GAP_M,
    MAX_PATH_STEPS,
    MOST_PATHS_STEPS,
    follow_from_home,
    is_same_solution,
)
from parallel_cal.kinematics.problem import Problem
from parallel_cal.kinematics.rows import limits_in
from parallel_cal.kinematics.solutions import MIN_REGULAR_SINGULAR_VALUE, Status
from parallel_cal.model.model import Model

End = tuple[np.ndarray, float, Status]  # configuration, residual (m) and status of a search


@dataclass(frozen=True)
class Samples:
    """What N samples of a problem are given, and their solutions, which are replaced in place.

    `given` and `x` are configurations (N, nq + 12 + nu), `rows` the conditions.
    """

    problem: Problem
    given: np.ndarray
    rows: np.ndarray
    x: np.ndarray
    residual: np.ndarray
    status: np.ndarray

    def replace(self, i: np.intp, end: End) -> None:
        self.x[i], self.residual[i], self.status[i] = end

    def mark_singular(self, which: np.ndarray) -> None:
        """Set the status of solutions that are singular."""
        for i in np.flatnonzero(which & (self.status == Status.CONVERGED)):
            if _is_singular(self.problem, self.x[i], self.rows[i]):
                self.status[i] = Status.SINGULAR

    def return_to_home_branch(self, other: Problem, doubted: np.ndarray, quick: bool) -> None:
        """Replace solutions by those that are followed from home while the readings (or the pose)
        move from there to those given, or by those of a search, unless it is to be `quick`.
        `other` is the other problem."""
        which = np.flatnonzero(doubted)
        if not len(which):
            return
        problem = self.problem
        steps = MOST_PATHS_STEPS if quick else MAX_PATH_STEPS
        followed, ends = follow_from_home(
            problem, self.given[which], self.rows[which], max_steps=steps
        )
        for i, reached, end in zip(which, followed, ends, strict=True):
            row, x = self.rows[i], self.x[i].copy()
            if reached:
                self.replace(i, _turn_back(problem, end, Status.CONVERGED, row))
            elif quick:
                self.status[i] = Status.OTHER_BRANCH
            else:
                # A descent from a solution stays there.
                starts = x, problem.begin_from(self.given[i], end), self.given[i]
                search = _descend(problem, starts, row)
                self.replace(i, _find_joined(problem, other, search, row))

    def descend(self, which: np.ndarray) -> None:
        """Replace solutions by those of the robust solver from where they are, or from home."""
        for i in np.flatnonzero(which):
            starts = self.x[i].copy(), self.given[i]
            self.replace(i, _best_end(_descend(self.problem, starts, self.rows[i])))


def _find_joined(problem: Problem, other: Problem, ends: Iterable[End], row: np.ndarray) -> End:
    """Return the first end that a path of the other coordinates joins with home, else the best."""
    seen = list[End]()
    for x, residual, status in ends:
        if status == Status.CONVERGED:
            if not problem.has_branches:
                return x, residual, status
            if _is_singular(problem, x, row):
                return x, residual, Status.SINGULAR
            # To readings that contradict each other, of more joints than freedoms, no path of poses
            # leads: it ends with others, which do not.
            if residual < MAX_JOINED_GAP_M and problem.is_on_home_side(x, row):
                joined, (end,) = follow_from_home(other, x[None], row[None], problem)
                if joined[0] and is_same_solution(problem.model, end, x):
                    return x, residual, status
        seen.append((x, residual, status))
    x, residual, status = _best_end(seen)
    return x, residual, Status.OTHER_BRANCH if status == Status.CONVERGED else status


def _descend(problem: Problem, starts: Iterable[np.ndarray], row: np.ndarray) -> Iterator[End]:
    """Yield the ends of the robust solver from some starts."""
    for start in starts:
        if np.isfinite(start).all():
            x, _, status = problem.descend(start, row)
            yield _turn_back(problem, x, status, row)


def _best_end(ends: Iterable[End]) -> End:
    """Return the first end that converged, else that with the smallest residual."""
    seen = list[End]()
    for end in ends:
        if end[2] == Status.CONVERGED:
            return end
        seen.append(end)
    return min(seen, key=lambda end: end[1])


def _turn_back(problem: Problem, x: np.ndarray, status: Status, row: np.ndarray) -> End:
    """Undo whole turns of the joints; an effect need not repeat after them."""
    n = len(problem.model.joints)
    q = wrap_towards_home(x[:n], problem.unknown_joints, problem.model)
    turned = np.concatenate([q, x[n:]])
    if problem.model.effects and (turned != x).any():
        return problem.descend(turned, row)
    return turned, problem.residual(turned, row), status


def _is_singular(problem: Problem, x: np.ndarray, row: np.ndarray) -> bool:
    return problem.smallest_singular_value(x, row) < MIN_REGULAR_SINGULAR_VALUE


def wrap_towards_home(q: np.ndarray, unknown: bool, model: Model) -> np.ndarray:
    """Move solved angles by whole turns to within half a turn of home, or by one more turn if only
    that is inside the limits."""
    if not unknown or not model.mechanism.periodic:
        return q
    turn = model.mechanism.joint_periods
    home = np.array(model.mechanism.home.joints)
    low, high = limits_in("inverse", model.mechanism).T
    q = q - turn * np.round((q - home) / (2 * np.pi))
    outside = (q < low) | (q > high)
    if not outside.any():
        return q
    other = q - turn * np.sign(q - home)
    better = outside & (low <= other) & (other <= high)
    return np.where(better, other, q)
