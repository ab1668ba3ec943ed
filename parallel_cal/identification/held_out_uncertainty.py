"""Standard deviation of the rms error at held-out poses.

The rms at N held-out samples estimates the rms error that this calibration has at further poses
like the measured ones. It differs from it for three reasons, and only the first shows in the
scatter of the errors between poses:

1. The poses are few, and so are the errors at them.
2. All errors of one fold share its parameters, and the parameters of two folds come from partly
   the same samples.
3. The parameters of this calibration have an error of their own, which decides the rms at further
   poses.

Let P be the covariance of the parameters, F_a the information of the samples of fold a, S_i the
covariance of the noise in the error at sample i, and J_i the derivative of its prediction by the
parameters. The fold's parameters have the covariance P_a = (P^-1 - F_a)^-1 = U_a P with
U_a = (1 - P F_a)^-1. In the linear model, the errors e_i have the covariances

    cov(e_i, e_j) = d_ij S_i + J_i P_a J_j^T         i and j in fold a
    cov(e_i, e_j) = -J_i U_a P U_b^T J_j^T           i in fold a, j in fold b
    cov(e_i, p)   = 0                                for the parameters p of all samples

where d_ij is 1 for i = j, else 0. The last line holds because an efficient estimate is uncorrelated
with everything whose mean does not depend on the parameters. With C, the matrix of the first two,
and G = sum J_i^T J_i,

    N^2 var(mean square - true mean square) = 2 tr(C^2) + 2 tr((P G)^2).

The part of tr(C^2) within the poses is what scatter between poses shows. It is the larger of that
seen and that of a complete model, because no model has errors that scatter less than its noise.

References
----------
Searle, Linear Models, 1971, section 2.5 (the variance of a quadratic form); Bengio and Grandvalet,
No unbiased estimator of the variance of k-fold cross-validation, JMLR 5, 2004; Bates, Hastie and
Tibshirani, Cross-validation: what does it estimate and how well does it do it?, JASA 119, 2024.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from parallel_cal.identification.error_jacobians import ErrorJacobian, differentiate_errors
from parallel_cal.identification.estimate import Estimate
from parallel_cal.identification.image_poses import find_shown_poses
from parallel_cal.identification.linearisation import Linearisation, Streamed
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.prediction_errors import Errors, compute_mean_and_sigma
from parallel_cal.identification.robust import reweight
from parallel_cal.model.model import Model

MAX_SHARE = 1 - 1e-9  # of the information about a combination that one fold may hold


@dataclass(frozen=True)
class FoldedErrors:
    """Errors at held-out samples in the linear model.

    `S` (N, k, k) is the covariance of their noise, `J` (N, k, n_free) the derivative of the
    predictions by the parameters, `fold` and `group` (N,) the numbers of fold and pose. P (n_free,
    n_free) is the covariance of the parameters, `information` (n_folds, n_free, n_free) what each
    fold knows about them.
    """

    S: np.ndarray
    J: np.ndarray
    fold: np.ndarray
    group: np.ndarray
    P: np.ndarray
    information: np.ndarray

    def compute_variance(self, squares: np.ndarray) -> float | None:
        """Variance of the mean of the squared errors (N,) about the true mean square error at poses
        like these; None if the other folds do not determine a fold's parameters."""
        n_free = len(self.P)
        shares = self.P @ self.information
        if np.max(np.linalg.eigvals(shares).real, initial=0.0) > MAX_SHARE:
            return None
        U = np.linalg.inv(np.eye(n_free) - shares)

        P_a = U @ self.P
        JP = np.empty_like(self.J)  # J_i P_a of the sample's fold a
        G = np.zeros_like(U)
        for a in range(len(U)):
            own_J = self.J[self.fold == a]
            JP[self.fold == a] = own_J @ P_a[a]
            G[a] = np.tensordot(own_J, own_J, ((0, 1), (0, 1)))
        pairs = np.column_stack([self.fold, self.group])
        _, at, counts = np.unique(pairs, axis=0, return_inverse=True, return_counts=True)
        at = at.reshape(-1)

        C = JP @ self.J.transpose(0, 2, 1)  # J_i P_a J_i^T
        expected = np.trace(self.S + C, axis1=1, axis2=2)
        mean = float(expected.mean())
        own = np.sum(self.S * (self.S + 2 * C), axis=(1, 2))
        in_cells = self._sum_squares_of_cells(at, counts, JP)
        uneven = np.bincount(at, expected) - counts * mean
        within = 2 * (own.sum() + in_cells) + np.sum(uneven**2)

        in_folds = _trace_of_square(P_a @ G).sum() - in_cells
        # tr(U_a P U_b^T G_b U_b P U_a^T G_a) = tr(P H_b P H_a), summed over all a and b but a = b
        H = U.transpose(0, 2, 1) @ G @ U
        between = _trace_of_square(self.P @ H.sum(axis=0)) - _trace_of_square(self.P @ H).sum()
        shared = 2 * (in_folds + between + _trace_of_square(self.P @ G.sum(axis=0)))

        found, scatter = compute_mean_and_sigma(squares, self.group)
        ratio = found / mean if mean > 0 else 1.0
        within = max(min(ratio, 1.0) ** 2 * within / len(squares) ** 2, np.nan_to_num(scatter**2))
        return float(within + ratio**2 * max(shared, 0.0) / len(squares) ** 2)

    def _sum_squares_of_cells(self, at: np.ndarray, counts: np.ndarray, JP: np.ndarray) -> float:
        """Sum of the squares |J_i P_a J_j^T|^2 of all samples i and j of one cell, over all cells.

        `at` (N,) is the cell of a sample, `counts` the number of samples of each cell. The smaller
        of two products is made: that of the samples, or tr((P_a G)^2) with G = sum J_i^T J_i.
        """
        total, order = 0.0, np.argsort(at, kind="stable")
        starts = np.cumsum(counts) - counts
        for count in np.unique(counts):
            own = order[starts[counts == count][:, None] + np.arange(count)]  # cells x samples
            left, right = (one[own].reshape(len(own), -1, len(self.P)) for one in (JP, self.J))
            if left.shape[1] <= len(self.P):
                total += float(np.sum((left @ right.transpose(0, 2, 1)) ** 2))
            else:
                total += float(_trace_of_square(left.transpose(0, 2, 1) @ right).sum())
        return total


def compute_held_out_sigmas(
    model: Model,
    estimate: Estimate,
    free: np.ndarray,
    observations: Observations,
    held_out: Errors,
    folds: Sequence[tuple[np.ndarray, np.ndarray]],
    groups: np.ndarray,
) -> dict[str, float]:
    """Standard deviation of the rms error at held-out poses, by kind, about the rms error of this
    calibration at poses like these; without the kinds for which it is not known.

    `folds` are the indices of training and held-out samples, `groups` (N,) the poses. With so many
    samples that their Jacobian does not fit the memory, the parameters have no error that counts.
    """
    linearise = Linearisation(model, reweight(observations, estimate.weight), free, weighted=True)
    start = linearise.start()
    system = linearise(model.values, start)
    if isinstance(system, Streamed):
        return {}
    x = system.adjusted(np.zeros(int(free.sum())))
    A = linearise(model.values, x).jacobian
    fold = np.full(len(observations), -1)
    for k, (_, test) in enumerate(folds):
        fold[test] = k
    information = np.stack([np.tensordot(A[test], A[test], ((0, 1), (0, 1))) for _, test in folds])
    shown = find_shown_poses(model, observations, start)
    S = observations.S
    if shown:
        S, pose = S.copy(), slice(len(model.joints), len(model.joints) + 6)
        S[shown.known, pose] = S[shown.known, :, pose] = 0.0
        S[shown.known, pose, pose] = shown.covariance[shown.known]
    _, rows, by_free = linearise.blocks(model.values, x)
    jacobians = differentiate_errors(model, observations, rows, by_free, shown)
    # Parameters in tolerances: metres and radians in one matrix.
    scale = model.table.tolerance[free]
    P = estimate.spectrum.covariance / np.outer(scale, scale)
    information = information * np.outer(scale, scale)
    sigmas = {}
    for kind, one in jacobians.items():
        norms = held_out.norms(kind)
        known = np.isfinite(norms) & one.known.any(axis=1) & (fold >= 0)
        if not known.any():
            continue
        size = _compute_size(kind, one)[:, None, None]
        folded = FoldedErrors(
            (size**2 * one.compute_covariance(S))[known],
            (size * one.by_parameter * scale)[known],
            fold[known],
            groups[known],
            P,
            information,
        )
        variance, rms = folded.compute_variance(norms[known] ** 2), held_out.summary.rms(kind)
        if variance is not None and rms and math.isfinite(variance):
            sigmas[kind] = math.sqrt(variance) / (2 * rms)
    return sigmas


def _compute_size(kind: str, one: ErrorJacobian) -> np.ndarray:
    """Factor (N,) of the norm in `Errors.norms`: that of pixels is of one corner."""
    if kind != "pixel":
        return np.ones(len(one.known))
    return np.asarray(1 / np.sqrt(np.maximum(one.known.sum(axis=1), 2) / 2))


def _trace_of_square(M: np.ndarray) -> np.ndarray:
    return np.einsum("...ij,...ji->...", M, M)
