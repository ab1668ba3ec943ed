"""Bases: columns that can bend as an unknown law of one or two drivers does."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from parallel_cal.diagnosis.thresholds import MAX_DEGREE
from parallel_cal.discovery.drivers import Driver
from parallel_cal.discovery.thresholds import (
    MIN_SAMPLES_PER_PERIOD,
    WAVES,
)

# Orders of the polynomials of two drivers that are multiplied.
LOW_ORDERS = np.array(
    [
        (i, j)
        for i in range(MAX_DEGREE + 1)
        for j in range(MAX_DEGREE + 1)
        if i + j <= MAX_DEGREE + 1
    ]
).T


def splines(drivers: Sequence[Driver], count: int) -> np.ndarray:
    """Columns (members, count, N) of one driver, the same functions for every member.

    They are cubic B-splines with knots at quantiles, so that each column sees samples. A driver of
    few values has polynomials through these values. Columns that a driver lacks are zero.
    """
    from scipy.interpolate import BSpline

    values = np.array([one.values for one in drivers])
    if drivers[0].few_values:
        return _polynomials(values, count - 1)
    inner = np.quantile(values, np.linspace(0, 1, count - MAX_DEGREE + 1))
    inner = np.unique(inner)
    knots = np.r_[[inner[0]] * MAX_DEGREE, inner, [inner[-1]] * MAX_DEGREE]
    out = np.zeros((len(values), count, values.shape[1]))
    for columns, own in zip(out, values, strict=True):
        design = BSpline.design_matrix(own, knots, MAX_DEGREE).toarray()
        columns[: design.shape[1]] = design.T
    return out


def lines(drivers: Sequence[Driver]) -> np.ndarray:
    """One column (members, 1, N) in proportion to a driver."""
    values = np.array([one.values for one in drivers])
    return np.asarray(values[:, None] / np.abs(values).max())


def polynomials(drivers: Sequence[Driver]) -> np.ndarray:
    """Legendre polynomials (members, MAX_DEGREE + 1, N) of one driver."""
    return _polynomials(np.array([one.values for one in drivers]), MAX_DEGREE)


def products(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Columns (members, k, N) of two drivers: products of their `polynomials` of low order."""
    return np.asarray(a[:, LOW_ORDERS[0]] * b[:, LOW_ORDERS[1]])


def _polynomials(values: np.ndarray, degree: int) -> np.ndarray:
    """Legendre polynomials (members, degree + 1, N) over the range of values (members, N); of few
    values, only as many as these determine, and zeros."""
    low, high = values.min(), values.max()
    x = (2 * values - low - high) / (high - low)
    out = np.polynomial.legendre.legvander(x, degree).transpose(0, 2, 1)
    out[:, len(np.unique(values)) :] = 0.0
    return np.ascontiguousarray(out)


def frequencies(values: np.ndarray) -> np.ndarray:
    """Angular frequencies (k,) of waves over values (N,) that the samples determine, from one
    period over the range on; they overlap by half a period."""
    span, n = float(np.ptp(values)), len(np.unique(values))
    most = min(n / MIN_SAMPLES_PER_PERIOD, WAVES / 2)
    return 2 * np.pi / span * np.arange(1.0, max(most, 1.0) + 0.5, 0.5)


def waves(drivers: Sequence[Driver], at: np.ndarray) -> np.ndarray:
    """Sine and cosine (members, k, 2, N) of one driver at evenly spaced angular frequencies (k,):
    powers of the complex wave of their distance."""
    values = np.array([one.values for one in drivers])
    turned = np.empty((len(values), len(at), values.shape[1]), complex)
    turned[:, 0] = np.exp(1j * at[0] * values)
    turned[:, 1:] = np.exp(1j * np.ptp(at) / max(len(at) - 1, 1) * values)[:, None]
    np.cumprod(turned, axis=1, out=turned)
    return np.stack([turned.imag, turned.real], axis=2)
