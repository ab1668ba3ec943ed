"""Follow paths from home: which solution is on the branch of home, where it is not obvious (6.2.4).

Two solutions are on one branch if a path without a singularity joins them.
"""

from __future__ import annotations

import numpy as np

from parallel_cal.base.rotation import rotation_vector
from parallel_cal.kinematics.newton import short_step
from parallel_cal.kinematics.problem import Problem
from parallel_cal.model.configuration import Configuration
from parallel_cal.model.model import Model

MIN_STEP_FRACTION = 2.0**-12  # of a path; below it the branch has ended
FIRST_SHARE = 1e-3  # of a path, that shows its first direction
MAX_BEND = 0.5  # change of the rate of motion from one step to the next, of this rate
PATH_GROWTH = 1.5  # of a step that stayed on the branch
MAX_PATH_STEPS = 100  # as many as a descent may take
MOST_PATHS_STEPS = 30  # most paths need fewer
SAME_SOLUTION = 1e-5  # m, rad: two ends of a path that differ by less are one solution
MAX_JOINED_GAP_M = 1e-3  # of a closure; with levers of 100 m, a smaller one may be SAME_SOLUTION


def follow_from_home(
    problem: Problem,
    to: np.ndarray,
    rows: np.ndarray,
    judge: Problem | None = None,
    max_steps: int = MAX_PATH_STEPS,
) -> tuple[np.ndarray, np.ndarray]:
    """Move what `problem` is given in straight lines from home to `to` (N, nq + 12 + nu), and
    follow its solutions, of all samples at once.

    On the whole path they stay on home's side of the singularities, also of those of `judge`.
    Each step begins where the one before points, and ends near there: where two sets of solutions
    cross, the path ends, and does not turn into the other set. `rows` are the conditions. Returns
    whether each path was followed to its end, and the last configurations on it.
    """
    model = problem.model
    line = _Line(problem, to)
    here, alive = problem.settle(np.tile(problem.home, (len(to), 1)), rows)
    t, step = np.zeros(len(to)), np.ones(len(to))
    rate = _first_rates(problem, line, here, rows)
    for _ in range(max_steps):
        some = np.flatnonzero(alive & (t < 1) & (step >= MIN_STEP_FRACTION))
        if not len(some):
            break
        target = np.minimum(t[some] + step[some], 1.0)
        share = (target - t[some])[:, None]
        ahead = _configuration(model, here[some]).apply_change(share * rate[some]).rows
        there, kept = problem.settle(problem.begin_from(line.at(target, some), ahead), rows[some])
        kept &= is_short_step(model, here[some], there)
        if judge is not None:
            for k in np.flatnonzero(kept):
                kept[k] = judge.is_on_home_side(there[k], rows[some[k]])
        on = np.flatnonzero(kept)
        moved = _change(model, here[some[on]], there[on]) / share[on]
        before = rate[some[on]]
        kept[on] = _is_straight(model, before, moved)
        # The rate at the end of the step, where it grows evenly; less of it, for errors to fade.
        rate[some[on]] = np.where(kept[on, None], moved + (moved - before) / 2, before)
        here[some[kept]], t[some[kept]] = there[kept], target[kept]
        step[some] *= np.where(kept, PATH_GROWTH, 0.5)
    return alive & (t == 1.0), here


def _first_rates(problem: Problem, line: _Line, home: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return by how much configurations change along paths (N, nq + 6 + nu), where these begin."""
    share = np.full(len(home), FIRST_SHARE)
    begin = problem.begin_from(line.at(share, np.arange(len(home))), home)
    there, _ = problem.settle(begin, rows)
    return _change(problem.model, home, there) / FIRST_SHARE


def _is_straight(model: Model, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Whether paths go on in about one direction; rates (N, nq + 6 + nu) by share of the path."""
    scale = model.structure.scale
    off, size = (np.linalg.norm(rate * scale, axis=1) for rate in (after - before, after))
    return np.asarray(off < MAX_BEND * size)


def _configuration(model: Model, rows: np.ndarray) -> Configuration:
    return Configuration.from_rows(rows, len(model.mechanism.passive))


def _change(model: Model, here: np.ndarray, there: np.ndarray) -> np.ndarray:
    return _configuration(model, there).change_from(_configuration(model, here))


class _Line:
    """Straight lines from home to configurations (N, nq + 12 + nu); the platform turns about one
    axis."""

    def __init__(self, problem: Problem, to: np.ndarray):
        n, self._home = len(problem.model.joints), problem.home
        self._turns, R = slice(n + 3, n + 12), problem.home[n + 3 : n + 12].reshape(3, 3)
        turn = rotation_vector(to[:, self._turns].reshape(-1, 3, 3) @ R.T)
        self._way, self._angle = to - self._home, np.linalg.norm(turn, axis=1, keepdims=True)
        axis = turn / np.where(self._angle > 0, self._angle, 1.0)
        across = np.cross(axis[:, None], R.T[None]).swapaxes(1, 2)
        again = np.cross(axis[:, None], across.swapaxes(1, 2)).swapaxes(1, 2)
        self._across, self._again = across.reshape(-1, 9), again.reshape(-1, 9)

    def at(self, t: np.ndarray, some: np.ndarray) -> np.ndarray:
        """Return the configurations at shares t of some lines, by Rodrigues' formula."""
        x = self._home + t[:, None] * self._way[some]
        angle = t[:, None] * self._angle[some]
        turned = np.sin(angle) * self._across[some] + (1 - np.cos(angle)) * self._again[some]
        x[:, self._turns] = self._home[self._turns] + turned
        return x


def is_same_solution(model: Model, one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two configurations (nq + 12 + nu,) are equal up to whole turns of passive joints."""
    passive, off = len(model.mechanism.passive), np.abs(one - other)
    turn = 2 * np.pi * np.array([unit == "rad" for unit in model.mechanism.passive_units])
    u = off[len(off) - passive :]
    u -= turn * np.round(u / (2 * np.pi))
    return bool(np.abs(off).max() < SAME_SOLUTION)


def is_jump(problem: Problem, begin: np.ndarray, end: np.ndarray, row: np.ndarray) -> bool:
    """Whether iterations jumped over a singularity; a robot may pass one in short steps. `begin`,
    with unknowns of a start, is no solution: its motors have no side."""
    same = problem.find_sides(begin, row) == problem.find_sides(end, row)
    stays = same and problem.has_motors_on_home_side(end, row)
    return not stays and not is_short_step(problem.model, begin, end)


def is_short_step(model: Model, here: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Whether configurations (..., nq + 12 + nu) are so near to others that they are on the same
    branches, unless a determinant changed its sign between them."""
    return np.asarray((np.abs(there - here) < short_step(model.mechanism)).all(axis=-1))
