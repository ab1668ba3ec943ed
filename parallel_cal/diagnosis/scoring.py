"""Score how much of the residual an effect would remove, before anything is refitted."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from parallel_cal.diagnosis.scene import Scene
from parallel_cal.diagnosis.thresholds import MIN_COLUMN_REMAINDER, RESAMPLES


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
    visible = squares[::-1] > MIN_COLUMN_REMAINDER**2
    U = (left @ directions)[:, ::-1][:, visible] / np.sqrt(squares[::-1][visible])
    remaining = float(np.sqrt(np.mean(np.sum(projected**2, axis=0))))
    size = float(np.sqrt(np.mean(np.sum((projected * lengths) ** 2, axis=0))))
    F, log_p = f_test(scene.residual, U, scene.dof)
    return Score(F, log_p, U.shape[1], remaining, size, U)


def quick_log_p(scene: Scene, B: np.ndarray) -> float:
    """`score(scene, B).log_p` from the columns' Gram matrix alone, for scans: a third of the work,
    equal to rounding."""
    gram, along, onto = B.T @ B, scene.basis.T @ B, B.T @ scene.residual
    lengths = np.sqrt(gram.diagonal())
    seen = lengths > 1e-9
    left = (gram - along.T @ along)[np.ix_(seen, seen)] / np.outer(lengths[seen], lengths[seen])
    squares, directions = np.linalg.eigh(left)
    visible = squares > MIN_COLUMN_REMAINDER**2
    g = (directions[:, visible].T @ (onto[seen] / lengths[seen])) / np.sqrt(squares[visible])
    return _f_of(float(g @ g), scene.residual, len(g), scene.dof)[1]


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


def resample_log_p(
    scene: Scene, groups: list[np.ndarray], resamples: int = RESAMPLES, seed: int = 0
) -> np.ndarray:
    """log p (resamples, k) of each group of directions when poses are drawn with replacement.

    Poses, not rows: visits of one pose stay together. Everything is expressed in the full
    data's bases first, so that a resample costs sums of small Gram matrices. Scenes of the same
    poses with the same seed draw the same poses.
    """
    Z = np.column_stack([scene.basis, *groups, scene.residual])
    blocks = Z.reshape(-1, scene.rows, Z.shape[1])
    names = np.unique(scene.group)
    gram = []
    for name in names:
        rows = blocks[scene.group == name].reshape(-1, Z.shape[1])
        gram.append(rows.T @ rows)
    p, ends = scene.basis.shape[1], np.cumsum([scene.basis.shape[1], *[g.shape[1] for g in groups]])
    picks = np.random.default_rng(seed).integers(len(names), size=(resamples, len(names)))
    count = np.array([np.bincount(row, minlength=len(names)) for row in picks], dtype=float)
    return _log_ps(np.tensordot(count, np.array(gram), axes=1), p, ends, scene.dof)


def _log_ps(G: np.ndarray, p: int, ends: np.ndarray, dof: int) -> np.ndarray:
    """log p (resamples, k) of every group from Gram matrices of [basis, groups, residual]."""
    # Directions that a resample does not see are held by a grain of the identity.
    grain = 1e-9 * np.maximum(np.trace(G[:, :p, :p], axis1=1, axis2=2) / max(p, 1), 1e-12)
    A = G[:, :p, :p] + grain[:, None, None] * np.eye(p)
    left = G[:, p:, p:] - G[:, p:, :p] @ np.linalg.solve(A, G[:, :p, p:])
    rr, logs = left[:, -1, -1], np.zeros((len(G), len(ends) - 1))
    for column, begin, end in zip(logs.T, ends[:-1] - p, ends[1:] - p, strict=True):
        q = end - begin
        if not q or dof <= q:
            continue
        M, g = left[:, begin:end, begin:end], left[:, begin:end, -1:]
        taken = (g.transpose(0, 2, 1) @ np.linalg.pinv(M, rcond=1e-6, hermitian=True) @ g)[:, 0, 0]
        F = taken / q / np.maximum((rr - taken) / (dof - q), 1e-300)
        column[:] = log_p_of(np.maximum(F, 0.0), q, dof - q)
    return logs
