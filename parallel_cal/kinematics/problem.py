"""One split into given and unknown coordinates, with a fast and a careful solver."""

from __future__ import annotations

from functools import cached_property, lru_cache

import numpy as np

from parallel_cal.base.compiled import Batch, Single
from parallel_cal.kinematics.elimination import Block
from parallel_cal.kinematics.newton import change_function, newton_functions
from parallel_cal.kinematics.rows import limits_in
from parallel_cal.kinematics.solutions import (
    MAX_CLOSED_RESIDUAL_M,
    MAX_SETTLED_STEP_M,
    Solutions,
    Status,
)
from parallel_cal.kinematics.split_turns import splits_turns, turn_towards
from parallel_cal.kinematics.start import begins_at_home, path_home
from parallel_cal.model.model import Model
from parallel_cal.model.structure import Structure

MAX_DESCENT_STEPS = 100
# A descent ends at a least closure that is not zero if so many steps leave more than this share.
SLOW_STEPS, MAX_SLOW_SHARE = 10, 0.9


class _Calls:
    """Newton iterations of a structure for one split. All models of the structure share them."""

    def __init__(self, structure: Structure, name: str, compile: bool):
        functions = newton_functions(structure, name)
        self._refine, self._compile = functions.refine, compile
        self.columns, self.tables = functions.columns, Single(functions.tables)
        self.blocks, self.motor_blocks = functions.blocks, functions.motor_blocks
        self._structure = structure
        self.many = Batch(functions.solve, 0 if compile else None)

    @cached_property
    def refine(self) -> Batch:
        return Batch(self._refine, 0 if self._compile else None)

    @cached_property
    def change(self) -> Single:
        return Single(change_function(self._structure, self.columns))


_calls = lru_cache(maxsize=256)(_Calls)


class Problem:
    """One split into given and unknown coordinates, with the parameter values of one model."""

    def __init__(self, model: Model, name: str, compile: bool):
        robot = model.structure.robot
        self.calls = _calls(robot, name, compile)
        self.model, self.name = model, name
        self._n = len(model.joints)
        self.unknown_joints = name == "inverse"
        self.splits_turns = self.unknown_joints and splits_turns(model.mechanism)
        self.low, self.high = limits_in(name, model.mechanism).T
        (tables,) = self.calls.tables(model.values[: len(robot.table)])
        self.k_and_limits = np.concatenate([tables, self.low, self.high])
        self.columns = self.calls.columns
        # More rows than unknowns (lines of a cable robot): the solution is that of least squares.
        # Its residual is not zero, so the residual does not decide on the status.
        self.redundant = model.structure.phi.shape[0] > len(self.columns)
        # Largest residual (m) of a converged solution
        self.largest = np.inf if self.redundant else MAX_CLOSED_RESIDUAL_M

    def solve_many(self, given: np.ndarray, rows: np.ndarray) -> list[np.ndarray]:
        """Iterate from the mechanism's own start; return the parts of a `NewtonResult`."""
        # Joints may be moved by whole turns later, so their distance from the limits is omitted.
        return self.calls.many(given, rows, self.k_and_limits)[:4]

    def refine(self, begin: np.ndarray, rows: np.ndarray) -> list[np.ndarray]:
        """Iterate from given configurations, like `solve_many`."""
        return self.calls.refine(begin, rows, self.k_and_limits)[:4]

    def begin(self, given: np.ndarray, start: Solutions) -> np.ndarray:
        """Copy `given`, with the unknown coordinates taken from `start`."""
        return self.begin_from(given, start.configuration.rows)

    def begin_from(self, given: np.ndarray, start: np.ndarray) -> np.ndarray:
        """Copy `given`, with the unknown coordinates taken from the configurations `start`."""
        x = np.where(self._is_unknown, start, given)
        if self.unknown_joints:
            turns, shape = slice(self._n + 3, self._n + 12), (*x.shape[:-1], 3, 3)
            R, begin = (rows[..., turns].reshape(shape) for rows in (x, start))
            R = turn_towards(self.model.mechanism, R, begin)
            x[..., turns] = R.reshape(x[..., turns].shape)
        return x

    @cached_property
    def _is_unknown(self) -> np.ndarray:
        """Which entries (nq + 12 + nu,) of a configuration are unknown, the rotation of `inverse`
        aside."""
        m = self.model.mechanism
        joints, passive = [self.unknown_joints] * self._n, [True] * len(m.passive)
        pose = [i in m.parasitic for i in range(3)] + [False] * 9
        return np.array([*joints, *(pose if self.unknown_joints else [True] * 12), *passive])

    @cached_property
    def home(self) -> np.ndarray:
        """The configuration (nq + 12 + nu,) at which paths begin."""
        return path_home(self.model.structure.ideal, self.name)

    @cached_property
    def begins_at_home(self) -> bool:
        """Whether `solve_many` begins at home, or at its expansion, and not at a closed form."""
        return begins_at_home(self.model.structure.ideal, self.name)

    @cached_property
    def has_branches(self) -> bool:
        """Whether home selects one of several branches. A singular home does not, nor does one
        whose solution is any of many, as with fewer rows than unknowns."""
        enough = self.model.structure.phi.shape[0] >= len(self.columns)
        sides = any(block.sign for block in self.calls.blocks)
        return sides or (self.begins_at_home and enough)

    def settle(self, begin: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Iterate from configurations (N, nq + 12 + nu); return the ends, and which of them settled
        near their begin on home's side of the singularities."""
        x, *measures = self.refine(begin, rows)
        step, residual, pivot = (part.reshape(-1) for part in measures)
        open_ = np.flatnonzero((pivot > 0.0) & ~(step < MAX_SETTLED_STEP_M))
        if len(open_):
            x[open_], *further = self.refine(x[open_], rows[open_])
            step[open_], residual[open_], pivot[open_] = (part.reshape(-1) for part in further)
        return x, (step < MAX_SETTLED_STEP_M) & (residual < self.largest) & (pivot > 0.0)

    @cached_property
    def single_solver(self) -> Single:
        """`solve_many` for one sample; its buffers hold home, neutral conditions and the tables."""
        single, home = Single(self.calls.many.function), self.model.mechanism.home.configuration
        for array, known in zip(
            single.arguments, (home, self.neutral, self.k_and_limits), strict=True
        ):
            array[:] = known
        return single

    @cached_property
    def single_refiner(self) -> Single:
        """`refine` for one sample, from the end of `single_solver`, whose buffers it reads."""
        begin, (_, a, k_and_limits) = self.single_solver.results[0], self.single_solver.arguments
        return Single(self.calls.refine.function, (begin, a, k_and_limits))

    @cached_property
    def neutral(self) -> np.ndarray:
        return self.model.condition_rows(None, 1)[0]

    # ------------------------------------------------------------------ the careful solver

    @cached_property
    def _rows(self) -> Single:
        return Single(self.model.structure.residual_batch.function)

    @cached_property
    def _evaluate(self) -> Single:
        return Single(self.model.structure.closure_configuration)

    def _phi_and_jacobian(
        self, x: np.ndarray, a: np.ndarray, columns: list[int]
    ) -> tuple[np.ndarray, np.ndarray]:
        phi, J = self._evaluate(x, a, self.model.values)
        J = J.reshape(-1, len(phi)).T[:, columns]
        return phi, J / self.model.structure.scale[columns]

    def smallest_singular_value(self, x: np.ndarray, a: np.ndarray) -> float:
        """Smallest singular value of the closure's Jacobian in the unknowns, scaled to metres.

        Zero means singular.
        """
        return float(
            np.linalg.svd(self._phi_and_jacobian(x, a, self.columns)[1], compute_uv=False)[-1]
        )

    def residual(self, x: np.ndarray, a: np.ndarray) -> float:
        """Norm of the closure, and of how far a configuration is out of reach, m."""
        (rows,) = self._rows(x, a, self.model.values)
        return float(np.linalg.norm(rows))

    def is_on_home_side(self, x: np.ndarray, a: np.ndarray) -> bool:
        """Whether a configuration is on home's side of the singularities; for `inverse`, also of
        those of the direct problem."""
        return all(self.find_sides(x, a)) and self.has_motors_on_home_side(x, a)

    def has_motors_on_home_side(self, x: np.ndarray, a: np.ndarray) -> bool:
        """Whether a solution of `inverse` is on home's side of the direct singularities."""
        columns = self.model.mechanism.dependent_columns
        return all(self._compare_signs(x, a, columns, self.calls.motor_blocks))

    def find_sides(self, x: np.ndarray, a: np.ndarray) -> list[bool]:
        """Whether the determinant of each block of that Jacobian has the sign that it has at
        home."""
        return self._compare_signs(x, a, self.columns, self.calls.blocks)

    def _compare_signs(
        self, x: np.ndarray, a: np.ndarray, columns: list[int], blocks: list[Block]
    ) -> list[bool]:
        if not any(block.sign for block in blocks):
            return []
        _, J = self._phi_and_jacobian(x, a, columns)
        dets = (np.linalg.det(J[np.ix_(block.rows, block.columns)]) for block in blocks)
        return [block.sign * float(det) > 0.0 for block, det in zip(blocks, dets, strict=True)]

    def descend(self, x: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, float, Status]:
        """Descend from a configuration by Levenberg-Marquardt (C.4)."""
        phi, J = self._phi_and_jacobian(x, a, self.columns)
        damping, size, identity = 1e-3, float(np.linalg.norm(phi)), np.eye(J.shape[1])
        sizes = [np.inf] * SLOW_STEPS
        for _ in range(MAX_DESCENT_STEPS):
            sizes.append(size)
            if size > MAX_SLOW_SHARE * sizes[-1 - SLOW_STEPS] and not self.redundant:
                break
            gradient, normal = J.T @ phi, J.T @ J
            try:
                step = -np.linalg.solve(normal + damping * identity, gradient)
            except np.linalg.LinAlgError:  # a start that blew up
                return x, size, Status.NOT_CONVERGED
            if np.linalg.norm(step) < 1e-15:
                break
            (candidate,) = self.calls.change(x, step)
            new_phi, new_J = self._phi_and_jacobian(candidate, a, self.columns)
            new_size = float(np.linalg.norm(new_phi))
            if new_size < size:
                improved = size - new_size > 1e-14
                x, phi, J, size, damping = candidate, new_phi, new_J, new_size, damping / 10
                if not improved:
                    break
            else:
                damping = max(damping * 10, 1e-12)
                if damping > 1e12:
                    break
        flat, size = float(np.linalg.norm(J.T @ phi)) < 1e-6 * size, self.residual(x, a)
        if size < MAX_CLOSED_RESIDUAL_M or (flat and self.redundant):
            return x, size, Status.CONVERGED
        return x, size, Status.UNREACHABLE if flat or size > 1e-6 else Status.NOT_CONVERGED
