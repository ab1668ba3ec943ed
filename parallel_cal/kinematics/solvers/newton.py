"""Newton's method on the closure (eq. 6.31), and a careful descent where it fails.

Prefer it: it serves every mechanism with every effect, to the last digit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from parallel_cal.base.errors import SolveError
from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.kinematics.evaluating import (
    get_kinematics,
    joint_candidates,
    pose_candidates,
    residuals,
)
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.kinematics.problem import Problem
from parallel_cal.kinematics.rows import joint_rows, pose_rows
from parallel_cal.kinematics.solutions import (
    MAX_CLOSED_RESIDUAL_M,
    MAX_SETTLED_STEP_M,
    Solutions,
    Status,
    concatenate_solutions,
)
from parallel_cal.model.configuration import Configuration
from parallel_cal.model.model import Model

STARTS = 256  # random starts
ROUNDS = 6  # rounds of iterations from each start
MAX_SAME_SOLUTION_DIFFERENCE = 1e-7  # m or rad: below that, two solutions are the same

At = Mapping[str, Any]


def direct(model: Model, q: np.ndarray, at: At | None = None) -> Solutions:
    """Find poses on the home branch for joints (nq,) or (N, nq)."""
    return get_kinematics(model).direct(q, at)


def inverse(
    model: Model, position: np.ndarray, rotation: np.ndarray | None = None, at: At | None = None
) -> Solutions:
    """Find joints on the home branch for positions (3,) or (N, 3) and rotations."""
    return get_kinematics(model).inverse(position, rotation, at)


def direct_all(
    model: Model, q: np.ndarray, at: At | None = None, starts: int = STARTS
) -> Solutions:
    """Search all distinct poses for joints (nq,), first what `direct` answers.

    The search begins at the mechanism's candidates and, unless these are known to be all solutions,
    at random `starts`.
    """
    kinematics, given = get_kinematics(model), joint_rows(model, q)
    candidates = pose_candidates(model, given[0, : len(model.joints)])
    return _Search(kinematics, kinematics.direct_problem, given, at)(candidates, starts)


def inverse_all(
    model: Model,
    position: np.ndarray,
    rotation: np.ndarray | None = None,
    at: At | None = None,
    starts: int = STARTS,
) -> Solutions:
    """Search all distinct joint sets for a pose, like `direct_all`.

    SolveError for a redundant arm, which has infinitely many.
    """
    kinematics, given = get_kinematics(model), pose_rows(model, position, rotation)
    pose, problem = model.configuration(given[0]), kinematics.inverse_problem
    if len(problem.columns) > model.structure.phi.shape[0]:
        raise SolveError(
            f"{len(model.joints)} joints reach a pose in infinitely many ways; "
            "without --all, the answer is the one nearest to home"
        )
    candidates = joint_candidates(model, pose.r, pose.R)
    return _Search(kinematics, problem, given, at)(candidates, starts)


@dataclass(frozen=True)
class _Search:
    """Search for all solutions of one sample, `given` (1, nq + 12 + nu)."""

    kinematics: Kinematics
    problem: Problem
    given: np.ndarray
    at: At | None

    def __call__(self, candidates: Configuration, starts: int) -> Solutions:
        first = self.kinematics.solve_rows(self.problem, self.given, self.at)
        if first.status == Status.INVALID_INPUT:
            return first
        known = concatenate_solutions([first, self._solve_from(candidates.rows)])
        model, rows = self.kinematics.model, candidates.rows
        complete = self.problem.name in model.mechanism.closed_forms
        if complete:  # unless effects make the closed form inexact
            exact = residuals(model, rows, self.at) < MAX_CLOSED_RESIDUAL_M
            complete = bool(exact.all()) if len(rows) else not model.effects
        if not complete:
            more = self._solve_from(self._search_randomly(starts))
            # Omit singular ones: a robot that can move with locked joints has infinitely many.
            known = concatenate_solutions([known, more[more.status != Status.SINGULAR]])
        kept = known.solved
        kept[0] = True  # what is answered without the search, with its status
        found = known[kept]
        return replace(found[self._distinct(found.configuration.rows)], complete=complete)

    def _solve_from(self, rows: np.ndarray) -> Solutions:
        """Iterate from configurations (k, nq + 12 + nu)."""
        given, nothing = np.repeat(self.given, len(rows), axis=0), np.full(len(rows), np.nan)
        status = np.full(len(rows), Status.NOT_CONVERGED)
        passive = len(self.kinematics.model.mechanism.passive)
        start = Solutions.of(rows, nothing, status, passive)
        return self.kinematics.solve_rows(self.problem, given, self.at, start)

    def _distinct(self, rows: np.ndarray) -> list[int]:
        """Index of the first of each group of equal joints and poses; whole turns do not count."""
        model, n = self.kinematics.model, len(self.kinematics.model.joints) + 6
        turns = np.append(model.mechanism.joint_periods, np.zeros(6))
        firsts, rest = [], np.arange(len(rows))
        while len(rest):
            here = model.configuration(rows[rest[0]])
            change = model.configuration(rows[rest]).change_from(here)[:, :n]
            change -= turns * np.round(change / (2 * np.pi))
            firsts.append(int(rest[0]))
            rest = rest[np.abs(change).max(axis=1) > MAX_SAME_SOLUTION_DIFFERENCE]
        return firsts

    def _search_randomly(self, starts: int) -> np.ndarray:
        """Distinct configurations (k, nq + 12 + nu) that iterations reach from random starts."""
        if self.problem.redundant:  # a local minimum is not a solution
            return self.given[:0]
        model = self.kinematics.model
        given = np.repeat(self.given, starts, axis=0)
        x = self.problem.begin_from(given, _sample_configurations(model, starts).rows)
        a = model.condition_rows(self.at, starts)
        for _ in range(ROUNDS):
            x, step, residual, _ = self.problem.refine(x, a)
        x = x[((step < MAX_SETTLED_STEP_M) & (residual < MAX_CLOSED_RESIDUAL_M))[:, 0]]
        return x[self._distinct(x)]


def passive_periods(model: Model) -> np.ndarray:
    """Period of each passive coordinate (nu,): 2 pi of an angle, 0 of a length."""
    return np.array([2 * np.pi * (unit == "rad") for unit in model.mechanism.passive_units])


def _sample_configurations(model: Model, n: int) -> Configuration:
    """Random configurations, the same in each call.

    Revolute joints turn anywhere; sliding ones exceed their limits by up to half their range.
    Positions lie within a length of the workspace and its mirror image.
    """
    m, rng = model.mechanism, np.random.default_rng(0)
    home = model.configuration(m.home.configuration)
    q, r, w = (rng.uniform(-1, 1, (n, size)) for size in (len(m.joints), 3, 3))
    limits, half = np.array(m.joint_limits, dtype=float), np.full(len(m.joints), np.pi)
    middle, slides = home.q.copy(), (m.joint_periods == 0) & np.isfinite(limits).all(axis=1)
    middle[slides], half[slides] = limits[slides].mean(axis=1), np.ptp(limits[slides], axis=1)
    box = np.tile(home.r, (2, 1))
    for i, *between in zip(m.controlled, m.workspace.low, m.workspace.high, strict=True):
        if i < 3:
            box[:, i] = between
    reach = np.abs(box).max(axis=0) + m.length
    free = np.isin(np.arange(6), m.moved)
    far = np.where(passive_periods(model) > 0, np.pi, m.length)
    return Configuration(
        middle + half * q,
        np.where(free[:3], reach * r, home.r),
        rotation_matrix(np.where(free[3:], np.pi * w, 0.0)) @ home.R,
        home.u + far * rng.uniform(-1, 1, (n, len(m.passive))),
    )
