"""Score how much of the residual an effect would remove, before anything is refitted."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from parallel_cal.diagnosis.thresholds import MIN_COLUMN_REMAINDER, MIN_VISIBLE_SIGMAS
from parallel_cal.posterior.scene import Scene


@dataclass(frozen=True)
class Score:
    """F test of one group of columns: g = U^T r, F = (g.g / q) / ((r.r - g.g) / (dof - q)).

    `remaining` is the share of the columns that no geometry imitates, `size` the sigmas by which
    the effect at its typical size moves the residuals, `U` (n, q) the directions it acts in.
    """

    F: float
    log_p: float
    q: int
    remaining: float
    size: float
    U: np.ndarray = field(repr=False)

    @property
    def p_value(self) -> float:
        return float(np.exp(self.log_p))


def score(scene: Scene, B: np.ndarray) -> Score:
    """The F test of columns B (n, k), in tolerances."""
    lengths = np.linalg.norm(B, axis=0)
    B = B[:, lengths > 1e-9]
    lengths = lengths[lengths > 1e-9]
    if not len(lengths):
        return Score(0.0, 0.0, 0, 0.0, 0.0, np.zeros((len(scene.residual), 0)))
    projected = scene.project_off_geometry(B / lengths)
    # Twice: what a first projection of a nearly parallel column leaves is not quite orthogonal.
    left = scene.project_off_geometry(projected)
    squares, directions = np.linalg.eigh(left.T @ left)
    # What is left of a direction must exceed rounding, or matter at the effect's typical size.
    typical = np.linalg.norm(directions * lengths[:, None], axis=0)
    seen = np.minimum(MIN_COLUMN_REMAINDER, MIN_VISIBLE_SIGMAS / typical)
    visible = (squares > seen**2)[::-1]
    U = (left @ directions)[:, ::-1][:, visible] / np.sqrt(squares[::-1][visible])
    remaining = float(np.sqrt(np.mean(np.sum(projected**2, axis=0))))
    size = float(np.sqrt(np.mean(np.sum((projected * lengths) ** 2, axis=0))))
    F, log_p = f_test(scene.residual, U, scene.dof)
    return Score(F, log_p, U.shape[1], remaining, size, U)


def score_beside(scene: Scene, one: Score, other: Score) -> Score:
    """The F test of one group of columns by what another group leaves of residuals and columns."""
    r = scene.residual - other.U @ (other.U.T @ scene.residual)
    left = one.U - other.U @ (other.U.T @ one.U)
    squares, directions = np.linalg.eigh(left.T @ left)
    visible = squares > MIN_COLUMN_REMAINDER**2
    U = left @ directions[:, visible] / np.sqrt(squares[visible])
    F, log_p = f_test(r, U, scene.dof - other.q)
    return replace(one, F=F, log_p=log_p, q=U.shape[1], U=U)


def f_test(r: np.ndarray, U: np.ndarray, dof: int) -> tuple[float, float]:
    """F and the logarithm of its p-value for orthonormal U (n, q); (0, 0) where q = 0."""
    g = U.T @ r
    return _f_of(float(g @ g), r, len(g), dof)


def _f_of(taken: float, r: np.ndarray, q: int, dof: int) -> tuple[float, float]:
    if q == 0 or dof <= q:
        return 0.0, 0.0
    left = float(r @ r) - taken
    F = (taken / q) / max(left / (dof - q), 1e-300)
    return F, float(log_p_of(F, q, dof - q))


def log_p_of(F: Any, q: int, dof: int) -> Any:
    """log P(F' > F), of one F or an array, with q and dof degrees of freedom, by the incomplete
    beta function."""
    from scipy.special import betainc, gammaln

    z, a, b = dof / (dof + q * F), dof / 2, q / 2
    p = betainc(a, b, z)
    with np.errstate(divide="ignore"):
        # The leading term of its series, where it underflows.
        series = a * np.log(z) + b * np.log1p(-z) - np.log(a)
        found = np.where(p > 1e-290, np.log(p), series - (gammaln(a) + gammaln(b) - gammaln(a + b)))
    return found[()]


def deflate(one: Score, dof: int, inflation: float) -> float:
    """log p of a score whose columns change as slowly as correlated noise: F is divided by the
    inflation of a slow mean's variance, as if there were so many fewer samples."""
    if not one.q or dof <= one.q:
        return 0.0
    return float(log_p_of(one.F / max(inflation, 1.0), one.q, dof - one.q))


def canonical_correlation(one: np.ndarray, other: np.ndarray) -> float:
    """Largest canonical correlation of two groups of directions (n, q) off the geometry."""
    if not one.shape[1] or not other.shape[1]:
        return 0.0
    return float(np.linalg.norm(one.T @ other, 2))
