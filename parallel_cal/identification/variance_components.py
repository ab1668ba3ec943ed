"""Estimate noise that nobody stated from the residuals of a fit: variance components by REML.

The covariance of the rows is V = V_stated + sum_g f_g V_g over the kinds g of unknown noise. Fisher
scoring of the restricted likelihood gives the f_g: it accounts for the degrees of freedom that the
parameters take. Kinds that the data cannot separate keep the proportion of their guesses.

References
----------
Koch, K.-R. (1999). Parameter Estimation and Hypothesis Testing in Linear Models. Springer, 3.6.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from parallel_cal.identification.estimate import Estimate
from parallel_cal.identification.linearisation import Linearisation
from parallel_cal.identification.observations import ESTIMATED, Observations
from parallel_cal.identification.robust import reweight
from parallel_cal.identification.thresholds import (
    CONVERGED_NOISE_RATIO,
    ENOUGH_SAMPLES,
    MAX_NOISE_SHARE_SIGMA,
    MAX_SCORING_STEPS,
    MIN_NOISE_FACTOR,
    MIN_NOISE_SHARE,
    MIN_SIGMAS_PER_TOLERANCE,
    RELATIVE_RANK,
)
from parallel_cal.model.model import Model

Groups = list[list[int]]  # kinds of unknown noise (by index) whose proportion is kept


@dataclass(frozen=True)
class EstimatedNoise:
    """Observations with estimated noise.

    `factors` multiply the guessed standard deviations. `variance_error` are the relative standard
    errors of the variances; they are infinite where no degree of freedom was left, and the guess
    remained. `inseparable` lists the names of kinds that keep the proportion of their guesses.
    """

    observations: Observations
    factors: np.ndarray
    variance_error: np.ndarray
    inseparable: tuple[tuple[str, ...], ...]

    def differs_from(self, other: EstimatedNoise) -> bool:
        """Whether a standard deviation differs noticeably from another estimate."""
        change = np.abs(np.log(self.factors / other.factors)).max(initial=0.0)
        return bool(change > np.log(CONVERGED_NOISE_RATIO))


def estimate_noise(
    model: Model,
    observations: Observations,
    free: np.ndarray,
    found: Estimate | None = None,
    with_priors: bool = True,
    last: EstimatedNoise | None = None,
) -> EstimatedNoise:
    """Estimate the noise that is not stated from the residuals of a model.

    `observations` hold the guesses. `found` is the estimate of the parameters in the mask `free`;
    None: those of the model, of which none is free. `with_priors` says whether tolerances hold the
    directions that the data determine weakly: these take no degrees of freedom. `last` is an
    earlier estimate to start from.
    """
    names = [kind.name for kind in observations.unknown]
    if found is not None:
        observations_used = reweight(observations, found.weight)
        model = model.with_values(found.values)
    else:
        observations_used, free = observations, np.zeros_like(free)
    step = -(-len(observations) // ENOUGH_SAMPLES)
    few = np.arange(0, len(observations), step)
    rows = _Rows.of(model, observations_used.select(few), free, with_priors)
    seen = np.flatnonzero(rows.variances() > 0).tolist()
    groups: Groups = [[k] for k in seen]
    factors, error = np.ones(len(names)), np.full(len(names), np.inf)
    while groups:
        solution = rows.solve(groups, last)
        merged = _merge_inseparable(groups, solution.share_covariance)
        if merged == groups:
            if np.isfinite(solution.covariance).all():
                factors = solution.factors
                for group, one in zip(groups, np.sqrt(np.diag(solution.covariance)), strict=True):
                    error[group] = one
            break
        groups = merged
    scaled = observations.scale_unknown_noise(factors)
    kinds = zip(scaled.unknown, error.tolist(), strict=True)
    unknown = (replace(one, variance_error=e if np.isfinite(e) else None) for one, e in kinds)
    scaled = replace(scaled, unknown=tuple(unknown))
    return EstimatedNoise(
        replace(scaled, noise_from=_name_sources(scaled, len(model.joints))),
        factors,
        error,
        tuple(tuple(names[k] for k in group) for group in groups if len(group) > 1),
    )


def _name_sources(observations: Observations, n_joints: int) -> dict[str, str]:
    """Sources of the noise after its estimation."""
    sources, n = dict(observations.noise_from), n_joints
    for kind in (kind for kind in observations.unknown if kind.estimated):
        for key, used in (
            ("joint", kind.coordinates[:, :n]),
            ("pose", kind.coordinates[:, n : n + 6]),
            ("reading", kind.channels),
        ):
            if used.any():
                sources[key] = ESTIMATED
    return sources


def _merge_inseparable(groups: Groups, covariance: np.ndarray) -> Groups:
    """Merge the group whose share of the variance is known least with the one that it is
    confounded with most; the same groups if the data separate all."""
    if not np.isfinite(covariance).all():
        return [sorted(k for group in groups for k in group)]
    sigma = np.sqrt(np.diag(covariance))
    worst = int(np.argmax(sigma))
    if len(groups) < 2 or sigma[worst] <= MAX_NOISE_SHARE_SIGMA:
        return groups
    against = covariance[worst] / np.maximum(sigma, 1e-300)
    against[worst] = np.inf
    other = int(np.argmin(against))
    merged = sorted(groups[worst] + groups[other])
    return [*(g for k, g in enumerate(groups) if k not in (worst, other)), merged]


@dataclass(frozen=True)
class _Solution:
    """Factors of the standard deviations of all kinds, the relative covariance of the groups'
    variances, and their shares of the residual variance."""

    factors: np.ndarray
    covariance: np.ndarray
    share: np.ndarray

    @property
    def share_covariance(self) -> np.ndarray:
        return self.covariance * np.outer(self.share, self.share)


@dataclass(frozen=True)
class _Rows:
    """Rows linearised at the estimate: residuals phi (N, rows) at the measured quantities, and
    their derivatives by these (C) and by the free parameters in tolerances (J)."""

    model: Model
    observations: Observations
    free: np.ndarray
    phi: np.ndarray
    C: np.ndarray
    J: np.ndarray
    min_singular_value: float

    @classmethod
    def of(
        cls, model: Model, observations: Observations, free: np.ndarray, with_priors: bool
    ) -> _Rows:
        linearise = Linearisation(model, observations, free, weighted=True)
        x, stay = linearise.start(), np.zeros(int(free.sum()))
        x = linearise(np.array(model.values), x).adjusted(stay)
        phi, C, J = linearise.blocks(model.values, x)
        phi = phi + (C @ linearise.compute_adjustments(x)[:, :, None])[:, :, 0]
        J = J * model.table.prior_sigma[free]
        least = MIN_SIGMAS_PER_TOLERANCE if with_priors else 0.0
        return cls(model, observations, free, phi, C, J, least)

    def variances(self) -> np.ndarray:
        """Variance that each kind of unknown noise gives the rows, in their own units."""
        unweighted = np.broadcast_to(np.eye(self.phi.shape[1]), (*self.phi.shape, len(self.phi.T)))
        parts = self._parts(unweighted, self.observations)
        return np.array([np.trace(part, axis1=1, axis2=2).sum() for part in parts])

    def solve(self, groups: Groups, last: EstimatedNoise | None) -> _Solution:
        """Iterate the steps of Fisher scoring until they change nothing.

        Without an earlier estimate, every group begins with an equal part of the residuals: the
        guesses decide only about proportions within a group.
        """
        if last is None:
            own, whole = self.variances(), np.vdot(self.phi, self.phi) / len(groups)
            variance = np.array([whole / own[group].sum() for group in groups])
        else:
            variance = np.array([np.mean(last.factors[group] ** 2) for group in groups])
        variance = np.maximum(variance, MIN_NOISE_FACTOR**2)
        for _ in range(MAX_SCORING_STEPS):
            change, covariance, share = self._score(groups, self._factors(groups, variance))
            variance = np.maximum(variance * change, MIN_NOISE_FACTOR**2)
            if np.abs(np.log(np.maximum(change, MIN_NOISE_FACTOR))).max() < np.log(
                CONVERGED_NOISE_RATIO
            ):
                break
        return _Solution(self._factors(groups, variance), covariance, share)

    def _factors(self, groups: Groups, variance: np.ndarray) -> np.ndarray:
        factors = np.ones(len(self.observations.unknown))
        for group, f in zip(groups, variance, strict=True):
            factors[group] = np.sqrt(f)
        return factors

    def _score(
        self, groups: Groups, factors: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """One step of Fisher scoring: factors of the groups' variances, their relative covariance,
        and the shares of the groups."""
        from scipy.optimize import nnls

        seen = self.observations.scale_unknown_noise(factors)
        linearise = Linearisation(self.model, seen, self.free, True)
        T = linearise.whiten(self.C)
        parts = self._parts(T, seen)
        A = [sum((parts[k] for k in group[1:]), parts[group[0]]) for group in groups]
        whole = T @ linearise.covariance_of(self.C) @ T.transpose(0, 2, 1)
        A.append(whole - sum(A[1:], A[0]))  # what is stated
        white = (T @ self.phi[:, :, None]).reshape(-1)
        Z = self._basis(T)
        columns = Z.reshape(len(white), -1)
        residual = (white - columns @ (columns.T @ white)).reshape(*self.phi.shape, 1)
        AZ = [a @ Z for a in A]
        M = [columns.T @ az.reshape(columns.shape) for az in AZ]
        Q = np.zeros((len(A), len(A)))
        for g in range(len(A)):
            for h in range(g + 1):
                Q[g, h] = np.vdot(A[g], A[h]) - 2 * np.vdot(AZ[g], AZ[h]) + np.vdot(M[g], M[h])
                Q[h, g] = Q[g, h]
        q = np.array([np.vdot(residual, a @ residual) for a in A[:-1]])
        traces = [
            np.trace(a, axis1=1, axis2=2).sum() - np.trace(m) for a, m in zip(A, M, strict=True)
        ]
        trace = np.array(traces)
        n, dof = len(groups), float(trace.sum())
        own = Q[:n, :n]
        if round(dof) < n:  # too few to estimate as many variances
            return np.ones(n), np.full((n, n), np.inf), np.ones(n)
        change = nnls(own, q - Q[:n, n])[0]
        total = float(change @ trace[:n] + trace[n])
        least = MIN_NOISE_SHARE * total / np.maximum(trace[:n], 1e-300)
        inverse = np.linalg.pinv(own, rcond=1e-12, hermitian=True)
        return np.maximum(change, least), 2 * inverse, trace[:n] / dof

    def _basis(self, T: np.ndarray) -> np.ndarray:
        """Orthonormal columns (N, rows, k) of what the free parameters can explain."""
        if not self.J.shape[2]:
            return self.J
        A = (T @ self.J).reshape(-1, self.J.shape[2])
        _, sizes, directions = np.linalg.svd(np.linalg.qr(A, mode="r"))
        rank = min(A.shape)
        used = sizes[:rank] > max(RELATIVE_RANK * sizes[0], self.min_singular_value)
        Z = A @ (directions[:rank][used].T / sizes[:rank][used])
        return np.asarray(Z.reshape(*self.phi.shape, -1))

    def _parts(self, T: np.ndarray, seen: Observations) -> list[np.ndarray]:
        """Covariance (N, rows, rows) of rows, multiplied by T, from each kind of unknown noise."""
        variance = np.diagonal(seen.S, axis1=1, axis2=2)
        reading = seen.get_reading_sigma(self.model) ** 2
        by_measured, by_reading = T @ self.C, T[:, :, T.shape[2] - reading.shape[1] :]
        return [
            (by_measured * np.where(kind.coordinates, variance, 0.0)[:, None, :])
            @ by_measured.transpose(0, 2, 1)
            + (by_reading * np.where(kind.channels, reading, 0.0)[:, None, :])
            @ by_reading.transpose(0, 2, 1)
            for kind in seen.unknown
        ]
