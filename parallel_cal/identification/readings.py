"""Refuse joint readings that no robot of the model's kind shows; most often their unit is wrong.

Real robots show readings beyond their nominal limits, from wrong zeros and after whole turns. Only
readings that span a joint's range several times, or are many ranges away from it, are refused.

Readings that are too small for their unit stay within the limits, and a joint without limits has
none to exceed. Such readings are refused if the measured poses prove that the joint moved by
another factor than its readings.
"""

from __future__ import annotations

import numpy as np

from parallel_cal.base.units import ANGLES, LARGE_UNITS, LENGTHS, UNITS
from parallel_cal.identification.thresholds import (
    MAX_ARC,
    MAX_DISTANCE,
    MAX_SCALE_MISMATCH,
    MAX_SCALE_SAMPLES,
    MAX_SCALE_SPREAD,
    MAX_SPAN,
    MIN_CORRELATION,
    MIN_POSE_SPAN,
    MIN_SCALE_CORRELATION,
    MIN_SCALE_SAMPLES,
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
    """Explain why the joint readings are impossible, and how to correct them; "" if they are not.

    `x`, `measured` and `a` are as in Observations.
    """
    m, q = model.mechanism, x[:, : len(model.joints)]
    size = _excess(m, q)
    beyond = bool(size.any())
    if not beyond:
        size = _mismatch(model, x, measured, a)
        if not size.any():
            return ""
    worst = int(np.argmax(size if beyond else np.abs(np.log(np.where(size > 0, size, 1.0)))))
    name, unit = m.joints[worst], m.joint_units[worst]
    if beyond:
        why = f"the span or the distance of the readings is {size[worst]:.3g} times its range"
        cure = "If the joint does move there, state its limits in the model file (low, high)"
    else:
        wrong = max(size[worst], 1 / size[worst])
        why = f"by the measured poses the readings are wrong by the factor {wrong:.3g}"
        cure = "If the readings are right, correct the dimensions in the model file"
    others = [joint for joint, s in zip(m.joints, size, strict=True) if s and joint != name]
    also = f" (likewise the readings of {', '.join(others)})" if others else ""
    low, high = m.joint_limits[worst]
    limits = "it has no limits"
    if np.isfinite(high - low):
        limits = f"its limits are {low:.4g} to {high:.4g} {unit}"
    return (
        f"{source or 'samples'}: joint {name} reads {q[:, worst].min():.4g} to "
        f"{q[:, worst].max():.4g} {unit}, {limits}: {why}{also}. "
        f"{_guess(model, x, measured, a, worst, 0.0 if beyond else size[worst])}. {cure}"
    )


def _excess(m: Mechanism, q: np.ndarray) -> np.ndarray:
    """Return the number of ranges (nq,) that impossible readings span or are away; else 0."""
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


def _mismatch(model: Model, x: np.ndarray, measured: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return how much further (nq,) the joints moved than they read; 0 if it is not proved that
    they moved by another factor."""
    factor = np.zeros(len(model.joints))
    q = x[:, : len(factor)]
    low, high = np.array(model.mechanism.joint_limits, float).reshape(-1, 2).T
    width = np.where(np.isfinite(high - low), high - low, np.nan)
    span = np.ptp(
        np.quantile(q, [(1 - MOST_READINGS) / 2, (1 + MOST_READINGS) / 2], axis=0), axis=0
    )
    limited = np.isfinite(width)
    # Other readings leave no room for a mismatch within the joint's range. The solution of the
    # inverse problem is not needed for them. Without a range, only the poses can tell.
    small = ~limited | (span * MAX_SCALE_MISMATCH < width)
    large = ~limited | (span > width)
    if len(q) < MIN_SCALE_SAMPLES or not (small | large).any():
        return factor
    some = np.unique(np.linspace(0, len(q) - 1, MAX_SCALE_SAMPLES).astype(int))
    read, moved = _readings_and_motion(model, x[some], measured[some], a[some], quick=True)
    if len(read) < MIN_SCALE_SAMPLES:
        return factor
    # In an unknown frame of the device, the poses lie where the robot cannot be, or the joints
    # disagree: some are not correlated with their readings, or all by different factors.
    middle = np.median(moved, axis=0)
    inside = (low - width < middle) & (middle < high + width)
    moves = np.ptp(moved, axis=0) > MIN_POSE_SPAN * width
    used = np.flatnonzero(~limited | (inside & moves))
    scales = [_scale(read[:, i], moved[:, i], MIN_SCALE_CORRELATION) for i in used]
    if not scales or None in scales:
        return factor
    size = np.log(np.abs(np.array(scales, float)))
    worst = size[np.argmax(np.abs(size))]
    if np.minimum(np.abs(size), np.abs(size - worst)).max() > MAX_SCALE_SPREAD:
        return factor
    for i, one in zip(used, size, strict=True):
        if (small[i] and one > np.log(MAX_SCALE_MISMATCH)) or (
            large[i] and one < -np.log(MAX_SCALE_MISMATCH)
        ):
            factor[i] = np.exp(one)
    return factor


def _arc(angles: np.ndarray, turn: float) -> float:
    """Return the shortest arc of the circle that contains most of the angles (N,)."""
    n = len(angles)
    most = int(np.ceil(MOST_READINGS * n))
    around = np.sort(angles % turn)
    around = np.concatenate([around, around + turn])
    return float(np.min(around[most - 1 : most - 1 + n] - around[:n]))


def _guess(
    model: Model, x: np.ndarray, measured: np.ndarray, a: np.ndarray, i: int, factor: float
) -> str:
    """Guess the unit of the readings of joint i, and say how to state it. `factor` is how much
    further the joint moved than it reads, 0 if it is not known."""
    unit, read = model.mechanism.joint_units[i], x[:, i]
    entry = f"{model.joints[i]}: {{{{column: ..., unit: {{}}}}}}"  # of the column map
    cure = f"state it in the column map ({entry}; see docs/import_csv.md), or publish them in {{}}"
    solved, moved = _readings_and_motion(model, x, measured, a)
    if scale := _scale(solved[:, i], moved[:, i], MIN_CORRELATION) or factor:
        units = LENGTHS if unit == "m" else ANGLES
        twice = [k for k, v in units.items() if v != 1 and _is_same(abs(scale) * v, 1.0)]
        if twice:
            return (
                f"By the measured poses the readings were in {unit} already and were converted "
                f"from {twice[0]}: {cure.format(unit, unit)}"
            )
        nearest = min(units, key=lambda name: abs(np.log(abs(scale) / units[name])))
        if _is_same(abs(scale), units[nearest]):
            return (
                f"By the measured poses the readings are in {nearest}: {cure.format(nearest, unit)}"
            )
        shown, factor = LARGE_UNITS[unit]
        one, turn = f"{scale * factor:.4g} {shown}", f"{2 * np.pi * scale * factor:.4g} {shown}"
        return (
            f"By the measured poses one unit of the readings is {one}. They may be a motor's "
            f"revolutions (column map: {entry.format(f'rev, per_rev: {one}')}), its radians "
            f"(unit: rad, per_rev: {turn}), or encoder counts: see docs/import_csv.md, or publish "
            f"them in {unit}"
        )
    low, high = model.mechanism.joint_limits[i]
    margin = (high - low) / 2
    for name in USUAL_UNITS[unit] if np.isfinite(margin) else ():
        there = read * UNITS[name]
        if low - margin <= there.min() and there.max() <= high + margin:
            revolutions = entry.format("rev, per_rev: ...")
            return (
                f"In {name} the readings would be near the limits: {cure.format(name, unit)}. If "
                f"they are a motor's revolutions: {revolutions}"
            )
    other = " or ".join(USUAL_UNITS[unit])
    return (
        f"Are the readings in {other}, a motor's revolutions or encoder counts? Then "
        f"{cure.format('..., per_rev: ...', unit)}"
    )


def _is_same(scale: float, other: float) -> bool:
    return bool(abs(np.log(scale / other)) < SAME_UNIT)


def _readings_and_motion(
    model: Model, x: np.ndarray, measured: np.ndarray, a: np.ndarray, quick: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Return readings (k, nq), and the joints (k, nq) that the measured poses require.

    They are the samples whose pose is measured and can be reached; if `quick`, those whose solution
    is found at once.
    """
    n = len(model.joints)
    controlled = [n + k for k in model.mechanism.controlled]
    given = np.flatnonzero(measured[:, controlled].all(axis=1))
    if not len(given):
        return np.empty((0, n)), np.empty((0, n))
    position, turned = model.structure.to_base(x[given, n : n + 12], model.values)
    at = {name: a[given, k] for k, name in enumerate(model.conditions)}
    found = Kinematics(model, quick=quick).inverse(position, turned.reshape(-1, 3, 3), at)
    return x[given[found.solved], :n], found.joints[found.solved]


def _scale(read: np.ndarray, moved: np.ndarray, min_correlation: float) -> float | None:
    """Return the motion of a joint (m or rad) per unit of its reading.

    None if the poses do not determine it, for example in an unknown frame.
    """
    if len(read) < 3 or np.ptp(read) == 0 or np.ptp(moved) == 0:
        return None
    (variance, covariance), (_, other) = np.cov(read, moved)
    if abs(covariance) < min_correlation * np.sqrt(variance * other):
        return None
    # Noise and a rough geometry blur both ways: the ratio of the spreads is in the middle.
    return float(np.sign(covariance) * np.sqrt(other / variance))
