"""What samples let expect of a robot that may have drifted: its parameters, and further samples.

Each hypothesis of `drift_test` has a posterior N(m, C) of the parameters; its probability is w. The
squared error that a model with the parameters p makes at samples like those of the calibration, of
information T each, is expected to be

    sum w [tr(T C) + (m - p)' T (m - p)] = const + (m_all - p)' T (m_all - p),

with the mean m_all of all m. So an update to p is better than the old parameters where p is nearer
to m_all; a displaced device counts as a hypothesis in which the robot is as it was.

A drift d of the robot differs from every displacement of the device by q = d' P d squared sigmas; P
is the information about changes, beside the device and the error of the calibration. More samples
like these raise q, up to a limit that the calibration sets; each raises the log odds of the two
hypotheses by half of what it adds to q.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from parallel_cal.identification.drift_test import (
    DEVICE,
    SCALES,
    DriftTest,
    Look,
    integrate_out,
)
from parallel_cal.model.model import Model

DRAWS = 200  # drifts of the robot that the samples allow
MIN_WEIGHT = 1e-9  # of a hypothesis that counts
REPEATS = 1.1 ** np.arange(49)  # times as many samples, to a hundred times


@dataclass(frozen=True)
class ExpectedDrift:
    """What the samples of today let expect.

    Attributes
    ----------
    covariance : array (n_parameters, n_parameters)
        Of the drift, SI: the mean over the changes of the robot.
    growth : float
        The rms error that the uncertainty of an updated model would cause at samples like those of
        the calibration, in units of that of the last calibration. The device is taken to stand.
    mean : array (n_parameters,)
        The change of the parameters, SI; the device may have moved.
    metric : array (n_parameters, n_parameters)
        Squares, in the same units, of the error that a change of the parameters causes.
    kept : float
        The rms error of the last calibration's model today, in the same units.
    more_samples : int, optional
        How many further samples like these would tell a drift of the robot from a displacement of
        the device, in half of the cases; 0 if these do, None if a hundred times as many would not.
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
    own = np.array([one.kind != DEVICE for one in test.changes])
    share = np.where(own[:, None], look.changed, 0.0)
    robot = max(float(share.sum()), 1e-300)
    # If the device had moved, a fit of the robot would not tell; so it is taken to stand.
    weights = (share / (robot + look.unchanged)) @ SCALES**2
    factors = [one.factor[:n] for one in test.changes]
    scaled = sum(w * F @ F.T for F, w in zip(factors, weights, strict=True))
    C0, typical = test.C0[:n, :n], test.typical[:n, :n]
    unit = float(np.vdot(typical, C0))
    today = np.linalg.solve(np.eye(n) + (C0 + scaled) @ A[:n, :n], C0 + scaled)
    mean, squares = _average(test, look, A, b)
    tolerance = model.table.tolerance[free]
    drift, metric = np.zeros((2, len(model.table), len(model.table)))
    drift[np.ix_(free, free)] = scaled * np.outer(tolerance, tolerance)
    metric[np.ix_(free, free)] = typical / np.outer(tolerance, tolerance) / unit
    change = np.zeros(len(model.table))
    change[free] = tolerance * mean[:n]
    kept = float(np.sqrt(np.vdot(typical, squares[:n, :n]) / unit))
    growth = float(np.sqrt(np.vdot(typical, today) / unit))
    displaced = max(float(look.changed[~own].sum()), 1e-300)
    needed = math.log(certainty / (1 - certainty)) - math.log(robot / displaced)
    times = None if own.all() else _count_telling(test, share, A, b, needed)
    more = None if times is None else math.ceil(times * look.samples)
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
        C = np.linalg.solve(np.eye(n) + prior @ A, prior)
        m = C @ b
        mean += weight * m
        squares += weight * (C + np.outer(m, m))
    return mean, squares


def _count_telling(
    test: DriftTest, share: np.ndarray, A: np.ndarray, b: np.ndarray, needed: float
) -> float | None:
    """How many times as many further samples raise the log odds of a drift against a displaced
    device by what is needed, in half of the drifts that the samples allow."""
    rng = np.random.default_rng(0)
    M, u = integrate_out(test.C0, A, b[:, None])
    weights = share.ravel() / share.sum() if share.any() else np.full(share.size, 1 / share.size)
    drifts = np.empty((len(b), DRAWS))
    for k, case in enumerate(rng.choice(share.size, DRAWS, p=weights)):
        h, s = divmod(int(case), len(SCALES))
        F = SCALES[s] * test.changes[h].factor
        C = np.linalg.inv(np.eye(F.shape[1]) + F.T @ M @ F)
        z = C @ (F.T @ u[:, 0]) + np.linalg.cholesky(C) @ rng.standard_normal(len(C))
        drifts[:, k] = F @ z
    [device] = (one.factor for one in test.changes if one.kind == DEVICE)

    def squares(times: float) -> np.ndarray:
        M, _ = integrate_out(test.C0, times * A, b[:, None])
        MD = M @ (SCALES[-1] * device)
        beside = M - MD @ np.linalg.solve(
            np.eye(device.shape[1]) + SCALES[-1] * device.T @ MD, MD.T
        )
        return np.einsum("id,ij,jd->d", drifts, beside, drifts)

    now = squares(1.0)
    for times in REPEATS.tolist():
        if np.median(squares(times) - now) / 2 >= needed:
            return times - 1
    return None
