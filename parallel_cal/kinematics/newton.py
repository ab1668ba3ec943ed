"""Newton's method on the closure (eq. 6.31), for any split into given and unknown coordinates."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.compiled import dense
from parallel_cal.base.rotation import cayley, exponential
from parallel_cal.kinematics.elimination import Block, Elimination, find_blocks, square
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
    configuration. `columns`: the unknown columns of (q, r, w, u). `blocks`: those of the closure's
    Jacobian in the unknowns. `motor_blocks`: those of the direct problem, to whose side `inverse`
    keeps, too; none for `direct`. `iteration`: the parts of `solve` and `refine`.
    """

    tables: ca.Function
    solve: ca.Function
    refine: ca.Function
    columns: list[int]
    blocks: list[Block]
    motor_blocks: list[Block]
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
    blocks = find_blocks(s, J, path_home(s.ideal, problem))
    motor_blocks, motor_side = _side_of_motors(s, problem)
    (phi, J, rest, motor_side), constants, symbols = _extract_constant_parts(
        [s.phi, J, s.residual, motor_side], ca.vertcat(given, s.v, s.a)
    )
    before = ca.vertcat(constants, start)
    (before,), tables, table_symbols = _extract_constant_parts([before], s.v)
    closure, residual, motors = (
        dense("rows", [s.configuration, symbols], [part]) for part in (phi, rest, motor_side)
    )
    step = _step_function(s, closure, J, symbols, columns, blocks)
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
    return NewtonFunctions(tables_function, solve, refine, columns, blocks, motor_blocks, iterate)


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


def _side_of_motors(s: Structure, problem: str) -> tuple[list[Block], Any]:
    """Return the blocks of the direct problem, and an expression that is positive on home's side of
    its singularities; none and 1 for the direct problem, and where it has no sides.

    The joints of `inverse` must lead back to its pose. The motors do not pass a direct singularity:
    beyond it, they lead to another pose.
    """
    if problem == "direct":
        return [], ca.SX(1)
    J = s.differentiate_closure(unknown_columns(s, "direct"))
    blocks = find_blocks(s, J, np.array(s.mechanism.home.configuration))
    if not any(block.sign for block in blocks):
        return [], ca.SX(1)
    return blocks, Elimination(J, blocks).side


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
    blocks: list[Block],
) -> ca.Function:
    """(configuration, constants) -> configuration after one iteration, last step, pivot.

    The pivot is negative if the determinant of a block has another sign than at home.

    One iteration is a Newton step and a second step with the same Jacobian: third order
    (Traub) at little more than the cost of one step. With more rows than unknowns the step is that
    of least squares; with fewer (a redundant arm) it is the shortest one that closes the rows.
    """
    solver = Elimination(square(J), blocks)

    def stepped(x: Any) -> tuple[Any, Any]:
        phi = closure(x, symbols)
        if J.shape[0] < J.shape[1]:
            scaled = J.T @ solver(-phi)
        else:
            scaled = solver(-(J.T @ phi if J.shape[0] > J.shape[1] else phi))
        return apply_change(s, x, columns, scaled), scaled

    once, _ = stepped(s.configuration)
    twice, scaled = stepped(once)
    pivot = solver.pivot * solver.side
    return dense("step", [s.configuration, symbols], [twice, ca.norm_2(scaled), pivot])


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
    joints, passive = (
        [0.5 * (m.length if unit == "m" else 1.0) for unit in units]
        for units in (m.joint_units, m.passive_units)
    )
    return np.concatenate([joints, np.full(3, m.length), np.full(9, 0.25), passive])


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
        if self.at_home or not from_start:  # a closed form is near its solution
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
