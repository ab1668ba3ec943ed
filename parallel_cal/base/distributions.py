"""Tails of the F and chi-squared distributions, and the minimum of a function of one number.

SciPy has all of them, but importing it takes as long as a whole fit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

MAX_TERMS = 100_000  # of a series or a continued fraction; few dozen are usual
PRECISION = 1e-15
TINY = 1e-290
GOLDEN_SHARE = (3 - 5**0.5) / 2


def f_log_tail(F: Any, q: float, dof: float) -> Any:
    """Compute the logarithm of P(F' > F), with q and dof degrees of freedom.

    Parameters
    ----------
    F : float or array
        Values of F, not below 0.
    q, dof : float
        Degrees of freedom of the numerator and of the denominator.

    Returns
    -------
    float or array
        Finite, too, where the probability is too small for a float.

    References
    ----------
    DLMF 8.17.5 and 8.17.22 (incomplete beta function), https://dlmf.nist.gov/8.17

    Examples
    --------
    >>> round(float(np.exp(f_log_tail(4.0, 2, 10))), 4)
    0.0533
    """
    if np.ndim(F) == 0:
        taken = q * float(F)
        if taken <= TINY or not math.isfinite(taken):
            return 0.0 if taken <= TINY else -math.inf
        return _log_beta_tail(dof / 2, q / 2, dof / (dof + taken), taken / (dof + taken))
    many = q * np.asarray(F, float)
    found = np.where(many > TINY, -np.inf, 0.0)
    usual = (many > TINY) & np.isfinite(many)
    x, y = dof / (dof + many[usual]), many[usual] / (dof + many[usual])
    from_below = x < _turning_point(dof / 2, q / 2)
    for part in (from_below, ~from_below):
        index = np.flatnonzero(usual)[part]
        if len(index):
            found.flat[index] = _log_beta_tail(dof / 2, q / 2, x[part], y[part])
    return found


def f_quantile(q: float, dof: float, share: float) -> float:
    """Find the F below which a share of the distribution lies, with q and dof degrees of freedom.

    Examples
    --------
    >>> round(f_quantile(2, 10, 0.95), 3)
    4.103
    """
    wanted = math.log1p(-share)
    low, high = -700.0, 700.0  # logarithms of F
    while True:
        middle = (low + high) / 2
        if not low < middle < high:
            return math.exp(middle)
        if f_log_tail(math.exp(middle), q, dof) > wanted:
            low = middle
        else:
            high = middle


def chi2_tail(dof: float, x: Any) -> Any:
    """Compute P(chi2 > x) with some degrees of freedom, for one x or an array.

    References
    ----------
    DLMF 8.7.1 and 8.9.2 (incomplete gamma function), https://dlmf.nist.gov/8.7

    Examples
    --------
    >>> round(float(chi2_tail(2, 5.991)), 3)
    0.05
    """
    return _gamma_tails(dof / 2, np.asarray(x, float) / 2)[1][()]


def chi2_below(dof: float, x: Any) -> Any:
    """Compute P(chi2 <= x) with some degrees of freedom, for one x or an array."""
    return _gamma_tails(dof / 2, np.asarray(x, float) / 2)[0][()]


def minimise_between(
    function: Callable[[float], float], low: float, high: float, tolerance: float
) -> float:
    """Find a local minimum between two bounds, to a tolerance of its place.

    Parabolas through the best three points, and the golden section where they do not help.

    References
    ----------
    Brent, R. P. (1973). Algorithms for Minimization without Derivatives, chapter 5.

    Examples
    --------
    >>> round(minimise_between(lambda x: (x - 2) ** 2, 0.0, 5.0, 1e-6), 5)
    2.0
    """
    best = second = third = low + GOLDEN_SHARE * (high - low)
    at_best = at_second = at_third = function(best)
    step = before_last = 0.0
    while True:
        middle = (low + high) / 2
        least = math.sqrt(np.finfo(float).eps) * abs(best) + tolerance / 3
        if abs(best - middle) <= 2 * least - (high - low) / 2:
            return best
        golden = True
        if abs(before_last) > least:
            r = (best - second) * (at_best - at_third)
            s = (best - third) * (at_best - at_second)
            p, s = (best - third) * s - (best - second) * r, 2 * (s - r)
            p = -p if s > 0 else p
            s = abs(s)
            inside = s * (low - best) < p < s * (high - best)
            if inside and abs(p) < abs(s * before_last / 2):
                before_last, step, golden = step, p / s, False
                if min(best + step - low, high - best - step) < 2 * least:
                    step = math.copysign(least, middle - best)
        if golden:
            before_last = (low if best >= middle else high) - best
            step = GOLDEN_SHARE * before_last
        new = best + (step if abs(step) >= least else math.copysign(least, step))
        at_new = function(new)
        if at_new <= at_best:
            low, high = (best, high) if new >= best else (low, best)
            third, at_third, second, at_second = second, at_second, best, at_best
            best, at_best = new, at_new
            continue
        low, high = (new, high) if new < best else (low, new)
        if at_new <= at_second or second == best:
            third, at_third, second, at_second = second, at_second, new, at_new
        elif at_new <= at_third or third in (best, second):
            third, at_third = new, at_new


def _turning_point(a: float, b: float) -> float:
    """Return the x below which the continued fraction of I_x(a, b) converges quickly."""
    return (a + 1) / (a + b + 2)


def _log_beta_tail(a: float, b: float, x: Any, y: Any) -> Any:
    """Compute ln I_x(a, b), with y = 1 - x; the x of an array are on one side of the turning
    point."""
    one = not isinstance(x, np.ndarray)
    log, log1p, exp = (math.log, math.log1p, math.exp) if one else (np.log, np.log1p, np.exp)
    # ln x and ln y, exact, too, where one of the two is almost 1
    front = -a * log1p(y / x) - b * log1p(x / y) + _log_gamma_rise(max(a, b), min(a, b))
    front -= math.lgamma(min(a, b))
    if (x if one else x[0]) < _turning_point(a, b):
        return front - math.log(a) + log(_beta_fraction(a, b, x))
    return log1p(-exp(front - math.log(b)) * _beta_fraction(b, a, y))


def _log_gamma_rise(a: float, b: float) -> float:
    """Compute ln Gamma(a + b) - ln Gamma(a) without the cancellation of two large numbers."""
    if a < 30:
        return math.lgamma(a + b) - math.lgamma(a)

    def correct(z: float) -> float:  # Stirling's series, DLMF 5.11.1
        return (1 / 12 - (1 / 360 - 1 / (1260 * z**2)) / z**2) / z

    rise = (a + b - 0.5) * math.log1p(b / a) + b * (math.log(a) - 1)
    return rise + correct(a + b) - correct(a)


def _beta_fraction(a: float, b: float, x: Any) -> Any:
    """Evaluate the continued fraction of I_x(a, b) from its first term on (Lentz's method)."""
    one = not isinstance(x, np.ndarray)
    c, d = 1.0, 1 / (1 - (a + b) * x / (a + 1))
    value = d
    for m in range(1, MAX_TERMS):
        even = m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m))
        d, c = 1 / (1 + even * d), 1 + even / c
        value = value * (d * c)
        odd = -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1))
        d, c = 1 / (1 + odd * d), 1 + odd / c
        step = d * c
        value = value * step
        if abs(step - 1) < PRECISION if one else (np.abs(step - 1) < PRECISION).all():
            break
    return value


def _gamma_tails(a: float, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute P(a, x) and Q(a, x) of the incomplete gamma function."""
    below, above = np.zeros(x.shape), np.ones(x.shape)
    far = np.isposinf(x)
    below[far], above[far] = 1.0, 0.0
    unknown = np.isnan(x)
    below[unknown] = above[unknown] = np.nan
    near, beyond = (x > 0) & (x < a + 1), (x >= a + 1) & ~far
    if near.any():
        z = x[near]
        term = total = np.full(z.shape, 1 / a)
        for k in range(1, MAX_TERMS):
            term = term * z / (a + k)
            total = total + term
            if (term < PRECISION * total).all():
                break
        below[near] = total * np.exp(a * np.log(z) - z - math.lgamma(a))
        above[near] = 1 - below[near]
    if beyond.any():
        z = x[beyond]
        b = z + 1 - a
        c, d = np.full(z.shape, np.inf), 1 / b
        value = d
        for k in range(1, MAX_TERMS):
            numerator = -k * (k - a)
            b = b + 2
            d, c = 1 / (b + numerator * d), b + numerator / c
            step = d * c
            value = value * step
            if (np.abs(step - 1) < PRECISION).all():
                break
        above[beyond] = value * np.exp(a * np.log(z) - z - math.lgamma(a))
        below[beyond] = 1 - above[beyond]
    return below, above
