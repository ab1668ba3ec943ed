"""Linear factors of a closure: the fewest that separate parameters from coordinates (5.3.8).

The factors of a row are counted, not guessed: monomials that depend on one another on real
configurations (cos^2 + sin^2 = 1, R^T R = 1) are merged by a rank-revealing QR, then functions of
the parameters that depend on one another; one, the least variable, is divided out.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.identification.observability import find_independent_columns
from parallel_cal.identification.thresholds import ROUNDING
from parallel_cal.model.configuration import Configuration
from parallel_cal.model.model import Model
from parallel_cal.thesis.methods._separation import Separation

DRAWS = 400  # random configurations and parameters that distinguish factors


@dataclass(frozen=True)
class Row:
    """scale * (M_0 + sum_j f_j M_j) = 0: `of_parameters` v -> f, `monomials` the M as SX.

    `scale` keeps the row in metres; `constant` is the index of the factor with M = 1, or -1.
    """

    of_parameters: ca.Function
    jacobian: ca.Function
    lead: ca.SX
    monomials: ca.SX
    scale: float
    constant: int

    def __len__(self) -> int:
        return int(self.monomials.numel())

    def factors(self, values: np.ndarray) -> np.ndarray:
        return np.array(self.of_parameters(values)).ravel()


def separate_factors(model: Model, seed: int = 0) -> list[Row]:
    """Find the factors of every closure row of a model; FitError if it cannot be separated."""
    separation = Separation(model.structure)
    # Draw any configurations that the moved coordinates allow, far apart.
    rng, m = np.random.default_rng(seed), model.mechanism
    joints = rng.uniform(-1, 1, (DRAWS, len(model.joints)))
    joints = joints * (np.pi if m.joint_unit == "rad" else 1.0)
    r, w = rng.uniform(-1, 1, (DRAWS, 3)), rng.uniform(-2, 2, (DRAWS, 3))
    moved = np.isin(np.arange(6), m.moved)
    x = Configuration(joints, r * moved[:3], rotation_matrix(w * moved[3:])).rows
    # Draw all parameters far around nominal: a zero parameter need not stay zero.
    rng, table = np.random.default_rng(seed + 1), model.table
    width = 100 * table.tolerance
    lengths = [1e-3 < abs(p.nominal) < 10 and p.unit == "m" for p in table]
    width = np.where(lengths, np.minimum(width, 0.3 * np.abs(table.nominal)), width)
    p = np.asarray(table.nominal + width * rng.uniform(-1, 1, (DRAWS, len(table))))
    return [_row(model, separation, k, x, p) for k in range(len(separation.rows))]


def _row(model: Model, separation: Separation, k: int, x: np.ndarray, p: np.ndarray) -> Row:
    s, row = model.structure, separation.rows[k]
    polynomial = {m: row[m] for m in sorted(row, key=len)}
    M = ca.vertcat(*[separation.monomial(m) for m in polynomial])
    c = ca.vertcat(*polynomial.values())
    # Monomials: keep a basis, and add the coefficients of the others to it.
    basis, others = _merge_dependent(_evaluate(M, s.configuration, x))
    M, c = M[basis], c[basis] + ca.DM(others).T @ c
    # Coefficients: the same, so that one function of the parameters has one factor.
    basis, others = _merge_dependent(_evaluate(c, s.v, p))
    M, c = M[basis] + ca.DM(others).T @ M, c[basis]
    # Divide by the lead: it must be far from zero at the model's values, and vary least.
    here = np.abs(_evaluate(c, s.v, model.values[None])[0])
    first = int(np.argmin(_evaluate(c, s.v, p).std(axis=0) / np.maximum(here, 1e-300)))
    rest = [j for j in range(c.numel()) if j != first]
    f = c[rest] / c[first]
    constant = [i for i, j in enumerate(rest) if ca.SX(M[j]).is_constant()]
    return Row(
        ca.Function("factors", [s.v], [f]),
        ca.Function("factors_jacobian", [s.v], [ca.densify(ca.jacobian(f, s.v))]),
        M[first],
        M[rest],
        float(ca.Function("lead", [s.v], [c[first]])(model.values)),
        constant[0] if constant else -1,
    )


def _merge_dependent(columns: np.ndarray) -> tuple[list[int], np.ndarray]:
    """Return the independent columns, and the coefficients (n_columns, n_kept) that express the
    other columns by them.

    Earlier columns take precedence over later ones. The rows of independent columns are zero.
    """
    sizes = np.linalg.norm(columns, axis=0)
    nothing = sizes < 1e-11 * sizes.max()  # columns that cancel up to rounding
    unit = np.where(nothing, 0.0, columns / np.where(nothing, 1.0, sizes))
    kept = np.flatnonzero(find_independent_columns(unit, ROUNDING)).tolist()
    made = np.linalg.lstsq(columns[:, kept], columns, rcond=None)[0].T
    made[kept], made[nothing] = 0.0, 0.0
    return kept, np.where(np.abs(made) > 1e-7, made.round(9), 0.0)


def _evaluate(expression: ca.SX, symbols: ca.SX, at: np.ndarray) -> np.ndarray:
    f = ca.Function("f", [symbols], [ca.densify(expression)])
    return np.array(f.map(len(at))(at.T)).T
