"""Follow paths from home: which solution is on the branch of home, where it is not obvious (6.2.4).

Two solutions are on one branch if a path without a singularity joins them.
"""

from __future__ import annotations

import numpy as np

from parallel_cal.kinematics.problem import Problem
from parallel_cal.model.model import Model

MIN_STEP_FRACTION = 2.0**-12  # of a path; below it the branch has ended
PATH_GROWTH = 1.5  # of a step that stayed on the branch
MAX_PATH_STEPS = 100  # as many as a descent may take; most paths need fewer than 30


def follow_from_home(
    problem: Problem, judge: Problem, to: np.ndarray, row: np.ndarray
) -> np.ndarray | None:
    """Move what `problem` is given in a straight line from home to `to` (nq + 12,), and follow its
    solution; None where the branch ends.

    On the whole path the solution stays on home's side of the singularities of `judge`. `row` are
    the conditions. Returns a configuration.
    """
    model = problem.model
    home = model.configuration(model.mechanism.home.configuration)
    change = model.configuration(to).change_from(home)
    here = problem.settle(home.rows, row)
    t, step = 0.0, 1.0
    for _ in range(MAX_PATH_STEPS):
        if here is None or t == 1.0 or step < MIN_STEP_FRACTION:
            break
        target = min(t + step, 1.0)
        begin = problem.begin_from(home.apply_change(target * change).rows, here)
        there = problem.settle(begin, row)
        if (
            there is not None
            and is_short_step(model, here, there)
            and judge.is_on_home_side(there, row)
        ):
            here, t, step = there, target, PATH_GROWTH * step
        else:
            step /= 2
    return here if t == 1.0 else None


def is_jump(problem: Problem, begin: np.ndarray, end: np.ndarray, row: np.ndarray) -> bool:
    """Whether iterations jumped over a singularity; a robot may pass one in short steps."""
    same = problem.is_on_home_side(begin, row) == problem.is_on_home_side(end, row)
    return not same and not is_short_step(problem.model, begin, end)


def is_short_step(model: Model, here: np.ndarray, there: np.ndarray) -> bool:
    """Whether two configurations (nq + 12 + nu,) are so near that they are on the same branch,
    unless a determinant changed its sign between them. A jump to another branch is finite, however
    short the step; these bounds are well below it."""
    n = len(model.joints)
    q, r, R9, u = np.split(np.abs(there - here), (n, n + 3, n + 12))
    swung = max(q.max(), u.max(initial=0.0))
    return bool(max(r.max() / model.mechanism.length / 4, R9.max(), swung / 2) < 0.25)
