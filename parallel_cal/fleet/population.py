"""Mean and spread of parameters over robots: a random-effects model, by restricted likelihood.

Robot i has p_i ~ N(mean, diag(spread^2)); its data say exp(g_i.p - p.A_i.p / 2). So every robot
counts as far as it tells, along the directions that it tells of (multivariate meta-analysis:
D. Jackson, R. Riley, I. R. White, Statistics in Medicine 30 (2011) 2481).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from parallel_cal.identification.evidence import Evidence

# of the iteration, and the relative change at which it has settled
ROUNDS = 1000
CONVERGENCE_TOLERANCE = 1e-5
LEVEL = 0.95  # of the intervals
PRIOR_MEAN_SIGMA = 10.0  # tolerances: a mean further from the drawing than these is nobody's
NEGLIGIBLE_VARIANCE_RATIO = 0.01  # of a variance's own uncertainty
MIN_VARIANCE = 1e-10  # of a variance: as good as zero
MIN_WEIGHT = 1e-9  # of a weight: less says nothing


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
        """Of the mean (n,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def next_robot_sigma(self) -> np.ndarray:
        """How far another robot of the same workshop lies from the mean, 1 sigma (n,)."""
        return np.hypot(self.spread, self.sigma)


def population(robots: Sequence[Evidence]) -> Population:
    """The most likely population (REML); each `Evidence` is about 0 in tolerances.

    The spreads climb by a minorising step that keeps them positive (H. Zhou, L. Hu, J. Zhou,
    K. Lange, J. Comput. Graph. Stat. 28 (2019) 350); their intervals are those of
    the likelihood ratio.
    """
    A, g = stack_evidence(robots)
    variance = np.ones(A.shape[1])
    for _ in range(ROUNDS):
        W, mean, covariance = _compute_weighted_mean(A, g, variance)
        away = _whiten(A, variance, (g - A @ mean)[..., None])[..., 0]
        own = np.einsum("ijj->j", W)
        freedom = own - np.einsum("ijk,kl,ilj->j", W, covariance, W)
        told = own > MIN_WEIGHT
        ratio = np.sum(away**2, axis=0)[told] / np.maximum(freedom[told], 1e-12)
        step = np.ones_like(variance)
        step[told] = np.sqrt(np.clip(ratio, 1e-2, 1e2))
        variance = np.maximum(variance * step, MIN_VARIANCE)
        # The way to zero is long: what falls far below all that the data could show is there.
        shown = np.sqrt(2 / np.maximum(np.einsum("ijj,ijj->j", W, W), 1e-300))
        variance[(variance < NEGLIGIBLE_VARIANCE_RATIO * shown) & (step < 1)] = MIN_VARIANCE
        if np.abs(step[variance > 100 * MIN_VARIANCE] - 1).max(initial=0.0) < CONVERGENCE_TOLERANCE:
            break
    W, mean, covariance = _compute_weighted_mean(A, g, variance)
    away = _whiten(A, variance, (g - A @ mean)[..., None])[..., 0]
    fisher = np.sum(W * W.transpose(0, 2, 1), axis=0) / 2  # information of the variances
    size = np.sqrt(np.maximum(np.diag(fisher), 1e-300))
    shared = np.diag(np.linalg.pinv(fisher / np.outer(size, size), 1e-10, hermitian=True))
    ends = _interval(W, away, variance, np.maximum(shared, 1.0))
    spread = np.sqrt(np.where(variance > MIN_VARIANCE, variance, 0.0))
    return Population(mean, covariance, spread, *ends)


def stack_evidence(robots: Sequence[Evidence]) -> tuple[np.ndarray, np.ndarray]:
    """Information (N, n, n) and pull (N, n) of all the robots, or of one's recordings."""
    return np.array([r.information for r in robots]), np.array([r.pull for r in robots])


def _whiten(A: np.ndarray, variance: np.ndarray, right: np.ndarray) -> np.ndarray:
    """(1 + A diag(variance))^-1 right: what a robot's data say of the population."""
    return np.asarray(np.linalg.solve(np.eye(A.shape[1]) + A * variance, right))


def _compute_weighted_mean(
    A: np.ndarray, g: np.ndarray, variance: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Each robot's weight (N, n, n) on the population, the mean by them and its covariance."""
    both = _whiten(A, variance, np.concatenate([A, g[..., None]], axis=2))
    W = both[..., :-1]
    covariance = np.linalg.inv(W.sum(axis=0) + np.eye(A.shape[1]) / PRIOR_MEAN_SIGMA**2)
    return W, covariance @ both[..., -1].sum(axis=0), covariance


def _interval(
    W: np.ndarray, away: np.ndarray, variance: np.ndarray, shared: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Ends (n,) of the spreads' intervals: where the likelihood falls by so much; weights (N, n, n)
    and whitened distances (N, n) of the robots.

    A variance more by d makes a weight w of it w / (1 + d w) and log L more by
    sum_i (u_i^2 d / (1 + d w_i) - log(1 + d w_i)) / 2. `shared` (n,) is how much less is known of
    it because the others are not known.
    """
    from scipy.stats import chi2

    rows = zip(np.einsum("ijj->ji", W), away.T, variance, chi2.ppf(LEVEL, 1) * shared, strict=True)
    ends = np.array([_find_variance_interval(*row) for row in rows])
    return np.sqrt(ends[:, 0]), np.sqrt(ends[:, 1])


def _find_variance_interval(
    w: np.ndarray, u: np.ndarray, variance: float, fall: float
) -> tuple[float, float]:
    """Between which variances twice the log likelihood is less than `fall` below its peak."""
    if w.max() < MIN_WEIGHT:
        return 0.0, PRIOR_MEAN_SIGMA**2
    scale = (
        w.sum() / max(float(u @ u), 1e-300) if variance > MIN_VARIANCE else 1.0
    )  # the peak is at d = 0
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
    """A parameter by which a robot is off: how far (tolerances), 1 sigma of that with the
    population's spread in it, and its two-sided p-value."""

    parameter: int
    size: float
    sigma: float
    p_value: float


def find_deviations(
    robot: Evidence, mean: np.ndarray, spread: np.ndarray, chance: float
) -> list[ParameterDeviation]:
    """What sets a robot apart from a population, one parameter after the other, each beside those
    before; the first in any case, then those that are no chance."""
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
    """A population of the robots that belong together, and those that do not, by their number:
    what sets them apart."""

    population: Population
    outlying: dict[int, list[ParameterDeviation]]


def separate_outliers(robots: Sequence[Evidence], chance: float) -> SeparatedPopulation:
    """The population without its outliers, so named that of those no more than the share `chance`
    is there by chance (Y. Benjamini, Y. Hochberg, J. R. Stat. Soc. B 57 (1995) 289).

    A robust start (median, MAD) keeps one robot from hiding another; then the population is that
    of the robots left, and all are held against the widest spread that it may have, until the same
    ones stay.
    """
    A, g = stack_evidence(robots)
    alone = np.linalg.solve(A + np.eye(A.shape[1]), g[..., None])[..., 0]
    mean = np.median(alone, axis=0)
    spread = np.maximum(1.4826 * np.median(np.abs(alone - mean), axis=0), 1e-3)
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
    """Robots beyond chance, never more than a third of them."""
    from scipy.stats import false_discovery_control

    off = [find_deviations(robot, mean, spread, chance) for robot in robots]
    p = np.array([min(1.0, one[0].p_value * len(mean)) for one in off])
    named = false_discovery_control(p) < chance
    worst = np.argsort(p, kind="stable")[: len(robots) // 3]
    return {int(i): off[i] for i in sorted(worst) if named[i]}
