"""Direct (FK) and inverse (IK) problem of a model: solutions, status, uncertainty."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from parallel_cal.base.compiled import Single
from parallel_cal.kinematics.problem import Problem
from parallel_cal.kinematics.rows import joint_rows, pose_rows
from parallel_cal.kinematics.solutions import (
    CLOSED,
    SETTLED,
    SINGULAR,
    SUSPECT_PIVOT,
    Solutions,
    Status,
)
from parallel_cal.model.model import Model

__all__ = ["CLOSED", "Kinematics", "Solutions", "Status"]


class Reached(NamedTuple):
    """What Newton's iterations end in: configurations x (N, nq + 12), and of each the last step
    (m), the closure's norm (m) and the smallest pivot."""

    x: np.ndarray
    step: np.ndarray
    residual: np.ndarray
    pivot: np.ndarray


class Kinematics:
    """The direct and inverse problem of one model, its tables computed once; `quick` gives up where
    the usual iterations do not end, where otherwise the careful solver goes on."""

    def __init__(self, model: Model, compile: bool = False, quick: bool = False):
        self.model = model
        self._compile, self._quick = compile, quick
        self._n = len(model.joints)
        self._limits = np.array(model.mechanism.joint_limits, dtype=float).reshape(-1, 2)

    def direct(
        self, q: np.ndarray, at: Mapping[str, Any] | None = None, start: Solutions | None = None
    ) -> Solutions:
        """Poses for joints q (nq,) or (N, nq), on the home branch or from `start`."""
        return self._solve(self.direct_problem, joint_rows(self.model, q), q, at, start)

    def inverse(
        self,
        position: np.ndarray,
        rotation: np.ndarray | None = None,
        at: Mapping[str, Any] | None = None,
        start: Solutions | None = None,
    ) -> Solutions:
        """Joints for positions (3,) or (N, 3) and rotations; passive coordinates follow."""
        given = pose_rows(self.model, position, rotation)
        return self._solve(self.inverse_problem, given, position, at, start)

    fk, ik = direct, inverse  # as much of the field calls them

    def direct_covariance(
        self, solution: Solutions, at: Mapping[str, Any] | None = None, joint_sigma: float = 0.0
    ) -> np.ndarray:
        """Covariance (6, 6) of an answered pose (m, rad about base axes) from the parameters'
        covariance and the joints' noise: dx = -J_x^-1 (J_v dv + J_q dq)."""
        return self._covariance(solution, at, self.model.mechanism.moved, 0, joint_sigma)

    def inverse_covariance(
        self, solution: Solutions, at: Mapping[str, Any] | None = None
    ) -> np.ndarray:
        """Covariance (nq, nq) of answered joints from the parameters' covariance."""
        columns = [c - self._n for c in range(self._n)] + self.model.mechanism.passive
        return self._covariance(solution, at, columns, self._n, 0.0)

    # ------------------------------------------------------------------ the two problems

    @cached_property
    def direct_problem(self) -> Problem:
        return Problem(self.model, "direct", self._compile)

    @cached_property
    def inverse_problem(self) -> Problem:
        return Problem(self.model, "inverse", self._compile)

    def _solve(
        self,
        problem: Problem,
        given: np.ndarray,
        shape_like: np.ndarray,
        at: Mapping[str, Any] | None,
        start: Solutions | None,
    ) -> Solutions:
        if np.ndim(shape_like) == 1 and start is None:
            return self._solve_one(problem, given[0], at)
        solutions = self.solve_rows(problem, given, at, start)
        return solutions[0] if np.ndim(shape_like) == 1 else solutions

    def solve_rows(
        self,
        problem: Problem,
        given: np.ndarray,
        at: Mapping[str, Any] | None = None,
        start: Solutions | None = None,
    ) -> Solutions:
        """Solutions of rows (N, nq + 12) that hold what is given."""
        rows = self.model.condition_rows(at, len(given))
        if start is None:
            reached = problem.many(given, rows)
        else:
            reached = problem.refine(problem.begin(given, start), rows)
        return self._classified(problem, given, rows, Reached(*reached))

    def _solve_one(
        self, problem: Problem, given: np.ndarray, at: Mapping[str, Any] | None
    ) -> Solutions:
        """The same for one sample without array overhead; anything unusual goes the long way."""
        rows = self.model.condition_rows(at, 1)
        x, step, residual, pivot = problem.calls.one(given, rows[0], problem.k)
        if step[0] >= SETTLED:
            x, step, residual, pivot = problem.calls.refine_one(x, rows[0], problem.k)
        n = self._n
        usual = step[0] < SETTLED and problem.closed(residual)[0] and pivot[0] > SUSPECT_PIVOT
        if usual and self._inside_limits(x[:n]):
            status = np.array(Status.CONVERGED, dtype=np.int8)
            return Solutions(x[:n], x[n : n + 3], x[n + 3 :].reshape(3, 3), residual[0], status)
        return self._classified(
            problem, given[None], rows, Reached(x[None], step, residual, pivot)
        )[0]

    def _inside_limits(self, q: np.ndarray) -> Any:
        return ((q >= self._limits[:, 0]) & (q <= self._limits[:, 1])).all(axis=-1)

    def _classified(
        self, problem: Problem, given: np.ndarray, rows: np.ndarray, reached: Reached
    ) -> Solutions:
        """Solutions with status; samples that the fast way left open are solved carefully."""
        n = self._n
        x, step, residual, pivot = self._refined(problem, self._turned(problem, reached), rows)
        status = np.full(len(x), Status.CONVERGED, dtype=np.int8)
        finite = np.isfinite(given).all(axis=1) & np.isfinite(rows).all(axis=1)
        status[~finite] = Status.INVALID_INPUT
        x[~finite], residual[~finite] = np.nan, np.nan
        settled = (step < SETTLED) & problem.closed(residual)
        open_ = finite & ~settled
        status[open_] = Status.NOT_CONVERGED
        for i in np.flatnonzero(open_) if not self._quick else ():
            x[i], residual[i], status[i] = self._carefully(problem, x[i], rows[i], given[i])
        suspect = finite & ~(settled & (pivot > SUSPECT_PIVOT))
        for i in np.flatnonzero(suspect & (status == Status.CONVERGED)):
            if problem.smallest_singular_value(x[i], rows[i]) < SINGULAR:
                status[i] = Status.SINGULAR
        status[~self._inside_limits(x[:, :n]) & (status == Status.CONVERGED)] = (
            Status.OUTSIDE_LIMITS
        )
        return Solutions.of(x, residual, status)

    def _carefully(
        self, problem: Problem, x: np.ndarray, row: np.ndarray, given: np.ndarray
    ) -> tuple[np.ndarray, float, Status]:
        """The careful solver's answer; it may have wound joints up on its way."""
        x, residual, status = problem.careful(x, row, given)
        q = _turned_towards(x[: self._n], problem.unknown_joints, self.model)
        if (q == x[: self._n]).all():
            return x, residual, status
        turned = np.concatenate([q, x[self._n :]])
        if not self.model.effects:
            return turned, residual, status
        return problem.careful(turned, row, given)

    def _turned(self, problem: Problem, reached: Reached) -> Reached:
        """With solved angles near home, in flat arrays of their own."""
        x, *measures = reached
        step, residual, pivot = (part.reshape(-1).copy() for part in measures)
        q = _turned_towards(x[:, : self._n], problem.unknown_joints, self.model)
        if self.model.effects:  # which need not repeat after a turn: solve anew from there
            step[(q != x[:, : self._n]).any(axis=1)] = 1.0
        return Reached(np.hstack([q, x[:, self._n :]]), step, residual, pivot)

    @staticmethod
    def _refined(problem: Problem, reached: Reached, rows: np.ndarray) -> Reached:
        """After further iterations where the last step is still large."""
        open_ = np.flatnonzero(np.isfinite(reached.step) & (reached.step >= SETTLED))
        if len(open_):
            further = problem.refine(reached.x[open_], rows[open_])
            for array, new in zip(reached, further, strict=True):
                array[open_] = new.reshape(array[open_].shape)
        return reached

    # ------------------------------------------------------------------ uncertainty

    def _covariance(
        self,
        solution: Solutions,
        at: Mapping[str, Any] | None,
        columns: list[int],
        answer_size: int,
        joint_sigma: float,
    ) -> np.ndarray:
        n, x = self._n, solution.configuration.rows
        J_x, J_v = self._blocks(x, self.model.condition_rows(at, 1)[0])
        unknown = J_x[:, [c + n for c in columns]]
        spread = np.zeros((len(J_x), len(J_x)))
        if self.model.covariance is not None:
            spread += J_v @ self.model.covariance @ J_v.T
        spread += joint_sigma**2 * J_x[:, :n] @ J_x[:, :n].T
        inverse = np.linalg.pinv(unknown)
        covariance = inverse @ spread @ inverse.T
        if answer_size:
            return covariance[:answer_size, :answer_size]
        full = np.zeros((6, 6))
        full[np.ix_(columns, columns)] = covariance
        return full

    def _blocks(self, x: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        s = self.model.structure
        _, J_x, J_v = self._closure(x, a, self.model.values)
        rows = s.phi.shape[0]
        return J_x.reshape(-1, rows).T, J_v.reshape(-1, rows).T

    @cached_property
    def _closure(self) -> Single:
        return Single(self.model.structure.closure)


def _turned_towards(q: np.ndarray, unknown: bool, model: Model) -> np.ndarray:
    """Solved angles moved by whole turns to within half a turn of home, or one turn further where
    only that is inside the limits."""
    if not unknown or not model.mechanism.periodic:
        return q
    turn = model.mechanism.turns
    home = np.array(model.mechanism.home.joints)
    low, high = np.array(model.mechanism.joint_limits).T
    q = q - turn * np.round((q - home) / (2 * np.pi))
    other = q - turn * np.sign(q - home)
    better = ((q < low) | (q > high)) & (low <= other) & (other <= high)
    return np.where(better, other, q)
