"""What samples let expect of a robot that may have drifted: its parameters, and further samples.

Each hypothesis of `drift_test` has a posterior N(m, C) of the parameters' change d; its probability
is w. At samples like those of the calibration, of information T each, a model that is changed by u
has the squared error (d - u)' T (d - u). It is larger than that of the last model, d' T d, where
u' T d < u' T u / 2. So an update by u makes the robot worse with the probability

    sum w Phi((u' T u / 2 - u' T m) / sqrt(u' T C T u)),

in which a displaced device counts as a hypothesis in which the robot is as it was.

Whether more samples would tell a drift of the robot from a displaced device is simulated: the
parameters are drawn from these posteriors, the information and the pull of more samples like these
follow, and the same test decides.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import chain

import numpy as np

from parallel_cal.identification.drift_test import DriftTest, Look, probabilities
from parallel_cal.model.model import Model

DRAWS = 100  # changes that the samples allow
REPEATS = 1.25 ** np.arange(1, 22)  # times as many samples, to a hundred times


@dataclass(frozen=True)
class Hypotheses:
    """What the samples let expect by each hypothesis: those of a test with their probabilities, the
    information A (n, n) and the pull b (n,) of all samples. The first columns are the parameters of
    the model that are `free`, in their `tolerance`."""

    test: DriftTest
    look: Look
    A: np.ndarray
    b: np.ndarray
    free: np.ndarray
    tolerance: np.ndarray

    def __iter__(self) -> Iterator[tuple[float, np.ndarray, np.ndarray]]:
        """Iterate over the probabilities, the means (n,) and the covariances (n, n) by each."""
        cases = self.test.list_cases(self.look)
        drifts = ((one.probability, one.columns @ one.columns.T) for one in cases)
        none = (self.look.unchanged, np.zeros_like(self.A))
        for probability, drift in chain([none], drifts):
            C = _narrow(self.test.C0 + drift, self.A)
            yield probability, C @ self.b, C


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
    kept : float
        The rms error of the last calibration's model today, in the same units.
    more_samples : int, optional
        How many further samples like these would tell a drift of the robot from a displacement of
        the device, in half of the cases; None if these do, or if a hundred times as many would
        not.
    hypotheses : Hypotheses
    """

    covariance: np.ndarray = field(repr=False)
    growth: float
    kept: float
    more_samples: int | None
    hypotheses: Hypotheses = field(repr=False)

    def predict_harm(self, change: np.ndarray) -> float:
        """Predict the probability that the last model with its parameters changed by
        (n_parameters,), SI, has a larger error today than without, at samples like those of the
        calibration. Those of a device that a fit placed may follow."""
        known = self.hypotheses
        u = change[: len(known.free)][known.free] / known.tolerance
        n, harm = len(u), 0.0
        along = known.test.typical[:n, :n] @ u
        for probability, mean, covariance in known:
            sigma = math.sqrt(max(along @ covariance[:n, :n] @ along, 1e-300))
            away = (along @ u / 2 - along @ mean[:n]) / sigma
            harm += probability * math.erfc(-away / 2**0.5) / 2
        return harm


def expect_drift(
    model: Model, test: DriftTest, look: Look, A: np.ndarray, b: np.ndarray, certainty: float
) -> ExpectedDrift:
    """Expect what follows from the probabilities after all samples, with their information A (n, n)
    and pull b (n,)."""
    free = ~np.asarray(model.fixed)
    n = int(free.sum())
    own = np.array([one.is_of_robot for one in test.changes])
    robot = max(float(look.by_change[own].sum()), 1e-300)
    # If only the device had moved, a fit of the robot would not tell; so it is taken to stand.
    scaled = np.zeros_like(test.C0)
    for one in test.list_cases(look):
        if own[one.change]:
            share = one.probability / (robot + look.unchanged)
            scaled += share * one.columns @ one.columns.T
    typical = test.typical[:n, :n]
    unit = float(np.vdot(typical, test.C0[:n, :n]))
    today = _narrow(test.C0 + scaled, A)[:n, :n]
    tolerance = model.table.tolerance[free]
    hypotheses = Hypotheses(test, look, A, b, free, tolerance)
    squares = sum(p * (C + np.outer(m, m))[:n, :n] for p, m, C in hypotheses)
    drift = np.zeros((len(model.table), len(model.table)))
    drift[np.ix_(free, free)] = scaled[:n, :n] * np.outer(tolerance, tolerance)
    kept = float(np.sqrt(np.vdot(typical, squares) / unit))
    growth = float(np.sqrt(np.vdot(typical, today) / unit))
    displaced = float(look.by_change[[bool(one.device) for one in test.changes]].sum())
    more = None
    if max(robot, displaced) < certainty <= 1 - look.unchanged:
        more = _count_telling(test, look, A, b, certainty)
    return ExpectedDrift(drift, growth, kept, more, hypotheses)


def _count_telling(
    test: DriftTest, look: Look, A: np.ndarray, b: np.ndarray, certainty: float
) -> int | None:
    """Count the further samples like these after which it is decided whether the robot drifted or
    the device moved, in half of the changes that the samples allow."""
    rng, n = np.random.default_rng(0), len(b)
    own = np.array([one.is_of_robot for one in test.changes])
    moved = np.array([bool(one.device) for one in test.changes])
    cases = list(test.list_cases(look))
    weights = np.array([one.probability for one in cases])
    drawn = np.empty((n, DRAWS))
    for k, case in enumerate(rng.choice(len(cases), DRAWS, p=weights / weights.sum()).tolist()):
        C = _narrow(test.C0 + cases[case].columns @ cases[case].columns.T, A)
        drawn[:, k] = C @ b + _root(C) @ rng.standard_normal(n)
    noise = _root(A) @ rng.standard_normal((n, DRAWS))
    for times in REPEATS.tolist():
        new = (times - 1) * (A @ drawn) + (times - 1) ** 0.5 * noise
        known = test.variance * np.column_stack([times * A, b[:, None] + new])
        logs, _ = test.log_factors(known[:, :n], known[:, n:])
        _, changed = probabilities(logs + test.log_prior)
        told = [changed[:, part].sum(axis=(1, 2, 3)) >= certainty for part in (own, moved)]
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
