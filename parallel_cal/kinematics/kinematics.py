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
    MAX_CLOSED_RESIDUAL_M,
    MAX_SETTLED_STEP_M,
    MIN_REGULAR_SINGULAR_VALUE,
    SUSPECT_PIVOT,
    Solutions,
    Status,
)
from parallel_cal.model.model import Model

__all__ = ["MAX_CLOSED_RESIDUAL_M", "Kinematics", "Solutions", "Status"]


class NewtonResult(NamedTuple):
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
        self._limits = model.mechanism.joint_limits
        n = self._n
        self._one = (n,)  # shape of one sample's joints
        self._joints, self._position, self._turn = slice(n), slice(n, n + 3), slice(n + 3, None)
        self._home_rotation = model.mechanism.home.configuration[n + 3 :]

    def __repr__(self) -> str:
        return f"Kinematics({self.model!r})"

    def direct(
        self, q: np.ndarray, at: Mapping[str, Any] | None = None, start: Solutions | None = None
    ) -> Solutions:
        """Poses for joints q (nq,) or (N, nq), on the home branch or from `start`."""
        if start is None and _shape(q) == self._one:
            found = self._solve_fast(self.direct_problem, self._joints, q, None, at)
            if found is not None:
                return found
        return self._solve(self.direct_problem, joint_rows(self.model, q), q, at, start)

    def inverse(
        self,
        position: np.ndarray,
        rotation: np.ndarray | None = None,
        at: Mapping[str, Any] | None = None,
        start: Solutions | None = None,
    ) -> Solutions:
        """Joints for positions (3,) or (N, 3) and rotations; passive coordinates follow."""
        if start is None and _shape(position) == (3,):
            found = self._solve_fast(self.inverse_problem, self._position, position, rotation, at)
            if found is not None:
                return found
        given = pose_rows(self.model, position, rotation)
        return self._solve(self.inverse_problem, given, position, at, start)

    fk, ik = direct, inverse  # as much of the field calls them

    def direct_covariance(
        self, solution: Solutions, at: Mapping[str, Any] | None = None, joint_sigma: float = 0.0
    ) -> np.ndarray:
        """Covariance (6, 6) of an answered pose (m, rad about base axes), or (N, 6, 6) of N, from
        the parameters' covariance and the joints' noise: dx = -J_x^-1 (J_v dv + J_q dq)."""
        return self._covariance(solution, at, self.model.mechanism.moved, 0, joint_sigma)

    def inverse_covariance(
        self, solution: Solutions, at: Mapping[str, Any] | None = None
    ) -> np.ndarray:
        """Covariance (nq, nq) of answered joints, or (N, nq, nq), from the parameters'
        covariance."""
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
            reached = problem.solve_many(given, rows)
        else:
            reached = problem.refine(problem.begin(given, start), rows)
        return self._classify(problem, given, rows, NewtonResult(*reached))

    def _solve_fast(
        self,
        problem: Problem,
        place: slice,
        given: np.ndarray,
        rotation: np.ndarray | None,
        at: Mapping[str, Any] | None,
    ) -> Solutions | None:
        """One sample in place, in microseconds; None where its solution is anything but usual."""
        one = problem.single_solver
        with one.lock:
            row, a, k = one.arguments
            row[place] = given
            if rotation is not None:
                row[self._turn] = np.asarray(rotation, dtype=float).reshape(9)
            elif problem.unknown_joints:
                row[self._turn] = self._home_rotation
            if len(a):
                a[:] = problem.neutral if at is None else self.model.condition_rows(at, 1)[0]
            one.evaluate()
            x, step, residual, pivot = one.results
            if not step.item() < MAX_SETTLED_STEP_M:
                x, step, residual, pivot = problem.calls.refine_one(x, a, k)
            usual = step.item() < MAX_SETTLED_STEP_M and pivot.item() > SUSPECT_PIVOT
            if not (usual and residual.item() < problem.largest):
                return None
            x, left = x.copy(), residual[0]
        q = x[self._joints]
        for (low, high), angle in zip(self._limits, q.tolist(), strict=True):
            if not low <= angle <= high:
                return None
        return Solutions.from_converged(q, x[self._position], x[self._turn].reshape(3, 3), left)

    def _inside_limits(self, q: np.ndarray) -> Any:
        low, high = np.array(self._limits, dtype=float).T
        return ((q >= low) & (q <= high)).all(axis=-1)

    def _classify(
        self, problem: Problem, given: np.ndarray, rows: np.ndarray, reached: NewtonResult
    ) -> Solutions:
        """Solutions with status; samples that the fast way left open are solved carefully."""
        n = self._n
        x, step, residual, pivot = self._refine_unsettled(
            problem, self._wrap_joints(problem, reached), rows
        )
        status = np.full(len(x), Status.CONVERGED, dtype=np.int8)
        finite = np.isfinite(given).all(axis=1) & np.isfinite(rows).all(axis=1)
        status[~finite] = Status.INVALID_INPUT
        x[~finite], residual[~finite] = np.nan, np.nan
        settled = (step < MAX_SETTLED_STEP_M) & (residual < problem.largest)
        open_ = finite & ~settled
        status[open_] = Status.NOT_CONVERGED
        for i in np.flatnonzero(open_) if not self._quick else ():
            x[i], residual[i], status[i] = self._solve_carefully(problem, x[i], rows[i], given[i])
        suspect = finite & ~(settled & (pivot > SUSPECT_PIVOT))
        for i in np.flatnonzero(suspect & (status == Status.CONVERGED)):
            if problem.smallest_singular_value(x[i], rows[i]) < MIN_REGULAR_SINGULAR_VALUE:
                status[i] = Status.SINGULAR
        status[~self._inside_limits(x[:, :n]) & (status == Status.CONVERGED)] = (
            Status.OUTSIDE_LIMITS
        )
        return Solutions.of(x, residual, status)

    def _solve_carefully(
        self, problem: Problem, x: np.ndarray, row: np.ndarray, given: np.ndarray
    ) -> tuple[np.ndarray, float, Status]:
        """The careful solver's answer; it may have wound joints up on its way."""
        x, residual, status = problem.solve_carefully(x, row, given)
        q = _wrap_towards_home(x[: self._n], problem.unknown_joints, self.model)
        if (q == x[: self._n]).all():
            return x, residual, status
        turned = np.concatenate([q, x[self._n :]])
        if not self.model.effects:
            return turned, residual, status
        return problem.solve_carefully(turned, row, given)

    def _wrap_joints(self, problem: Problem, reached: NewtonResult) -> NewtonResult:
        """With solved angles near home, and the measures as flat arrays."""
        x, *measures = reached
        step, residual, pivot = (part.reshape(-1) for part in measures)
        q = _wrap_towards_home(x[:, : self._n], problem.unknown_joints, self.model)
        if self.model.effects:  # which need not repeat after a turn: solve anew from there
            step[(q != x[:, : self._n]).any(axis=1)] = 1.0
        x[:, : self._n] = q
        return NewtonResult(x, step, residual, pivot)

    @staticmethod
    def _refine_unsettled(
        problem: Problem, reached: NewtonResult, rows: np.ndarray
    ) -> NewtonResult:
        """After further iterations where the last step is still large."""
        open_ = np.flatnonzero(np.isfinite(reached.step) & (reached.step >= MAX_SETTLED_STEP_M))
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
        J_x, J_v = self._blocks(np.atleast_2d(x), at)
        unknown, known = J_x[..., [c + n for c in columns]], J_x[..., :n]
        spread = joint_sigma**2 * known @ known.swapaxes(1, 2)
        if self.model.covariance is not None:
            spread += J_v @ self.model.covariance @ J_v.swapaxes(1, 2)
        inverse = np.linalg.pinv(unknown)
        covariance = inverse @ spread @ inverse.swapaxes(1, 2)
        if answer_size:
            covariance = covariance[:, :answer_size, :answer_size]
        else:
            full = np.zeros((len(J_x), 6, 6))
            full[np.ix_(range(len(J_x)), columns, columns)] = covariance
            covariance = full
        return covariance[0] if x.ndim == 1 else covariance

    def _blocks(self, x: np.ndarray, at: Mapping[str, Any] | None) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives (N, m, .) of the closure by coordinates and by parameters at rows (N, .)."""
        values, m = self.model.values, self.model.structure.phi.shape[0]
        a = self.model.condition_rows(at, len(x))
        found = [self._closure(row, one, values)[1:] for row, one in zip(x, a, strict=True)]
        J_x, J_v = (np.array(flat).reshape(len(x), -1, m) for flat in zip(*found, strict=True))
        return J_x.swapaxes(1, 2), J_v.swapaxes(1, 2)

    @cached_property
    def _closure(self) -> Single:
        return Single(self.model.structure.closure)


def _wrap_towards_home(q: np.ndarray, unknown: bool, model: Model) -> np.ndarray:
    """Solved angles moved by whole turns to within half a turn of home, or one turn further where
    only that is inside the limits."""
    if not unknown or not model.mechanism.periodic:
        return q
    turn = model.mechanism.joint_periods
    home = np.array(model.mechanism.home.joints)
    low, high = np.array(model.mechanism.joint_limits).T
    q = q - turn * np.round((q - home) / (2 * np.pi))
    outside = (q < low) | (q > high)
    if not outside.any():
        return q
    other = q - turn * np.sign(q - home)
    better = outside & (low <= other) & (other <= high)
    return np.where(better, other, q)


def _shape(given: Any) -> tuple[int, ...]:
    """NumPy's own function takes as long as a third of a solution."""
    return given.shape if isinstance(given, np.ndarray) else np.shape(given)
