"""Refuse joint readings that no robot of the model's kind shows; most often their unit is wrong.

Real robots show readings beyond their nominal limits, from wrong zeros and after whole turns. Only
readings that span a joint's range several times, or are many ranges away from it, are refused.
"""

from __future__ import annotations

import numpy as np

from parallel_cal.base.units import ANGLES, LARGE_UNITS, LENGTHS, UNITS
from parallel_cal.identification.thresholds import (
    MAX_ARC,
    MAX_DISTANCE,
    MAX_SPAN,
    MIN_CORRELATION,
    MIN_TURNS,
    MOST_READINGS,
    SAME_UNIT,
)
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.model import Model

USUAL_UNITS = {"m": ("mm", "cm", "um"), "rad": ("deg", "mrad")}  # that people mistake for SI


def doubt_readings(
    model: Model, x: np.ndarray, measured: np.ndarray, a: np.ndarray, source: str
) -> str:
    """Explain why the joint readings are impossible, and how to mend them; empty if they are
    possible. `x`, `measured` and `a` are as in Observations."""
    m, q = model.mechanism, x[:, : len(model.joints)]
    excess = _excess(m, q)
    if not excess.any():
        return ""
    worst = int(np.argmax(excess))
    name, unit, (low, high) = m.joints[worst], m.joint_units[worst], m.joint_limits[worst]
    others = [joint for joint, e in zip(m.joints, excess, strict=True) if e and joint != name]
    also = f" (likewise the readings of {', '.join(others)})" if others else ""
    return (
        f"{source or 'samples'}: joint {name} reads {q[:, worst].min():.4g} to "
        f"{q[:, worst].max():.4g} {unit}, its limits are {low:.4g} to {high:.4g} {unit}: the "
        f"span or the distance of the readings is {excess[worst]:.3g} times its range{also}. "
        f"{_guess(model, x, measured, a, worst)}. If the joint does move there, state "
        f"its limits in "
        "the model file (low, high)"
    )


def _excess(m: Mechanism, q: np.ndarray) -> np.ndarray:
    """Number of ranges (nq,) that impossible readings (N, nq) span or are away; 0 for possible
    ones."""
    excess = np.zeros(q.shape[1])
    tail = (1 - MOST_READINGS) / 2
    for i, ((low, high), turn) in enumerate(zip(m.joint_limits, m.joint_periods, strict=True)):
        width = high - low
        if not 0 < width < np.inf:
            continue
        first, middle, last = np.quantile(q[:, i], [tail, 0.5, 1 - tail])
        span = (last - first) / width
        away = max(low - middle, middle - high, 0.0) / width
        if not turn:
            absurd = span > MAX_SPAN or away > MAX_DISTANCE
        elif MAX_ARC * width < MOST_READINGS * turn:  # without whole turns they can still be seen
            goes_round = last - first > MIN_TURNS * turn
            absurd = goes_round and span > MAX_SPAN and _arc(q[:, i], turn) > MAX_ARC * width
        else:
            absurd = span > MAX_DISTANCE
        excess[i] = max(span, away) if absurd else 0.0
    return excess


def _arc(angles: np.ndarray, turn: float) -> float:
    """The shortest arc of the circle that holds most of the angles (N,)."""
    n = len(angles)
    most = int(np.ceil(MOST_READINGS * n))
    around = np.sort(angles % turn)
    around = np.concatenate([around, around + turn])
    return float(np.min(around[most - 1 : most - 1 + n] - around[:n]))


def _guess(model: Model, x: np.ndarray, measured: np.ndarray, a: np.ndarray, i: int) -> str:
    """Guess the unit of the readings of joint i, and say how to state it."""
    unit, read = model.mechanism.joint_units[i], x[:, i]
    cure = "state it in the column map (unit: {}; see docs/import_csv.md), or publish them in {}"
    if scale := _scale(model, x, measured, a, i):
        units = LENGTHS if unit == "m" else ANGLES
        nearest = min(units, key=lambda name: abs(np.log(abs(scale) / units[name])))
        if abs(np.log(abs(scale) / units[nearest])) < SAME_UNIT:
            return (
                f"By the measured poses the readings are in {nearest}: {cure.format(nearest, unit)}"
            )
        shown, factor = LARGE_UNITS[unit]
        one, turn = f"{scale * factor:.4g} {shown}", f"{2 * np.pi * scale * factor:.4g} {shown}"
        return (
            f"By the measured poses one unit of the readings is {one}. They may be a motor's "
            f"revolutions (column map: unit: rev, per_rev: {one}), its radians (per_rev: {turn}), "
            f"or encoder counts: see docs/import_csv.md, or publish them in {unit}"
        )
    low, high = model.mechanism.joint_limits[i]
    margin = (high - low) / 2
    for name in USUAL_UNITS[unit]:
        there = read * UNITS[name]
        if low - margin <= there.min() and there.max() <= high + margin:
            return f"In {name} the readings would be near the limits: {cure.format(name, unit)}"
    other = " or ".join(USUAL_UNITS[unit])
    return (
        f"Are the readings in {other}, a motor's revolutions or encoder counts? Then "
        f"{cure.format('..., per_rev: ...', unit)}"
    )


def _scale(
    model: Model, x: np.ndarray, measured: np.ndarray, a: np.ndarray, i: int
) -> float | None:
    """Motion of joint i by the measured poses (m or rad) per unit of its reading; None if the
    poses do not determine it, for example in an unknown frame."""
    n = len(model.joints)
    controlled = [n + k for k in model.mechanism.controlled]
    given = np.flatnonzero(measured[:, controlled].all(axis=1))
    if len(given) < 3:
        return None
    position, turned = model.structure.to_base(x[given, n:], model.values)
    at = {name: a[given, k] for k, name in enumerate(model.conditions)}
    found = Kinematics(model).inverse(position, turned.reshape(-1, 3, 3), at)
    read, true = x[given[found.solved], i], found.joints[found.solved, i]
    if len(read) < 3 or np.ptp(read) == 0 or np.ptp(true) == 0:
        return None
    (variance, covariance), (_, other) = np.cov(read, true)
    if abs(covariance) < MIN_CORRELATION * np.sqrt(variance * other):
        return None
    # Noise and a rough geometry blur both ways: the ratio of the spreads is in the middle.
    return float(np.sign(covariance) * np.sqrt(other / variance))
