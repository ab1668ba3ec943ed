r"""How much better a change explains the recordings than none: Bayes factors in closed form.

Recording k, at time t_k, tells of the parameters p_k (in tolerances from the model) by its
information A_k and its pull g_k. Three things are unknown and integrated out:

- the error of the calibration, p ~ N(0, s^2 P), which is the same in all recordings. P is the
  covariance of the model, times a factor with a discrete prior, or that of the tolerances;
- the scatter between recordings, such as that of a homing switch, N(0, s^2 w^2 1) for each. Its
  size w has a discrete prior;
- the variance s^2 of the noise, in units of the stated one: scaled inverse chi-square with nu
  degrees of freedom.

A change adds d c_k(tau) e_i to p_k, with d ~ N(0, s^2 z^2), for one parameter i with one size z:

- a step: c = 1 from recording tau on;
- a drift: c = (t_k - t_(tau-1)) / month from tau on;
- a temperature: a step in an expansion that was zero before.

With V the covariance of p given all recordings and h their pull,

    u = sum_k c_k g_k - A1 V h,      m = A2_ii - (A1 V A1)_ii,      A_j = sum_k c_k^j A_k,
    log B = -log(1 + z^2 m) / 2 - D/2 log(1 - z^2 u^2 / ((1 + z^2 m) C)),

A part that scatters from sample to sample explains another part of the squares (`compare_scatter`).
Here C = nu + the squares that no change explains, with D - nu residuals (Gelman et al., Bayesian
Data Analysis, 3rd ed., section 14.2).

The statistic is that of Shiryaev and Roberts for recordings at any times, as a mixture over
parameters, sizes and kinds:

    R(t) = sum_tau (t_tau - t_(tau-1)) B(tau)

Without a change, every B(tau) has the mean 1, so R(t) - t is a martingale: by optional stopping the
mean time until R exceeds T is at least T, whatever the candidates are (M. Pollak, Ann. Statist. 13
(1985) 206). So T is the mean time between false alarms, and there is no limit to tune.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from parallel_cal.model.model import Model
from parallel_cal.watch.visit import SIZES, Expected, Visit, calibration_priors

STEP, DRIFT, WARM, LOOSE = "step", "drift", "temperature", "scatter"
KINDS = {STEP: 0.4, DRIFT: 0.2, WARM: 0.2, LOOSE: 0.2}  # how probable before anything is measured
MONTH = 30 * 86400.0  # s: a drift is in tolerances per month
CHANGES = SIZES[::2]  # sizes of steps and drifts: each is a standard deviation
# Scatter between recordings, in tolerances: most machines have none that shows.
SCATTERS = np.array([0.0, *CHANGES[:-2]])
LOG_SCATTERS = np.log([0.5, *[0.5 / (len(SCATTERS) - 1)] * (len(SCATTERS) - 1)])
NOISE = "noise of all readings"  # the last candidate that scatters


@dataclass(frozen=True)
class Series:
    """Recordings in order of time, about the same parameters (n).

    `priors` are covariances (n, n), in tolerances^2, that the error of the calibration may have.
    """

    visits: tuple[Visit, ...]
    priors: tuple[np.ndarray, ...]

    @classmethod
    def of(cls, visits: Sequence[Visit], model: Model) -> Series:
        names = tuple(dict.fromkeys(name for visit in visits for name in visit.names))
        return cls(tuple(visit.select(names) for visit in visits), calibration_priors(model, names))

    @property
    def names(self) -> tuple[str, ...]:
        return self.visits[0].names

    @cached_property
    def time(self) -> np.ndarray:
        """(K,) s since 1970."""
        return np.array([visit.time for visit in self.visits])

    @cached_property
    def elapsed(self) -> np.ndarray:
        """Time (K,) in which a change may have begun that the recording is the first to show, s.
        What began before the first recording is part of its calibration, or of its temperature."""
        steps = np.diff(self.time)
        return np.concatenate([[np.median(steps) if len(steps) else 0.0], steps])

    @cached_property
    def is_warmth(self) -> np.ndarray:
        """Candidates (n,) that the calibration took to be zero: the expansions."""
        return np.diag(self.priors[0]) == 0

    def absorb(self, scatter: float) -> Absorbed:
        """Integrate out a scatter between the recordings, in tolerances."""
        visits = self.visits
        A = np.array([visit.evidence.information for visit in visits])
        g = np.array([visit.evidence.pull for visit in visits])
        squares, log_det = sum(visit.evidence.squares for visit in visits), 0.0
        if scatter:
            L = scatter * ~self.is_warmth
            LA, Lg = L[:, None] * A, L * g
            K = np.eye(len(L)) + LA * L
            log_det = float(np.linalg.slogdet(K)[1].sum())
            solved = np.linalg.solve(K, np.concatenate([LA, Lg[:, :, None]], axis=2))
            squares -= float(np.sum(Lg * solved[:, :, -1]))
            taken = LA.transpose(0, 2, 1) @ solved
            A, g = A - taken[:, :, :-1], g - taken[:, :, -1]
        nu = visits[0].noise_weight
        D = nu + sum(visit.evidence.rows for visit in visits)
        return Absorbed(A, g, nu + squares, D, log_det, scatter)


@dataclass(frozen=True)
class Absorbed:
    """All recordings under one scatter between them: information (K, n, n) and pull (K, n) of each,
    squares with their degrees of freedom, and the log determinant of the scatter."""

    information: np.ndarray
    pull: np.ndarray
    squares: float
    dof: float
    log_det: float
    scatter: float


@dataclass(frozen=True)
class Fit:
    """All recordings under one scatter between them.

    information (K, n, n) and pull (K, n) of each; V (n, n) the covariance of the constant
    parameters and h (n,) the pull of all; C and D the squares and their degrees of freedom.
    `log_p` is the log evidence of no change.
    """

    information: np.ndarray
    pull: np.ndarray
    V: np.ndarray
    h: np.ndarray
    C: float
    D: float
    log_p: float
    scatter: float

    @classmethod
    def of(cls, recordings: Absorbed, prior: np.ndarray) -> Fit:
        A, g = recordings.information, recordings.pull
        S, h = A.sum(axis=0), g.sum(axis=0)
        squares, turn = np.linalg.eigh(prior)
        F = turn * np.sqrt(np.maximum(squares, 0.0))  # prior = F F'
        inner = np.eye(len(S)) + F.T @ S @ F
        V = F @ np.linalg.solve(inner, F.T)
        log_det = recordings.log_det + float(np.linalg.slogdet(inner)[1])
        C, D = recordings.squares - float(h @ V @ h), recordings.dof
        return cls(A, g, V, h, C, D, -log_det / 2 - D / 2 * np.log(C), recordings.scatter)

    def score(self, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Score u and information m (T, n) of changes in proportion to weights (T, K)."""
        first = np.tensordot(weights, self.information, 1)
        second = weights**2 @ np.diagonal(self.information, axis1=1, axis2=2)
        u = weights @ self.pull - first @ (self.V @ self.h)
        m = second - np.sum((first @ self.V) * first, axis=2)
        return u, np.maximum(m, 0.0)

    def log_bayes(self, u: np.ndarray, m: np.ndarray) -> np.ndarray:
        """Log Bayes factors (T, n, sizes)."""
        z = CHANGES**2
        gain = 1 + z * m[..., None]
        explained = z * u[..., None] ** 2 / gain / self.C
        return np.asarray(
            -np.log(gain) / 2 - self.D / 2 * np.log1p(-np.minimum(explained, 1 - 1e-12))
        )


def weights_of(kind: str, series: Series) -> np.ndarray:
    """c_k(tau) (T, K) of a change that begins before each recording tau."""
    t = series.time
    after = t[None, :] >= t[:, None]
    if kind != DRIFT:
        return after.astype(float)
    begin = np.concatenate([t[:1], t[:-1]])  # a drift begins at the recording before
    return np.where(after, (t - begin[:, None]) / MONTH, 0.0)


@dataclass(frozen=True)
class Weighed:
    """Probabilities of changes of one kind, given that there is a change of any kind.

    share (T, n, sizes) by onset, parameter and size; value and sigma (T, n, sizes) of the change,
    in tolerances (per month for a drift; the standard deviation of what scatters).
    """

    share: np.ndarray
    value: np.ndarray
    sigma: np.ndarray


@dataclass(frozen=True)
class Weights:
    """All changes weighed against none. `log_statistic` is log R, with R in s."""

    log_statistic: float
    kinds: dict[str, Weighed]


def weigh(series: Series) -> Weights:
    """Weigh every change against none, by all recordings of a series."""
    fits = null_fits(series)
    warm, log_began = series.is_warmth, np.log(np.maximum(series.elapsed, 1e-300))
    kinds = {kind: p for kind, p in KINDS.items() if kind != WARM or warm.any()}
    found: dict[str, tuple[np.ndarray, ...]] = {}
    for kind, prior in kinds.items():
        if kind == LOOSE:
            own = np.append(~warm, True)
            log_b = weigh_scatter(fits, series)
            value = np.broadcast_to(SIZES, log_b.shape)
            sigma = np.zeros(log_b.shape)
        else:
            own = warm if kind == WARM else ~warm
            log_b, value, sigma = _average(fits, weights_of(kind, series))
        log_prior = np.log(prior / sum(kinds.values()) / max(own.sum(), 1) / log_b.shape[2])
        log_b = np.where(own[:, None], log_b + log_prior, -np.inf) + log_began[:, None, None]
        if kind != WARM:  # what was so from the beginning is no change
            log_b[0] = -np.inf
        found[kind] = log_b, value, sigma
    log_r = float(
        np.logaddexp.reduce([np.logaddexp.reduce(f[0], axis=None) for f in found.values()])
    )
    shares = {
        kind: Weighed(np.exp(log_b - log_r) if np.isfinite(log_r) else np.zeros_like(log_b), *rest)
        for kind, (log_b, *rest) in found.items()
    }
    return Weights(log_r, shares)


def predict_parameters(series: Series) -> Expected:
    """What recordings leave of the parameters of the next one, if nothing has changed, with the
    most probable scatter between them."""
    fits = null_fits(series)
    best = int(np.argmax([log_p for _, log_p in fits]))
    fit = fits[best][0]
    scatter = np.where(series.is_warmth, 0.0, fit.scatter)
    return Expected(series.names, fit.V @ fit.h, fit.V + np.diag(scatter**2), best)


def weigh_scatter(fits: Sequence[tuple[Fit, float]], series: Series) -> np.ndarray:
    """Log Bayes factors (T, n + 1, sizes) of parts that scatter from recording tau on: they explain
    a part of the squares of the innovations, whose sum is C, and enlarge their covariance (see
    `compare_scatter`). They count as much as the fit that these innovations are beside."""
    visits = series.visits
    each = [(visit.innovation.explained, visit.innovation.log_det) for visit in visits]
    explained, log_det = np.cumsum(np.array(each)[::-1], axis=0)[::-1].transpose(1, 0, 2, 3)
    C = visits[0].noise_weight + sum(visit.innovation.squares for visit in visits)
    D = visits[0].noise_weight + sum(visit.innovation.rows for visit in visits)
    log_p = np.array([fits[visit.innovation.fit][1] for visit in visits])[:, None, None]
    return np.asarray(log_p - D / 2 * np.log1p(-explained / C) - log_det / 2)


def _average(
    fits: Sequence[tuple[Fit, float]], weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Log Bayes factors, and means and standard deviations of the changes (T, n, sizes), over all
    fits and their log probabilities."""
    log_b, mean, square = [], [], []
    for fit, log_p in fits:
        u, m = fit.score(weights)
        gain = CHANGES**2 / (1 + CHANGES**2 * m[..., None])
        log_b.append(fit.log_bayes(u, m) + log_p)
        mean.append(gain * u[..., None])
        square.append(gain * fit.C / fit.D + mean[-1] ** 2)
    total = np.logaddexp.reduce(log_b, axis=0)
    share = np.exp(np.array(log_b) - total)
    value = np.sum(share * mean, axis=0)
    return total, value, np.sqrt(np.maximum(np.sum(share * square, axis=0) - value**2, 0.0))


def smallest_steps(series: Series, following: Visit, share: float) -> np.ndarray:
    """The smallest step (n,) of each parameter, in tolerances, that one more recording would show;
    infinite beyond the largest size.

    `following` has the information of the recording to come; `share` is the time to it over the
    mean time between false alarms. The step is expected to be as it is, without noise.
    """
    own, more = null_fits(series), replace(series, visits=(*series.visits, following))
    last = np.zeros((1, len(more.visits)))
    last[0, -1] = 1.0
    steps = 10.0 ** np.arange(-4, np.log10(SIZES[-1]) + 0.01, 0.02)
    absorbed_by = [more.absorb(scatter) for scatter in SCATTERS]
    pairs = [(one, prior) for prior in series.priors for one in absorbed_by]
    total = np.full((len(series.names), len(steps)), -np.inf)
    for (fit, log_p), (absorbed, prior) in zip(own, pairs, strict=True):
        m = Fit.of(absorbed, prior).score(last)[1][0]
        known = replace(fit, C=fit.C + following.evidence.rows, D=fit.D + following.evidence.rows)
        log_b = known.log_bayes(
            steps[None] * m[:, None], np.broadcast_to(m[:, None], (len(m), len(steps)))
        )
        total = np.logaddexp(total, np.logaddexp.reduce(log_b, axis=2) + log_p)
    kinds = {kind: p for kind, p in KINDS.items() if kind != WARM or series.is_warmth.any()}
    prior_step = KINDS[STEP] / sum(kinds.values()) / (~series.is_warmth).sum() / len(CHANGES)
    seen = total + np.log(prior_step * share) >= 0
    found = np.where(seen.any(axis=1), steps[np.argmax(seen, axis=1)], np.inf)
    return np.where(series.is_warmth, np.inf, found)


def null_fits(series: Series) -> list[tuple[Fit, float]]:
    """Every scatter and prior, with its log probability if nothing has changed."""
    absorbed = [series.absorb(scatter) for scatter in SCATTERS]
    fits = [Fit.of(one, prior) for prior in series.priors for one in absorbed]
    log_p = np.array([fit.log_p for fit in fits]) + np.tile(LOG_SCATTERS, len(series.priors))
    return list(zip(fits, (log_p - np.logaddexp.reduce(log_p)).tolist(), strict=True))
