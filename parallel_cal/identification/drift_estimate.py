"""Estimate how fast robots drift, from what each of their sessions tells about the parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.identification.drift_rate import GROWTHS, PARTS, SCALES, DriftRate
from parallel_cal.identification.evidence import Evidence
from parallel_cal.identification.fit import fit
from parallel_cal.identification.update import list_drift_parts, list_robot_parameters
from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset

CENTRE_SIGMA = 10.0  # tolerances: of the mean of the sessions about the model, wide on purpose
# The weights of a robot of which nothing is known.
EVEN = np.full((len(PARTS), len(GROWTHS), len(SCALES)), 1.0 / (len(GROWTHS) * len(SCALES)))
SWEEPS = 3  # over the parts, until the most probable law of each no longer changes
SMALLEST = (1, 0)  # growth and scale at which a sweep starts
FLEET_STEPS = 200  # of the iteration for the weights of a fleet
RELATIVE_INFORMATION = 1e-12  # of the largest: below it, nothing was seen
JITTER = 1e-9  # tolerances^2: keeps the covariance of sessions at one time regular


@dataclass(frozen=True)
class Session:
    """What one recording at a `time` (s since 1970) tells about the parameters of a robot."""

    time: float
    evidence: Evidence

    @classmethod
    def of(cls, model: Model, dataset: Dataset, time: float) -> Session:
        """Take the evidence of a recording. The tolerances let few poses determine a fit, and do
        not count as evidence."""
        found = fit(model, dataset, hold_out=0.0, prior=True)
        return cls(time, Evidence.of(found))


def estimate_drift(
    sessions: Sequence[Session], model: Model, prior: DriftRate | None = None
) -> DriftRate:
    """Estimate how fast a robot drifts.

    Parameters
    ----------
    sessions : sequence of Session
        At least two, at different times; with a `prior`, one or none is enough.
    model : Model
        The calibrated robot.
    prior : DriftRate, optional
        That of a fleet of such robots. Default: every growth and scale is equally probable.

    Returns
    -------
    DriftRate

    Raises
    ------
    FitError
        If there is no second session and no prior.
    """
    times = [one.time for one in sessions]
    if prior is None and (len(sessions) < 2 or not np.ptp(times)):
        raise FitError(
            f"{len(sessions)} sessions at {len(set(times))} times show no drift: give the "
            "recordings of at least two, or the folder of a fleet"
        )
    span = float(np.ptp(times)) if prior is None else prior.span
    weights = EVEN if prior is None else prior.weights
    if len(sessions) > 1:
        weights = normalise(weights * weigh_laws(sessions, model, span, weights))
    robots = 1 if prior is None else prior.robots + (len(sessions) > 1)
    count = len(sessions) + (0 if prior is None else prior.sessions)
    return DriftRate(weights, span, count, robots)


def pool_drifts(robots: Sequence[Sequence[Session]], model: Model) -> DriftRate | None:
    """Estimate the drift of a robot of a fleet, from robots with at least two sessions; None if
    there are none.

    Robots differ: each has growths and scales of its own. Their distribution is the most likely one
    with one robot's weight (a Dirichlet prior) spread evenly, so that few robots leave every drift
    possible.
    """
    known = [one for one in robots if len(one) > 1 and np.ptp([s.time for s in one])]
    if not known:
        return None
    span = max(float(np.ptp([s.time for s in one])) for one in known)
    likelihood = np.array([weigh_laws(one, model, span, EVEN) for one in known])
    weights = EVEN
    for _ in range(FLEET_STEPS):
        each = normalise(weights * likelihood)
        weights = (each.sum(axis=0) + EVEN) / (len(known) + 1)
    return DriftRate(weights, span, sum(len(one) for one in known), len(known))


def normalise(weights: np.ndarray) -> np.ndarray:
    """Scale weights (..., 3, 13) to a sum of 1."""
    return np.asarray(weights / weights.sum(axis=(-2, -1), keepdims=True))


def weigh_laws(
    sessions: Sequence[Session], model: Model, span: float, prior: np.ndarray
) -> np.ndarray:
    """Return the marginal likelihood (4, 3, 13) of each growth and scale of each part, up to a
    factor, with the others at their most probable ones; `prior` has this shape.

    With d the changes of all sessions, log L(d) = g.d - d.A.d / 2, and d ~ N(0, C), it is the
    exponential of (g.S.g - log det(1 + B^T A B)) / 2, C = B B^T and S = B (1 + B^T A B)^-1 B^T.
    """
    own = np.flatnonzero(list_robot_parameters(model))
    names = tuple(model.table.names[i] for i in own)
    tolerance = model.table.tolerance[own]
    told = [s.evidence.recentre(names, model.values[own], tolerance) for s in sessions]
    # Directions that no session shows have no weight in any law.
    size, seen = np.linalg.eigh(sum(one.information for one in told))
    seen = seen[:, size > RELATIVE_INFORMATION * size[-1]]
    rows = [one[:, own] / tolerance @ seen for one in list_drift_parts(model).values()]
    count, n = len(sessions), seen.shape[1]
    blocks = np.zeros((count, n, count, n))
    for k, one in enumerate(told):
        blocks[k, :, k] = seen.T @ one.information @ seen
    A = blocks.reshape(count * n, count * n)
    g = np.concatenate([seen.T @ one.pull for one in told])
    t = np.array([s.time for s in sessions])
    patterns = [_covariance_in_time((t - t.min()) / span, growth) for growth in GROWTHS]
    parts = [[np.kron(pattern, one.T @ one) for pattern in patterns] for one in rows]
    still = np.kron(np.ones((count, count)), CENTRE_SIGMA**2 * np.eye(n)) + JITTER * np.eye(len(g))

    def weigh(C: np.ndarray) -> float:
        B = np.linalg.cholesky(C)
        M = np.linalg.cholesky(np.eye(len(g)) + B.T @ A @ B)
        explained = np.linalg.solve(M, B.T @ g)
        return float(explained @ explained / 2 - np.log(np.diag(M)).sum())

    best = [SMALLEST] * len(PARTS)
    log = np.zeros(prior.shape)
    for _ in range(SWEEPS):
        for k in range(len(PARTS)):
            rest = still + sum(
                SCALES[j] ** 2 * parts[m][i] for m, (i, j) in enumerate(best) if m != k
            )
            for i in range(len(GROWTHS)):
                log[k, i] = [weigh(rest + scale**2 * parts[k][i]) for scale in SCALES]
            likely = log[k] + np.log(np.maximum(prior[k], 1e-300))
            best[k] = divmod(int(np.argmax(likely)), len(SCALES))
    return np.exp(log - log.max(axis=(1, 2), keepdims=True))


def _covariance_in_time(t: np.ndarray, growth: float) -> np.ndarray:
    """The covariance (N, N) of sessions at the times t, in squares of the drift after t = 1."""
    if growth == 0:  # each end of a difference has half of its variance
        return np.eye(len(t)) / 2
    return np.minimum.outer(t, t) if growth < 1 else np.outer(t, t)
