"""Forward and inverse kinematics of a model: solutions, status, uncertainty."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from parallel_cal.base.arguments import require, require_model
from parallel_cal.base.compiled import Single
from parallel_cal.base.errors import SolveError
from parallel_cal.kinematics.branch import is_jump
from parallel_cal.kinematics.home_branch import Samples, wrap_towards_home
from parallel_cal.kinematics.one_sample import FastSolver, fast_solver
from parallel_cal.kinematics.problem import Problem
from parallel_cal.kinematics.rows import joint_rows, pose_rows
from parallel_cal.kinematics.solutions import (
    MAX_CLOSED_RESIDUAL_M,
    MAX_SETTLED_STEP_M,
    SUSPECT_PIVOT,
    Solutions,
    Status,
    replace_rows,
)
from parallel_cal.kinematics.split_turns import restore_turn
from parallel_cal.model.model import Model

__all__ = ["MAX_CLOSED_RESIDUAL_M", "Kinematics", "Solutions", "Status"]


class NewtonResult(NamedTuple):
    """Result of Newton's iterations: configurations x (N, nq + 12), and for each one the last step
    (m), the norm of the closure (m) and the smallest pivot."""

    x: np.ndarray
    step: np.ndarray
    residual: np.ndarray
    pivot: np.ndarray


class Kinematics:
    """Forward and inverse kinematics of one model.

    If Newton's method does not converge, a slower and more robust solver is used.

    Parameters
    ----------
    model : Model
    compile : bool
        Compile the equations to machine code. This takes seconds, the first time only, and makes
        each solution faster. Default False.
    quick : bool
        Do not use the robust solver; the status then says that a solution did not converge.
        Default False.

    Examples
    --------
    >>> import parallel_cal as pc
    >>> kinematics = pc.Kinematics(pc.new_model("delta24"))
    >>> pose = kinematics.direct([0.5, 0.5, 0.5])
    >>> joints = kinematics.inverse(pose.position).joints
    >>> joints.round(6).tolist(), pc.Status(int(pose.status)).text
    ([0.5, 0.5, 0.5], 'converged')
    """

    def __init__(self, model: Model, compile: bool = False, quick: bool = False):
        require_model(model)
        self.model = model
        self._compile, self._quick = compile, quick
        self._n = len(model.joints)

    def __repr__(self) -> str:
        return f"Kinematics({self.model!r})"

    def direct(
        self,
        q: np.ndarray,
        at: Mapping[str, Any] | None = None,
        start: Solutions | None = None,
        keep_branch: bool = False,
    ) -> Solutions:
        """Compute the poses for joint readings (forward kinematics).

        Parameters
        ----------
        q : array (nq,) or (N, nq)
            Joint readings, rad or m.
        at : mapping of str to float or array (N,), optional
            Conditions by name, such as `{"payload": 1.2}`. A condition that is not given has its
            neutral value.
        start : Solutions, optional
            Solutions from which the iterations start; they select the branch. If they do not
            converge, the answer is that without a start, if that one converges inside the joint
            limits. Default: the branch of the model's `home`.
        keep_branch : bool
            Return what the start leads to in any case, with its status. Default False.

        Returns
        -------
        Solutions
            One solution for q (nq,), N for q (N, nq), each with a status.

        Raises
        ------
        SolveError
            If q has the wrong shape.
        """
        if start is None:
            found = self._direct_one(q, None, at)
            if found is not None:
                return found
        require("start", start, "Solutions | None", SolveError)
        given = joint_rows(self.model, q)
        return self._solve(self.direct_problem, given, q, at, start, keep_branch)

    def inverse(
        self,
        position: np.ndarray,
        rotation: np.ndarray | None = None,
        at: Mapping[str, Any] | None = None,
        start: Solutions | None = None,
        keep_branch: bool = False,
    ) -> Solutions:
        """Compute the joint readings for poses (inverse kinematics).

        Parameters
        ----------
        position : array (3,) or (N, 3)
            Positions, m.
        rotation : array (3, 3) or (N, 3, 3), optional
            Rotations. Default: those at home. Coordinates that the robot cannot command, such as a
            tilt of a Delta, are computed.
        at, start, keep_branch
            As in `direct`. The iterations from a start may also converge to joints outside their
            limits. Then, too, the answer is that without a start, if that one is inside.

        Returns
        -------
        Solutions
            One solution for a position (3,), N for (N, 3), each with a status.

        Raises
        ------
        SolveError
            If position or rotation has the wrong shape.
        """
        if start is None and not self.inverse_problem.splits_turns:
            found = self._inverse_one(position, rotation, at)
            if found is not None:
                return found
        require("start", start, "Solutions | None", SolveError)
        given = pose_rows(self.model, position, rotation)
        return self._solve(self.inverse_problem, given, position, at, start, keep_branch)

    fk, ik = direct, inverse  # common names in the field

    def direct_covariance(
        self, solution: Solutions, at: Mapping[str, Any] | None = None, joint_sigma: ArrayLike = 0.0
    ) -> np.ndarray:
        """Compute the covariance of each computed pose.

        It follows from the covariance of the parameters v and the noise of the joint readings q:
        dx = -J_x^-1 (J_v dv + J_q dq), with the Jacobians J of the closure by x, v and q.

        Parameters
        ----------
        solution : Solutions
            Result of `direct`.
        at : mapping of str to float or array (N,), optional
            The conditions of that result.
        joint_sigma : float or array (nq,)
            Standard deviation of joint readings, rad or m. Default 0.

        Returns
        -------
        array (6, 6) or (N, 6, 6)
            Covariance of the position (m) and the rotation (rad, about the axes of {B}).
        """
        return self._covariance(
            solution, at, self.model.mechanism.dependent_columns, 0, joint_sigma
        )

    def inverse_covariance(
        self, solution: Solutions, at: Mapping[str, Any] | None = None
    ) -> np.ndarray:
        """Compute the covariance (nq, nq), or (N, nq, nq), of the joints of `inverse`, rad or m.

        It follows from the covariance of the parameters. `at` are the conditions of `solution`.
        """
        m = self.model.mechanism
        columns = [*range(self._n), *(self._n + i for i in m.parasitic), *m.passive_columns]
        return self._covariance(solution, at, columns, self._n, 0.0)

    def direct_residual_sigma(
        self, solution: Solutions, at: Mapping[str, Any] | None = None, joint_sigma: ArrayLike = 0.0
    ) -> np.ndarray:
        """Compute the residual (rms) that noise and uncertain parameters explain.

        If a robot has more joints than freedoms, its readings never agree on one pose: `direct`
        returns the pose of least squares, and the residual is the norm of what is left. It is
        P (J_v dv + J_q dq) with the projection P = 1 - J_x J_x^+. A residual of several times this
        value has another cause. For other robots it is 0.

        Parameters
        ----------
        solution : Solutions
            Result of `direct`.
        at : mapping of str to float or array (N,), optional
            The conditions of that result.
        joint_sigma : float or array (nq,)
            Standard deviation of joint readings, rad or m. Default 0.

        Returns
        -------
        array () or (N,)
            Root of the expected square of `solution.residual`, m. The parameters have the model's
            covariance, or their tolerances if it has none.
        """
        covariance = self.model.covariance
        if covariance is None:
            covariance = np.diag(np.where(self.model.fixed, 0.0, self.model.table.tolerance) ** 2)
        columns = self.model.mechanism.dependent_columns
        unknown, spread = self._linearize(solution, at, columns, joint_sigma, covariance)
        projection = np.eye(unknown.shape[1]) - unknown @ np.linalg.pinv(unknown)
        sigma = np.sqrt(np.trace(projection @ spread, axis1=1, axis2=2).clip(0.0))
        return np.asarray(sigma[0] if solution.joints.ndim == 1 else sigma)

    # ------------------------------------------------------------------ the two problems

    @cached_property
    def direct_problem(self) -> Problem:
        """Forward kinematics: the pose is unknown."""
        return Problem(self.model, "direct", self._compile)

    @cached_property
    def inverse_problem(self) -> Problem:
        """Inverse kinematics: the joints, and coordinates that they do not control, are unknown."""
        return Problem(self.model, "inverse", self._compile)

    @cached_property
    def _direct_one(self) -> FastSolver:
        return fast_solver(self.direct_problem)

    @cached_property
    def _inverse_one(self) -> FastSolver:
        return fast_solver(self.inverse_problem)

    def _solve(
        self,
        problem: Problem,
        given: np.ndarray,
        shape_like: np.ndarray,
        at: Mapping[str, Any] | None,
        start: Solutions | None,
        keep_branch: bool,
    ) -> Solutions:
        require("keep_branch", keep_branch, "bool", SolveError)
        rows = self.model.condition_rows(at, len(given))
        solutions = self._solve_from(problem, given, rows, start, keep_branch)
        if start is not None and not keep_branch and solutions.status.any():
            solutions = self._replace_lost(problem, given, rows, solutions)
        return solutions[0] if np.ndim(shape_like) == 1 else solutions

    def _replace_lost(
        self, problem: Problem, given: np.ndarray, rows: np.ndarray, solutions: Solutions
    ) -> Solutions:
        """Replace solutions that are unsolved or outside the limits by those without a start, where
        these converge inside the limits."""
        lost = ~solutions.solved
        if problem.unknown_joints:  # joints that are given are outside on every branch
            lost |= solutions.status == Status.OUTSIDE_LIMITS
        if not lost.any():
            return solutions
        others = self._solve_from(problem, given[lost], rows[lost], None)
        lost[lost] = others.ok
        return replace_rows(solutions, lost, others[others.ok])

    def solve_rows(
        self,
        problem: Problem,
        given: np.ndarray,
        at: Mapping[str, Any] | None = None,
        start: Solutions | None = None,
    ) -> Solutions:
        """Solve a problem for N samples.

        A row of `given` (N, nq + 12) holds joints, position and rotation. The known ones are read,
        and the others are computed. The branch of a start is kept.
        """
        return self._solve_from(problem, given, self.model.condition_rows(at, len(given)), start)

    def _solve_from(
        self,
        problem: Problem,
        given: np.ndarray,
        rows: np.ndarray,
        start: Solutions | None,
        any_branch: bool = True,
    ) -> Solutions:
        """Solve from the starts, or on the branch of home. With `any_branch`, iterations from a
        start may end on another branch than its own."""
        begin = None if start is None else problem.begin(given, start)
        reached = problem.solve_many(given, rows) if begin is None else problem.refine(begin, rows)
        found = self._classify(problem, given, rows, reached, begin, any_branch)
        if not problem.splits_turns:
            return found

        def iterate(some: np.ndarray, last: Solutions) -> Solutions:
            again = problem.begin(given[some], last)
            reached = problem.refine(again, rows[some])
            return self._classify(problem, again, rows[some], reached, again, True)

        return restore_turn(self.model.mechanism, given, found, iterate)

    def _classify(
        self,
        problem: Problem,
        given: np.ndarray,
        rows: np.ndarray,
        reached: Sequence[np.ndarray],
        begin: np.ndarray | None = None,
        any_branch: bool = False,
    ) -> Solutions:
        """Assign a status to each sample. What did not converge, or may have done so on another
        branch, is followed from home; the robust solver searches for what this does not reach."""
        n = self._n
        x, step, residual, pivot = self._wrap_and_refine(problem, NewtonResult(*reached), rows)
        status = np.full(len(x), Status.CONVERGED, dtype=np.int8)
        finite = np.isfinite(given).all(axis=1) & np.isfinite(rows).all(axis=1)
        status[~finite] = Status.INVALID_INPUT
        x[~finite], residual[~finite] = np.nan, np.nan
        settled = (step < MAX_SETTLED_STEP_M) & (residual < problem.largest)
        status[finite & ~settled] = Status.NOT_CONVERGED
        suspect = finite & ~(settled & (pivot > SUSPECT_PIVOT))
        samples = Samples(problem, given, rows, x, residual, status)
        samples.mark_singular(suspect)
        if begin is None:
            doubted = suspect & (status != Status.SINGULAR)
            doubted &= ~(settled & ((pivot > 0.0) | (not problem.has_branches)))
            if self._quick:
                doubted &= settled
            other = self.direct_problem if problem.unknown_joints else self.inverse_problem
            samples.return_to_home_branch(other, doubted, self._quick)
        else:
            for i in np.flatnonzero(suspect & (status == Status.CONVERGED)):
                if not any_branch and is_jump(problem, begin[i], x[i], rows[i]):
                    status[i] = Status.OTHER_BRANCH
            if not self._quick:
                samples.descend(finite & ~settled)
        samples.mark_singular(finite & ~settled)
        inside = ((x[:, :n] >= problem.low) & (x[:, :n] <= problem.high)).all(axis=1)
        status[~inside & (status == Status.CONVERGED)] = Status.OUTSIDE_LIMITS
        return Solutions.of(x, residual, status, len(self.model.mechanism.passive))

    def _wrap_and_refine(
        self, problem: Problem, reached: NewtonResult, rows: np.ndarray
    ) -> NewtonResult:
        """Move solved angles near home, then iterate further where the last step is large."""
        x, *measures = reached
        step, residual, pivot = (part.reshape(-1) for part in measures)
        q = wrap_towards_home(x[:, : self._n], problem.unknown_joints, self.model)
        if self.model.effects:  # An effect need not repeat after a turn: iterate again from there.
            step[(q != x[:, : self._n]).any(axis=1)] = 1.0
        x[:, : self._n] = q
        result = NewtonResult(x, step, residual, pivot)
        open_ = np.flatnonzero(np.isfinite(step) & (step >= MAX_SETTLED_STEP_M))
        if len(open_):
            further, went_far = problem.refine(x[open_], rows[open_]), pivot[open_] <= 0.0
            for array, new in zip(result, further, strict=True):
                array[open_] = new.reshape(array[open_].shape)
            pivot[open_[went_far]] = -np.abs(pivot[open_[went_far]])
        return result

    # ------------------------------------------------------------------ uncertainty

    def _covariance(
        self,
        solution: Solutions,
        at: Mapping[str, Any] | None,
        columns: list[int],
        answer_size: int,
        joint_sigma: ArrayLike,
    ) -> np.ndarray:
        unknown, spread = self._linearize(solution, at, columns, joint_sigma, self.model.covariance)
        inverse = np.linalg.pinv(unknown)
        covariance = inverse @ spread @ inverse.swapaxes(1, 2)
        if answer_size:
            covariance = covariance[:, :answer_size, :answer_size]
        else:
            full, moved = np.zeros((len(unknown), 6, 6)), self.model.mechanism.moved
            full[np.ix_(range(len(unknown)), moved, moved)] = covariance[
                :, : len(moved), : len(moved)
            ]
            covariance = full
        return np.asarray(covariance[0] if solution.joints.ndim == 1 else covariance)

    def _linearize(
        self,
        solution: Solutions,
        at: Mapping[str, Any] | None,
        columns: list[int],
        joint_sigma: ArrayLike,
        parameters: np.ndarray | None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the closure's Jacobian (N, m, columns) and the covariance (N, m, m) of its rows.

        The covariance follows from that of the parameters and from the noise of the readings.
        """
        require("solution", solution, "Solutions", SolveError)
        require("joint_sigma", joint_sigma, "ArrayLike", SolveError)
        n, m = self._n, self.model.structure.phi.shape[0]
        rows = np.atleast_2d(solution.configuration.rows)
        a = self.model.condition_rows(at, len(rows))
        found = [
            self._closure(row, one, self.model.values)[1:] for row, one in zip(rows, a, strict=True)
        ]
        # CasADi's matrices come column by column: (N, columns, m) before the axes are swapped.
        J_x, J_v = (
            np.array(flat).reshape(len(rows), -1, m).swapaxes(1, 2)
            for flat in zip(*found, strict=True)
        )
        known = J_x[..., :n]
        spread = (known * np.square(joint_sigma)) @ known.swapaxes(1, 2)
        if parameters is not None:
            spread += J_v @ parameters @ J_v.swapaxes(1, 2)
        return J_x[..., columns], spread

    @cached_property
    def _closure(self) -> Single:
        return Single(self.model.structure.closure)
