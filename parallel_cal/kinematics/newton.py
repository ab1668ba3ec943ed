"""Newton's method on the closure (eq. 6.31), for any split into given and unknown coordinates."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, reduce
from operator import mul
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.compiled import dense
from parallel_cal.base.rotation import cayley, exponential
from parallel_cal.kinematics.solutions import MIN_REGULAR_SINGULAR_VALUE
from parallel_cal.kinematics.start import (
    begins_at_home,
    path_home,
    start_function,
    unknown_columns,
)
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.structure import Structure

ITERATIONS = 2  # third order, from the solution of model 24; more follow only if necessary
INLINE_BELOW = 2000  # instructions of one step; below that, repeating them is faster than a call


@dataclass(frozen=True)
class NewtonFunctions:
    """CasADi functions of one problem.

    `tables`: v -> k, evaluated once per model. `solve` and `refine`: (configuration, a, k with the
    lower and upper joint limits) -> configuration, last step (m), norm of phi (m), smallest pivot,
    smallest distance of a joint from its limits, negative outside. The pivot is negative on the
    other side of a singularity than home, and where the iterations went too far from where they
    began to stay on its branch. `solve` begins at the mechanism's own start, `refine` at the given
    configuration. `columns`: the unknown columns of (q, r, w, u). `home_sign`: sign of the
    determinant of the closure's Jacobian in the unknowns at home; 0 if home selects no side.
    `motor_sign`: that of the direct problem, if `inverse` keeps to this side, too; else 0.
    `iteration`: the parts of `solve` and `refine`.
    """

    tables: ca.Function
    solve: ca.Function
    refine: ca.Function
    columns: list[int]
    home_sign: float
    motor_sign: float
    iteration: Iteration


@lru_cache(maxsize=64)
def newton_functions(structure: Structure, problem: str) -> NewtonFunctions:
    """Build Newton iterations for `problem` = "direct" or "inverse", ready to compile.

    CasADi finds the parts of the expression that depend on the parameters alone, and those that
    depend on the given coordinates alone. They are computed once, not in every iteration.
    """
    s = structure
    columns, given, start = split(s, problem)
    J = s.differentiate_closure(columns)
    order, home_sign = row_order(s, J), find_home_sign(s, J, path_home(s.ideal, problem))
    motor_sign, motor_side = _side_of_motors(s, problem)
    (phi, J, rest, motor_side), constants, symbols = _extract_constant_parts(
        [s.phi, J, s.residual, motor_side], ca.vertcat(given, s.v, s.a)
    )
    before = ca.vertcat(constants, start)
    (before,), tables, table_symbols = _extract_constant_parts([before], s.v)
    closure, residual, motors = (
        dense("rows", [s.configuration, symbols], [part]) for part in (phi, rest, motor_side)
    )
    side = home_sign * _sign_of(order)
    step = _step_function(s, closure, J, symbols, columns, order, side)
    prepare = dense("prepare", [s.configuration, s.a, table_symbols], [before])
    tables_function = dense("tables", [s.v], [tables])
    iterate = Iteration(
        prepare,
        step,
        residual,
        motors,
        constants.shape[0],
        ITERATIONS,
        s.mechanism,
        begins_at_home(s.ideal, problem),
    )
    solve = iterate.function(f"{problem}_solve", from_start=True)
    refine = iterate.function(f"{problem}_refine", from_start=False)
    return NewtonFunctions(tables_function, solve, refine, columns, home_sign, motor_sign, iterate)


def split(s: Structure, problem: str) -> tuple[list[int], Any, Any]:
    """Return the unknown columns of (q, r, w, u), the given symbols and the start configuration."""
    m, columns = s.mechanism, unknown_columns(s, problem)
    start = start_function(s.ideal, problem)(s.configuration, s.geometry.column)
    if problem == "direct":
        return columns, s.q, start
    given = [s.r[i] for i in range(3) if i not in m.parasitic]
    if not any(i >= 3 for i in m.parasitic):
        given.append(s.R9)
    return columns, ca.vertcat(*given), start


def _side_of_motors(s: Structure, problem: str) -> tuple[float, Any]:
    """Return the sign of the direct problem's determinant at home, and an expression that is
    positive on this side; 0 and 1 where the problem does not keep to it.

    The motors do not pass a direct singularity. `inverse` that is followed from home does not,
    either; a closed form answers for each pose that it is given.
    """
    if problem == "direct" or not begins_at_home(s.ideal, problem):
        return 0.0, ca.SX(1)
    columns = unknown_columns(s, "direct")
    J = s.differentiate_closure(columns)
    sign = find_home_sign(s, J, np.array(s.mechanism.home.configuration))
    if not sign:
        return 0.0, ca.SX(1)
    order = row_order(s, J)
    return sign, sign * _sign_of(order) * Elimination(J, order).determinant


def _sign_of(order: list[int]) -> float:
    """Return the sign of a permutation: the determinant of ordered rows is that of the rows times
    this sign."""
    return float(np.linalg.det(np.eye(len(order))[order]).round())


def _extract_constant_parts(expressions: list[Any], of: Any) -> tuple[list[Any], Any, Any]:
    """Replace every part of the expressions that depends on `of` alone by a symbol.

    Returns the rewritten expressions, the parts (column) and their symbols (column).
    """
    rewritten, symbols, parts = ca.extract_parametric(expressions, of, {})
    of_names = {str(x) for x in ca.symvar(of)}
    # CasADi leaves bare symbols of `of` in the expressions. They become parts, too.
    bare = [x for x in ca.symvar(ca.veccat(*rewritten)) if str(x) in of_names]
    symbol_column = ca.veccat(*symbols, *bare)
    part_column = ca.veccat(*parts, *bare)
    fresh = ca.SX.sym("c", symbol_column.shape[0])
    rewritten = ca.substitute(rewritten, [symbol_column], [fresh])
    return rewritten, part_column, fresh


def _step_function(
    s: Structure,
    closure: ca.Function,
    J: Any,
    symbols: Any,
    columns: list[int],
    order: list[int],
    side: float,
) -> ca.Function:
    """(configuration, constants) -> configuration after one iteration, last step, pivot.

    The pivot is negative if the determinant of the ordered rows has another sign than `side`.

    One iteration is a Newton step and a second step with the same Jacobian: third order
    (Traub) at little more than the cost of one step. With more rows than unknowns the step is that
    of least squares; with fewer (a redundant arm) it is the shortest one that closes the rows.
    """
    solver = Elimination(_square(J), order)

    def stepped(x: Any) -> tuple[Any, Any]:
        phi = closure(x, symbols)
        if J.shape[0] < J.shape[1]:
            scaled = J.T @ solver(-phi)
        else:
            scaled = solver(-(J.T @ phi if J.shape[0] > J.shape[1] else phi))
        return apply_change(s, x, columns, scaled), scaled

    once, _ = stepped(s.configuration)
    twice, scaled = stepped(once)
    pivot = solver.pivot * (ca.sign(side * solver.determinant) if side else 1)
    return dense("step", [s.configuration, symbols], [twice, ca.norm_2(scaled), pivot])


def _square(J: Any) -> Any:
    """The square matrix that a step with a Jacobian of any shape inverts."""
    rows, unknowns = J.shape
    return J if rows == unknowns else J.T @ J if rows > unknowns else J @ J.T


def apply_change(
    s: Structure,
    x: Any,
    columns: list[int],
    scaled: Any,
    rotation: Callable[[Any], Any] = cayley,
) -> Any:
    """Apply a change of the unknown coordinates, in metres, to a configuration."""
    change = ca.SX.zeros(len(s.scale))
    change[columns] = scaled / ca.DM(s.scale[columns])
    n = len(s.mechanism.joints)
    R9 = x[n + 3 : n + 12]
    if any(n + 3 <= c < n + 6 for c in columns):
        R9 = ca.vec((rotation(change[n + 3 : n + 6]) @ ca.reshape(R9, 3, 3).T).T)
    return ca.vertcat(x[: n + 3] + change[: n + 3], R9, x[n + 12 :] + change[n + 6 :])


def change_function(s: Structure, columns: list[int]) -> ca.Function:
    """(configuration, change of the unknown coordinates in metres) -> configuration, with the
    rotation exp(w) also of a large change."""
    change = ca.SX.sym("change", len(columns))
    changed = apply_change(s, s.configuration, columns, change, exponential)
    return dense("change", [s.configuration, change], [changed])


@lru_cache(maxsize=64)
def short_step(m: Mechanism) -> np.ndarray:
    """Return how far the entries (nq + 12 + nu,) of a configuration may change, at most, in a step
    that stays on its branch, unless a determinant changes its sign. A jump to another branch is
    finite, however short the step; these bounds are well below it."""
    joints, passive = np.full(len(m.joints), 0.5), np.full(len(m.passive), 0.5)
    return np.concatenate([joints, np.full(3, m.length), np.full(9, 0.25), passive])


def find_home_sign(s: Structure, J: Any, home: np.ndarray) -> float:
    """Sign of the determinant of the nominal robot's Jacobian at home; 0 at a singular home, and
    if there are more rows than unknowns or fewer: then two branches may have equal signs."""
    jacobian = ca.Function("J", [s.configuration, s.v, s.a], [J])
    A = np.array(jacobian(home, s.table.nominal, s.neutral))
    if A.shape[0] != A.shape[1] or not np.isfinite(A).all():
        return 0.0
    regular = np.linalg.svd(A, compute_uv=False)[-1] > MIN_REGULAR_SINGULAR_VALUE
    return float(np.sign(np.linalg.det(A))) if regular else 0.0


def row_order(s: Structure, J: Any) -> list[int]:
    """Choose a row order that gives large pivots at home, for a robot that is not nominal."""
    off = s.table.nominal + s.table.tolerance * np.random.default_rng(0).standard_normal(
        len(s.table)
    )
    m = s.mechanism
    example = ca.Function("J", [s.configuration, s.v, s.a], [J])
    A = _square(np.array(example(m.home.configuration, off, 0)))
    order = list(range(len(A)))
    for k in range(len(A)):
        best = k + int(np.argmax(np.abs(A[k:, k])))
        A[[k, best]] = A[[best, k]]
        order[k], order[best] = order[best], order[k]
        A[k + 1 :] -= np.outer(A[k + 1 :, k] / A[k, k], A[k])
    return order


class Elimination:
    """Compute A^-1 b for several b by elimination in a given row order, the smallest pivot, and the
    determinant of the ordered rows.

    Rows are not exchanged at run time, so the result is one expression without branches. Newton's
    method corrects the lost accuracy; a small pivot sends the sample to the careful solver.
    """

    def __init__(self, A: Any, order: list[int]):
        self._order = order
        factorise, self._substitute = _elimination(len(order))
        self._factors, self.pivot, self.determinant = factorise(A[order, :])

    def __call__(self, b: Any) -> Any:
        return self._substitute(self._factors, b[self._order])


@lru_cache(maxsize=16)
def _elimination(n: int) -> tuple[ca.Function, ca.Function]:
    """Build A -> (factors of A, smallest pivot, determinant), and (factors, b) -> A^-1 b, for n
    unknowns.

    To call these functions with symbols takes a tenth of the time of the same operations in Python.
    """
    A, b = ca.SX.sym("A", n, n), ca.SX.sym("b", n)
    M = [[A[i, j] for j in range(n)] for i in range(n)]
    # Upper triangle in place; the factors are stored in the place of the zeros below it.
    for k in range(n):
        for i in range(k + 1, n):
            M[i][k] = M[i][k] / M[k][k]
            for j in range(k + 1, n):
                M[i][j] = M[i][j] - M[i][k] * M[k][j]
    factors = ca.vertcat(*[ca.horzcat(*row) for row in M])
    pivots = ca.diag(factors)
    pivot, determinant = ca.mmin(ca.fabs(pivots)), reduce(mul, ca.vertsplit(pivots))
    y = ca.vertsplit(b)
    for i in range(n):
        y[i] = y[i] - sum(A[i, k] * y[k] for k in range(i))
    for i in reversed(range(n)):
        y[i] = (y[i] - sum(A[i, k] * y[k] for k in range(i + 1, n))) / A[i, i]
    return (
        ca.Function("factorise", [A], [factors, pivot, determinant]),
        ca.Function("substitute", [A, b], [ca.vertcat(*y)]),
    )


@dataclass(frozen=True)
class Iteration:
    """The CasADi functions of one iteration.

    `prepare`: (configuration, a, k) -> constants, start.
    `step`: (configuration, constants) -> configuration, last step (m), smallest pivot.
    `residual`: (configuration, constants) -> the rows whose norm is the residual.
    `motors`: (configuration, constants) -> negative beyond a direct singularity.
    `at_home`: the start is home, or its expansion.
    """

    prepare: ca.Function
    step: ca.Function
    residual: ca.Function
    motors: ca.Function
    n_constants: int
    iterations: int
    mechanism: Mechanism
    at_home: bool

    def function(self, name: str, from_start: bool) -> ca.Function:
        """Build a fixed number of iterations; a short step is inlined, a long one is called."""
        symbol = ca.SX if self.step.n_instructions() < INLINE_BELOW else ca.MX
        sizes = [self.prepare.numel_in(i) for i in range(3)]
        n, m = len(self.mechanism.joints), self.mechanism
        given, a = (symbol.sym(f"i{i}", size) for i, size in enumerate(sizes[:2]))
        k_and_limits = symbol.sym("i2", sizes[2] + 2 * n)
        k, low, high = ca.vertsplit(k_and_limits, [0, sizes[2], sizes[2] + n, sizes[2] + 2 * n])
        prepared = self.prepare(given, a, k)
        constants = prepared[: self.n_constants]
        x = prepared[self.n_constants :] if from_start else given
        start, begin = x, ca.DM(m.home.passive) if from_start else x[n + 12 :]
        for _ in range(self.iterations):
            x, length, pivot = self.step(x, constants)
        signs = ca.sign(self.motors(x, constants))
        if self.at_home or not from_start:  # a closed form has the branch of home anywhere
            far = ca.mmax(ca.fabs(x - start) - ca.DM(short_step(m))) > 0
            signs = ca.fmin(signs, ca.if_else(far, -1, 1))
        pivot = ca.fmin(pivot, signs * ca.fabs(pivot))
        # A long step may turn a passive joint several times: its angle is moved by whole turns to
        # within half a turn of home, or of the configuration to refine.
        u = x[n + 12 :]
        for k, unit in enumerate(m.passive_units):
            if unit == "rad":
                turn = 2 * np.pi
                u[k] -= turn * ca.floor((u[k] - begin[k]) / turn + 0.5)
        x = ca.vertcat(x[: n + 12], u)
        residual = ca.norm_2(self.residual(x, constants))
        inside = ca.mmin(ca.vertcat(x[:n] - low, high - x[:n]))
        return ca.Function(name, [given, a, k_and_limits], [x, length, residual, pivot, inside])
