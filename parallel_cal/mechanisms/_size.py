"""Options of a mechanism that describe its size, so that nobody edits its parameters by hand."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np

from parallel_cal.base.errors import ModelError


def read_numbers(stated: dict[str, Any], may_be_zero: Collection[str] = ()) -> dict[str, float]:
    """Return options as finite numbers above 0, or from 0 on; ModelError names the first other."""
    found = {}
    for name, given in stated.items():
        least = "at least 0" if name in may_be_zero else "above 0"
        try:
            number = float(given)
        except (TypeError, ValueError):
            number = math.nan
        if not math.isfinite(number) or number < 0 or (number == 0 and name not in may_be_zero):
            raise ModelError(f"{name} is {given!r}: expected one number, {least}")
        found[name] = number
    return found


def read_limits(given: Sequence[float], unit: str) -> tuple[float, float]:
    """Return the option `limits`: the lower and the upper limit of every joint."""
    try:
        low, high = (float(limit) for limit in given)
    except (TypeError, ValueError):
        low, high = math.nan, math.nan
    if not (np.isfinite([low, high]).all() and low < high):
        raise ModelError(
            f"limits is {given!r}: expected two numbers in {unit}, the lower one first"
        )
    return low, high


def rms_radius(points: np.ndarray) -> float:
    """Compute the rms distance (m) of points (n, 3) from their middle.

    It is rounded, because the last bit of a root depends on the machine."""
    return round(float(np.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=1)))), 13)


def read_points(name: str, given: Sequence[Sequence[float]], n: int) -> np.ndarray:
    """Return an option that is n points [x, y, z] as an array (n, 3) in m."""
    try:
        points = np.array(given, dtype=float)
    except (TypeError, ValueError):
        points = np.empty(0)
    if points.shape != (n, 3) or not np.isfinite(points).all():
        raise ModelError(f"{name} is {given!r}: expected {n} points [x, y, z] in m")
    return points


def read_point(name: str, given: Sequence[float]) -> np.ndarray:
    """Return an option that is a point [x, y, z] as an array (3,) in m."""
    try:
        point = np.array(given, dtype=float)
    except (TypeError, ValueError):
        point = np.empty(0)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise ModelError(f"{name} is {given!r}: expected a point [x, y, z] in m")
    return point
