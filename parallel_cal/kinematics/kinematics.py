"""Direct (FK) and inverse (IK) problem of a model: solutions, status, uncertainty."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from importlib import import_module
from itertools import product
from typing import Any

import numpy as np

from parallel_cal.base.compiled import Single
from parallel_cal.base.errors import SolveError
from parallel_cal.kinematics.problem import Problem
from parallel_cal.kinematics.rows import joint_rows, pose_rows
from parallel_cal.kinematics.solutions import (
    CLOSED,
    SETTLED,
    SINGULAR,
    SUSPECT_PIVOT,
    Solutions,
    Status,
    stacked,
)
from parallel_cal.model.model import Model

__all__ = ["CLOSED", "Kinematics", "Solutions", "Status"]


class Kinematics:
    """The direct and inverse problem of one model, its tables computed once."""

    def __init__(self, model: Model, compile: bool = False):
        self.model = model
        self._compile = compile
        self._n = len(model.joints)
        self._limits = np.array(model.mechanism.joint_limits, dtype=float).reshape(-1, 2)

    def direct(
        self, q: np.ndarray, at: Mapping[str, Any] | None = None, start: Solutions | None = None
    ) -> Solutions:
        """Poses for joints q (nq,) or (N, nq), on the home branch or from `start`."""
        return self._solve(self._direct, joint_rows(self.model, q), q, at, start)

    def inverse(
        self,
        position: np.ndarray,
        rotation: np.ndarray | None = None,
        at: Mapping[str, Any] | None = None,
        start: Solutions | None = None,
    ) -> Solutions:
        """Joints for positions (3,) or (N, 3) and rotations; passive coordinates follow."""
        given = pose_rows(self.model, position, rotation)
        return self._solve(self._inverse, given, position, at, start)

    fk, ik = direct, inverse  # as much of the field calls them

    def direct_all(self, q: np.ndarray, at: Mapping[str, Any] | None = None) -> Solutions:
        """Every pose for joints (nq,), home branch first: all that exist where the platform hangs
        on six rods (6.2.4), has three balls on circles (6.7.2) or on great circles (6.2.3), else
        the distinct ones reached from all candidates."""
        first = self.direct(q, at)
        if first.status == Status.INVALID_INPUT:
            return stacked([first])
        complete_for = {"rods": "homotopy", "circles": "three_circles", "normals": "polynomial"}
        for feature, solver in complete_for.items():
            if hasattr(self.model.mechanism, feature):
                # These solvers use this class, too.
                complete = import_module(f"parallel_cal.kinematics.solvers.{solver}")
                found = complete.direct_all(self.model, q, at)
                if len(found):
                    return found  # type: ignore[no-any-return]
        starts = self._candidates(q)
        return self._distinct([first], starts, lambda s: self.direct(q, at, s))

    def inverse_all(
        self,
        position: np.ndarray,
        rotation: np.ndarray | None = None,
        at: Mapping[str, Any] | None = None,
    ) -> Solutions:
        """Every distinct joint set found for a pose, from all candidates; home branch first.

        SolveError for a redundant arm: infinitely many are none.
        """
        if len(self._inverse.columns) > self.model.structure.phi.shape[0]:
            raise SolveError(
                f"{self._n} joints reach a pose in infinitely many ways; without --all the answer "
                "is the one nearest to home"
            )
        given = pose_rows(self.model, position, rotation)[0]
        starts = self._joint_candidates(given)
        first = self.inverse(position, rotation, at)
        return self._distinct([first], starts, lambda s: self.inverse(position, rotation, at, s))

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
    def _direct(self) -> Problem:
        return Problem(self.model, "direct", self._compile)

    @cached_property
    def _inverse(self) -> Problem:
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
        rows = self.model.condition_rows(at, len(given))
        begin = None if start is None else problem.begin(given, start)
        configuration, step, residual, pivot = problem.many(given, rows, begin)
        solutions = self._classified(problem, configuration, step, residual, pivot, rows, given)
        return solutions[0] if np.ndim(shape_like) == 1 else solutions

    def _solve_one(
        self, problem: Problem, given: np.ndarray, at: Mapping[str, Any] | None
    ) -> Solutions:
        """The same for one sample without array overhead; anything unusual goes the long way."""
        rows = self.model.condition_rows(at, 1)
        x, step, residual, pivot = problem.one(given, rows[0], problem.k)
        if step[0] >= SETTLED:
            x, step, residual, pivot = problem.refine_one(x, rows[0], problem.k)
        n = self._n
        usual = step[0] < SETTLED and problem.closed(residual)[0] and pivot[0] > SUSPECT_PIVOT
        if usual and self._inside_limits(x[:n]):
            status = np.array(Status.CONVERGED, dtype=np.int8)
            return Solutions(x[:n], x[n : n + 3], x[n + 3 :].reshape(3, 3), residual[0], status)
        parts = (x[None], step, residual, pivot, rows, given[None])
        return self._classified(problem, *parts)[0]

    def _inside_limits(self, q: np.ndarray) -> bool:
        return bool(((q >= self._limits[:, 0]) & (q <= self._limits[:, 1])).all())

    def _classified(
        self,
        problem: Problem,
        x: np.ndarray,
        step: np.ndarray,
        residual: np.ndarray,
        pivot: np.ndarray,
        rows: np.ndarray,
        given: np.ndarray,
    ) -> Solutions:
        """Solutions with status; samples that the fast way left open are solved carefully."""
        n = self._n
        q = _turned_towards(x[:, :n], problem.unknown_joints, self.model)
        if self.model.effects:  # which need not repeat after a turn: solve anew from there
            step = np.where((q == x[:, :n]).all(axis=1), step.reshape(-1), 1.0)
        x = np.hstack([q, x[:, n:]])
        x, step, residual, pivot = self._refined(problem, x, step, residual, pivot, rows)
        status = np.full(len(x), Status.CONVERGED, dtype=np.int8)
        finite = np.isfinite(given).all(axis=1) & np.isfinite(rows).all(axis=1)
        status[~finite] = Status.INVALID_INPUT
        x[~finite], residual[~finite] = np.nan, np.nan
        settled = (step < SETTLED) & problem.closed(residual)
        for i in np.flatnonzero(finite & ~settled):
            x[i], residual[i], status[i] = self._carefully(problem, x[i], rows[i], given[i])
        suspect = finite & ~(settled & (pivot > SUSPECT_PIVOT))
        for i in np.flatnonzero(suspect & (status == Status.CONVERGED)):
            if problem.smallest_singular_value(x[i], rows[i]) < SINGULAR:
                status[i] = Status.SINGULAR
        q = x[:, :n]
        outside = ~((q >= self._limits[:, 0]) & (q <= self._limits[:, 1])).all(axis=1)
        status[outside & (status == Status.CONVERGED)] = Status.OUTSIDE_LIMITS
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

    @staticmethod
    def _refined(problem: Problem, x: np.ndarray, *parts: np.ndarray) -> list[np.ndarray]:
        """Further iterations where the last step is still large; flat copies of all parts."""
        *measures, rows = parts
        step, residual, pivot = (part.reshape(-1).copy() for part in measures)
        results = [x.copy(), step, residual, pivot]
        open_ = np.flatnonzero(np.isfinite(step) & (step >= SETTLED))
        if len(open_):
            for array, new in zip(results, problem.refine(x[open_], rows[open_]), strict=True):
                array[open_] = new.reshape(array[open_].shape)
        return results

    # ------------------------------------------------------------------ all solutions

    def _candidates(self, q: np.ndarray) -> list[Solutions]:
        columns = np.array(self.model.structure.candidates(q, self.model.values)).T
        poses = [(c[:3], c[3:].reshape(3, 3)) for c in columns if np.isfinite(c).all()]
        return [_start(np.asarray(q, dtype=float), r, R) for r, R in poses]

    def _joint_candidates(self, given: np.ndarray) -> list[Solutions]:
        r, R9 = given[self._n : self._n + 3], given[self._n + 3 :]
        choices = self.model.structure.joint_candidates.call([r, R9, self.model.values])
        sets = [np.array(c) for c in product(*(np.array(c).ravel() for c in choices))]
        return [_start(q, r, R9.reshape(3, 3)) for q in sets if np.isfinite(q).all()]

    @staticmethod
    def _distinct(first: list[Solutions], starts: list[Solutions], solve: Any) -> Solutions:
        """The solutions reached from all starts, each once (1e-7 m or rad apart)."""
        found = [s for s in first if s.status in (Status.CONVERGED, Status.OUTSIDE_LIMITS)]
        for start in starts:
            new = solve(start)
            if new.status not in (Status.CONVERGED, Status.OUTSIDE_LIMITS, Status.SINGULAR):
                continue
            if all(_apart(new, old) > 1e-7 for old in found):
                found.append(new)
        return stacked(found or first)

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


def _start(q: np.ndarray, r: np.ndarray, R: np.ndarray) -> Solutions:
    return Solutions(q, r, R, np.array(np.nan), np.array(Status.NOT_CONVERGED))


def _apart(a: Solutions, b: Solutions) -> float:
    joints = np.abs(np.angle(np.exp(1j * (a.joints - b.joints)))).max()
    pose = max(np.abs(a.position - b.position).max(), np.abs(a.rotation - b.rotation).max())
    return float(max(joints, pose))


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
