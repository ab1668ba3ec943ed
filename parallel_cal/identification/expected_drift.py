"""What samples let expect of a robot that may have drifted: its parameters, and further samples.

Each hypothesis of `drift_test` has a posterior N(m, C) of the parameters; its probability is w. The
squared error that a model with the parameters p makes at samples like those of the calibration, of
information T each, is expected to be

    sum w [tr(T C) + (m - p)' T (m - p)] = const + (m_all - p)' T (m_all - p),

with the mean m_all of all m. So an update to p is better than the old parameters where p is nearer
to m_all; a displaced device counts as a hypothesis in which the robot is as it was.

Whether more samples would tell a drift of the robot from a displaced device is simulated: the
parameters are drawn from these posteriors, the information and the pull of more samples like these
follow, and the same test decides.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from parallel_cal.identification.drift_test import SCALES, DriftTest, Look, probabilities
from parallel_cal.model.model import Model

DRAWS = 100  # changes that the samples allow
MIN_WEIGHT = 1e-9  # of a hypothesis that counts
REPEATS = 1.25 ** np.arange(1, 22)  # times as many samples, to a hundred times


@dataclass(frozen=True)
class ExpectedDrift:
    """What the samples of today let expect.

    Attributes
    ----------
    covariance : array (n_parameters, n_parameters)
        Of the drift, SI: the mean over the changes of the robot.
    growth : float
        The rms error that the uncertainty of an updated model would cause at samples like those of
        the calibration, in units of that of the last calibration. That only the device moved is
        left aside.
    mean : array (n_parameters,)
        The change of the parameters, SI; the device may have moved.
    metric : array (n_parameters, n_parameters)
        Squares, in the same units, of the error that a change of the parameters causes.
    kept : float
        The rms error of the last calibration's model today, in the same units.
    more_samples : int, optional
        How many further samples like these would tell a drift of the robot from a displacement of
        the device, in half of the cases; None if these do, or if a hundred times as many would
        not.
    """

    covariance: np.ndarray = field(repr=False)
    growth: float
    mean: np.ndarray = field(repr=False)
    metric: np.ndarray = field(repr=False)
    kept: float
    more_samples: int | None

    def predict_error(self, change: np.ndarray) -> float:
        """Predict the rms error of the last model with its parameters changed by (n_parameters,),
        SI, at samples like those of the calibration, in units of its uncertainty then."""
        along = self.metric @ change
        return float(np.sqrt(max(self.kept**2 + along @ (change - 2 * self.mean), 0.0)))


def expect_drift(
    model: Model, test: DriftTest, look: Look, A: np.ndarray, b: np.ndarray, certainty: float
) -> ExpectedDrift:
    """Expect what follows from the probabilities after all samples, with their information A (n, n)
    and pull b (n,)."""
    free = ~np.asarray(model.fixed)
    n = int(free.sum())
    own = np.array([one.is_of_robot for one in test.changes])
    share = np.where(own[:, None], look.changed, 0.0)
    robot = max(float(share.sum()), 1e-300)
    # If only the device had moved, a fit of the robot would not tell; so it is taken to stand.
    weights = (share / (robot + look.unchanged)) @ SCALES**2
    pairs = zip(test.changes, weights, strict=True)
    scaled = np.asarray(sum(w * one.factor @ one.factor.T for one, w in pairs))
    typical = test.typical[:n, :n]
    unit = float(np.vdot(typical, test.C0[:n, :n]))
    today = _narrow(test.C0 + scaled, A)[:n, :n]
    mean, squares = _average(test, look, A, b)
    tolerance = model.table.tolerance[free]
    drift, metric = np.zeros((2, len(model.table), len(model.table)))
    drift[np.ix_(free, free)] = scaled[:n, :n] * np.outer(tolerance, tolerance)
    metric[np.ix_(free, free)] = typical / np.outer(tolerance, tolerance) / unit
    change = np.zeros(len(model.table))
    change[free] = tolerance * mean[:n]
    kept = float(np.sqrt(np.vdot(typical, squares[:n, :n]) / unit))
    growth = float(np.sqrt(np.vdot(typical, today) / unit))
    displaced = float(look.changed[~own].sum())
    more = None
    if max(robot, displaced) < certainty <= robot + displaced:
        more = _count_telling(test, look, A, b, certainty)
    return ExpectedDrift(drift, growth, change, metric, kept, more)


def _average(
    test: DriftTest, look: Look, A: np.ndarray, b: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The mean (n,) and the second moment (n, n) of the parameters over all hypotheses."""
    n = len(b)
    mean, squares = np.zeros(n), np.zeros((n, n))
    cases = [(look.unchanged, test.C0)]
    for one, row in zip(test.changes, look.changed, strict=True):
        spread = one.factor @ one.factor.T
        cases += [(w, test.C0 + s**2 * spread) for w, s in zip(row.tolist(), SCALES, strict=True)]
    for weight, prior in cases:
        if weight < MIN_WEIGHT:
            continue
        C = _narrow(prior, A)
        m = C @ b
        mean += weight * m
        squares += weight * (C + np.outer(m, m))
    return mean, squares


def _count_telling(
    test: DriftTest, look: Look, A: np.ndarray, b: np.ndarray, certainty: float
) -> int | None:
    """Count the further samples like these after which it is decided whether the robot drifted or
    the device moved, in half of the changes that the samples allow."""
    rng, n = np.random.default_rng(0), len(b)
    own = np.array([one.is_of_robot for one in test.changes])
    weights = look.changed.ravel() / look.changed.sum()
    drawn = np.empty((n, DRAWS))
    for k, case in enumerate(rng.choice(len(weights), DRAWS, p=weights).tolist()):
        h, s = divmod(case, len(SCALES))
        prior = test.C0 + SCALES[s] ** 2 * test.changes[h].factor @ test.changes[h].factor.T
        C = _narrow(prior, A)
        drawn[:, k] = C @ b + _root(C) @ rng.standard_normal(n)
    noise = _root(A) @ rng.standard_normal((n, DRAWS))
    for times in REPEATS.tolist():
        new = (times - 1) * (A @ drawn) + (times - 1) ** 0.5 * noise
        known = test.variance * np.column_stack([times * A, b[:, None] + new])
        logs, _ = test.log_factors(known[:, :n], known[:, n:])
        _, changed = probabilities(logs + test.log_prior)
        told = [changed[:, part].sum(axis=(1, 2)) >= certainty for part in (own, ~own)]
        if np.mean(np.any(told, axis=0)) >= 0.5:
            return math.ceil((times - 1) * look.samples)
    return None


def _narrow(prior: np.ndarray, A: np.ndarray) -> np.ndarray:
    """The covariance (n, n) of parameters with a prior one, after samples with information A."""
    return np.asarray(np.linalg.solve(np.eye(len(prior)) + prior @ A, prior))


def _root(C: np.ndarray) -> np.ndarray:
    """A root of a covariance (n, n), which may be singular."""
    squares, axes = np.linalg.eigh((C + C.T) / 2)
    return np.asarray(axes * np.sqrt(np.maximum(squares, 0.0)))
