"""Elimination of the unknowns in the blocks of a closure, and the side of its singularities."""

from __future__ import annotations

from functools import lru_cache, reduce
from operator import mul
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from parallel_cal.kinematics.solutions import MIN_REGULAR_SINGULAR_VALUE
from parallel_cal.model.structure import Structure


class Block(NamedTuple):
    """Equations that determine some unknowns, once those of the blocks behind it are known.

    `rows` and `columns` are those of the Jacobian in the unknowns, `sign` is that of the block's
    determinant at home; 0 if home selects no side. Loops in series have a block each: two flat
    parallelograms change two signs, and not that of the whole determinant.
    """

    rows: list[int]
    columns: list[int]
    sign: float


def find_blocks(s: Structure, J: Any, home: np.ndarray) -> list[Block]:
    """Split a Jacobian of the closure (rows, unknowns) into blocks, in the order of elimination.

    The rows of each block give large pivots at home, for a robot that is not nominal. The signs are
    those of the nominal robot at a configuration `home`. They are 0 if that is singular, and if
    there are more rows than unknowns or fewer: then two branches may have equal signs.
    """
    off = s.table.nominal + s.table.tolerance * np.random.default_rng(0).standard_normal(
        len(s.table)
    )
    jacobian = ca.Function("J", [s.configuration, s.v, s.a], [J])
    A = np.array(jacobian(home, s.table.nominal, s.neutral))
    example = square(np.array(jacobian(s.mechanism.home.configuration, off, 0)))
    has_sides = (
        A.shape[0] == A.shape[1]
        and bool(np.isfinite(A).all())
        and np.linalg.svd(A, compute_uv=False)[-1] > MIN_REGULAR_SINGULAR_VALUE
    )
    blocks = []
    for rows, columns in _separate(ca.SX(J), len(example)):
        order = [rows[k] for k in _order_rows(example[np.ix_(rows, columns)])]
        sign = np.sign(np.linalg.det(A[np.ix_(order, columns)])) if has_sides else 0.0
        blocks.append(Block(order, columns, float(sign)))
    return blocks


def _separate(J: Any, n: int) -> list[tuple[list[int], list[int]]]:
    """Return rows and columns of the blocks of an upper block triangular matrix, one if there are
    more rows than columns or fewer."""
    pattern = ca.sparsify(J).sparsity()
    if J.shape[0] != J.shape[1] or ca.sprank(pattern) < n:
        return [([*range(n)], [*range(n)])]
    count, row_order, column_order, first_rows, first_columns, *_ = pattern.btf()
    return [
        (
            sorted(row_order[first_rows[k] : first_rows[k + 1]]),
            sorted(column_order[first_columns[k] : first_columns[k + 1]]),
        )
        for k in range(count)
    ]


def _order_rows(A: np.ndarray) -> list[int]:
    """Choose a row order that gives large pivots."""
    A, order = A.copy(), list(range(len(A)))
    for k in range(len(A)):
        best = k + int(np.argmax(np.abs(A[k:, k])))
        A[[k, best]] = A[[best, k]]
        order[k], order[best] = order[best], order[k]
        A[k + 1 :] -= np.outer(A[k + 1 :, k] / A[k, k], A[k])
    return order


def square(J: Any) -> Any:
    """The square matrix that a step with a Jacobian of any shape inverts."""
    rows, unknowns = J.shape
    return J if rows == unknowns else J.T @ J if rows > unknowns else J @ J.T


class Elimination:
    """Compute A^-1 b for several b by elimination in given blocks, the smallest pivot, and a number
    that is positive on home's side of the singularities of all blocks, else negative or 0.

    Rows are not exchanged at run time, so the result is one expression without branches. Newton's
    method corrects the lost accuracy; a small pivot sends the sample to the careful solver.
    """

    def __init__(self, A: Any, blocks: list[Block]):
        self._rows = [row for block in blocks for row in block.rows]
        self._columns = [column for block in blocks for column in block.columns]
        factorise, self._substitute = _elimination(len(self._rows))
        self._factors, self.pivot = factorise(A[self._rows, self._columns])
        pivots, self.side, first = ca.vertsplit(ca.diag(self._factors)), ca.SX(1), 0
        for block in blocks:
            of_block = pivots[first : first + len(block.rows)]
            first += len(block.rows)
            if block.sign:
                self.side = ca.fmin(self.side, ca.sign(block.sign * reduce(mul, of_block)))

    def __call__(self, b: Any) -> Any:
        x = type(b).zeros(len(self._columns))
        x[self._columns] = self._substitute(self._factors, b[self._rows])
        return x


@lru_cache(maxsize=16)
def _elimination(n: int) -> tuple[ca.Function, ca.Function]:
    """Build A -> (factors of A, smallest pivot), and (factors, b) -> A^-1 b, for n unknowns.

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
    pivot = ca.mmin(ca.fabs(ca.diag(factors)))
    y = ca.vertsplit(b)
    for i in range(n):
        y[i] = y[i] - sum(A[i, k] * y[k] for k in range(i))
    for i in reversed(range(n)):
        y[i] = (y[i] - sum(A[i, k] * y[k] for k in range(i + 1, n))) / A[i, i]
    return (
        ca.Function("factorise", [A], [factors, pivot]),
        ca.Function("substitute", [A, b], [ca.vertcat(*y)]),
    )
