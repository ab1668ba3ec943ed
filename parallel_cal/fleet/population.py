"""Mean and spread of parameters over robots: a random-effects model, by restricted likelihood.

Robot i has p_i ~ N(mean, diag(spread^2)); the likelihood of its data is exp(g_i.p - p.A_i.p / 2).
So every robot has weight only along the directions that its data determine, and as much as they
determine them (multivariate meta-analysis: D. Jackson, R. Riley, I. R. White, Statistics in
Medicine 30 (2011) 2481).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from parallel_cal.identification.evidence import Evidence

MAX_ITERATIONS = 1000
CONVERGENCE_TOLERANCE = 1e-5  # relative change of the variances at which the iteration ends
CONFIDENCE_LEVEL = 0.95  # of the spreads' intervals
PRIOR_MEAN_SIGMA = 10.0  # tolerances: prior of the mean about the drawing, wide on purpose
NEGLIGIBLE_VARIANCE_RATIO = 0.01  # of a variance's own uncertainty: below it, it is zero
MIN_VARIANCE = 1e-10  # tolerances^2: stands for zero
MIN_WEIGHT = 1e-9  # a smaller weight tells nothing


@dataclass(frozen=True)
class Population:
    """Parameters (n,) of a fleet, in tolerances from the drawing: mean with its covariance (n, n),
    spread (1 sigma from robot to robot) with the ends of its 95 % interval."""

    mean: np.ndarray
    covariance: np.ndarray
    spread: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @property
    def sigma(self) -> np.ndarray:
        """1 sigma of the mean (n,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def next_robot_sigma(self) -> np.ndarray:
        """1 sigma (n,) of the distance of another robot of the same workshop from the mean."""
        return np.hypot(self.spread, self.sigma)


def population(robots: Sequence[Evidence]) -> Population:
    """Estimate the most likely population (REML); each `Evidence` is about 0, in tolerances.

    The variances are iterated by a minorise-maximise step that keeps them positive (H. Zhou, L. Hu,
    J. Zhou, K. Lange, J. Comput. Graph. Stat. 28 (2019) 350); their intervals follow from the
    likelihood ratio.
    """
    A, g = stack_evidence(robots)
    variance = np.ones(A.shape[1])
    for _ in range(MAX_ITERATIONS):
        W, mean, covariance = _compute_weighted_mean(A, g, variance)
        away = _whiten(A, variance, (g - A @ mean)[..., None])[..., 0]
        weight = np.einsum("ijj->j", W)
        freedom = weight - np.einsum("ijk,kl,ilj->j", W, covariance, W)
        determined = weight > MIN_WEIGHT
        ratio = np.sum(away**2, axis=0)[determined] / np.maximum(freedom[determined], 1e-12)
        step = np.ones_like(variance)
        step[determined] = np.sqrt(np.clip(ratio, 1e-2, 1e2))
        variance = np.maximum(variance * step, MIN_VARIANCE)
        # The steps approach zero slowly: set a variance to zero once it is far below its own
        # uncertainty and still decreasing.
        uncertainty = np.sqrt(2 / np.maximum(np.einsum("ijj,ijj->j", W, W), 1e-300))
        variance[(variance < NEGLIGIBLE_VARIANCE_RATIO * uncertainty) & (step < 1)] = MIN_VARIANCE
        if np.abs(step[variance > 100 * MIN_VARIANCE] - 1).max(initial=0.0) < CONVERGENCE_TOLERANCE:
            break
    W, mean, covariance = _compute_weighted_mean(A, g, variance)
    away = _whiten(A, variance, (g - A @ mean)[..., None])[..., 0]
    fisher = np.sum(W * W.transpose(0, 2, 1), axis=0) / 2  # information of the variances
    size = np.sqrt(np.maximum(np.diag(fisher), 1e-300))
    shared = np.diag(np.linalg.pinv(fisher / np.outer(size, size), 1e-10, hermitian=True))
    ends = _find_spread_intervals(W, away, variance, np.maximum(shared, 1.0))
    spread = np.sqrt(np.where(variance > MIN_VARIANCE, variance, 0.0))
    return Population(mean, covariance, spread, *ends)


def stack_evidence(robots: Sequence[Evidence]) -> tuple[np.ndarray, np.ndarray]:
    """Stack the information (N, n, n) and the pull (N, n) of N robots, or of one's recordings."""
    return np.array([r.information for r in robots]), np.array([r.pull for r in robots])


def _whiten(A: np.ndarray, variance: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return (1 + A diag(variance))^-1 right: what a robot's data tell about the population."""
    return np.asarray(np.linalg.solve(np.eye(A.shape[1]) + A * variance, right))


def _compute_weighted_mean(
    A: np.ndarray, g: np.ndarray, variance: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return each robot's weight (N, n, n), the weighted mean (n,) and its covariance (n, n)."""
    both = _whiten(A, variance, np.concatenate([A, g[..., None]], axis=2))
    W = both[..., :-1]
    covariance = np.linalg.inv(W.sum(axis=0) + np.eye(A.shape[1]) / PRIOR_MEAN_SIGMA**2)
    return W, covariance @ both[..., -1].sum(axis=0), covariance


def _find_spread_intervals(
    W: np.ndarray, away: np.ndarray, variance: np.ndarray, shared: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends (n,) of the spreads' intervals by the likelihood ratio, from the weights W
    (N, n, n) and the whitened distances (N, n) of the robots.

    A variance larger by d changes a weight w to w / (1 + d w) and log L by
    sum_i (u_i^2 d / (1 + d w_i) - log(1 + d w_i)) / 2. `shared` (n,) is the factor by which a
    variance is less certain because the other variances are estimated, too.
    """
    from scipy.stats import chi2

    fall = chi2.ppf(CONFIDENCE_LEVEL, 1) * shared
    rows = zip(np.einsum("ijj->ji", W), away.T, variance, fall, strict=True)
    ends = np.array([_find_variance_interval(*row) for row in rows])
    return np.sqrt(ends[:, 0]), np.sqrt(ends[:, 1])


def _find_variance_interval(
    w: np.ndarray, u: np.ndarray, variance: float, fall: float
) -> tuple[float, float]:
    """Find the variances between which twice the log likelihood is within `fall` of its peak.

    w (N,) are the robots' weights and u (N,) their whitened distances."""
    if w.max() < MIN_WEIGHT:
        return 0.0, PRIOR_MEAN_SIGMA**2
    # Scale the distances so that the peak is at d = 0 exactly.
    scale = w.sum() / max(float(u @ u), 1e-300) if variance > MIN_VARIANCE else 1.0
    d = np.concatenate(
        [-variance * np.geomspace(1, 1e-4, 400), np.geomspace(1e-6, 1e6, 2000) / w.max()]
    )
    grown = 1 + np.outer(d, w)
    less = np.sum(np.log(grown) - scale * u**2 * d[:, None] / grown, axis=1)
    inside = d[less < fall]
    low, high = (inside.min(), inside.max()) if len(inside) else (0.0, 0.0)
    return float(max(variance + low, 0.0)), float(variance + high)


@dataclass(frozen=True)
class ParameterDeviation:
    """A parameter by which a robot deviates from the population, in tolerances.

    `sigma` includes the population's spread; `p_value` is two-sided."""

    parameter: int
    size: float
    sigma: float
    p_value: float


def find_deviations(
    robot: Evidence, mean: np.ndarray, spread: np.ndarray, chance: float
) -> list[ParameterDeviation]:
    """Find the parameters by which a robot deviates from a population, the most significant first.

    Each is tested with those found before it taken into account. The first is returned in any
    case, the others only if they are significant at the level `chance`."""
    from scipy.stats import norm

    A, g, variance = robot.information[None], robot.pull[None], spread**2
    both = _whiten(A, variance, np.concatenate([A, (g - A @ mean)[..., None]], axis=2))[0]
    W, away = both[:, :-1], both[:, -1]
    found: list[ParameterDeviation] = []
    while len(found) < len(away):
        weight = np.maximum(np.diag(W), MIN_WEIGHT)
        p = 2 * norm.sf(np.abs(away) / np.sqrt(weight))
        k = int(np.argmin(p))
        if found and p[k] * len(away) > chance:
            break
        found.append(
            ParameterDeviation(k, float(away[k] / weight[k]), float(weight[k] ** -0.5), float(p[k]))
        )
        away = away - W[:, k] * (away[k] / weight[k])
        W = W - np.outer(W[:, k], W[k]) / weight[k]
    return found


@dataclass(frozen=True)
class SeparatedPopulation:
    """A population without its outliers, and the deviations of each outlier by its number."""

    population: Population
    outlying: dict[int, list[ParameterDeviation]]


def separate_outliers(robots: Sequence[Evidence], chance: float) -> SeparatedPopulation:
    """Separate the outliers from the population, so that at most the share `chance` of them is
    there by chance (Y. Benjamini, Y. Hochberg, J. R. Stat. Soc. B 57 (1995) 289).

    A robust start (median, MAD) keeps one outlier from hiding another. Then the population is
    estimated without the outliers, and all robots are tested against the upper end of its spread,
    until the outliers repeat.
    """
    from scipy.stats import median_abs_deviation

    A, g = stack_evidence(robots)
    alone = np.linalg.solve(A + np.eye(A.shape[1]), g[..., None])[..., 0]
    mean = np.median(alone, axis=0)
    spread = np.maximum(median_abs_deviation(alone, scale="normal"), 1e-3)
    seen: list[frozenset[int]] = []
    while True:
        out = _find_outliers(robots, mean, spread, chance)
        found = population([robot for i, robot in enumerate(robots) if i not in out])
        if frozenset(out) in seen:
            return SeparatedPopulation(found, out)
        seen.append(frozenset(out))
        mean, spread = found.mean, np.hypot(found.high, found.sigma)


def _find_outliers(
    robots: Sequence[Evidence], mean: np.ndarray, spread: np.ndarray, chance: float
) -> dict[int, list[ParameterDeviation]]:
    """Find the robots that deviate significantly, at most a third of all."""
    from scipy.stats import false_discovery_control

    off = [find_deviations(robot, mean, spread, chance) for robot in robots]
    p = np.array([min(1.0, one[0].p_value * len(mean)) for one in off])
    named = false_discovery_control(p) < chance
    worst = np.argsort(p, kind="stable")[: len(robots) // 3]
    return {int(i): off[i] for i in sorted(worst) if named[i]}
