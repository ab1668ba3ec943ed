"""The residual of each joint against its reading, as linear and polar panels."""

from __future__ import annotations

import numpy as np

from parallel_cal.diagnosis.patterns import compute_mean_profile
from parallel_cal.diagnosis.signature import Signature
from parallel_cal.diagnosis.thresholds import WINDOW
from parallel_cal.reporting.colours import MEASURED, PATTERN, QUIET
from parallel_cal.reporting.contents import JointResiduals
from parallel_cal.reporting.figures import (
    Spec,
    circles,
    round_values,
    round_with_gaps,
    select_evenly,
    select_points,
    side_by_side,
)
from parallel_cal.reporting.readable import number, value_unit

MAX_LINE_ROUGHNESS = 0.5  # of a pattern's variance: neighbours that differ by more are no line
# points of a curve a period, samples that one is the mean of
POINTS_PER_PERIOD = 40
SAMPLES_PER_MEAN = 5
MAX_MEANS = 60  # of the samples of a joint, one after the other along its readings
MAX_POINTS_PER_JOINT = 300  # more hide each other, and a browser needs half a second to draw them
SECTOR_MARGIN_DEG = 5.0  # margin of a sector around the measured range


def flat_panels(
    found: JointResiduals, candidate: Signature | None = None, shown: np.ndarray | None = None
) -> Spec:
    """Draw one panel per joint: encoder reading minus inverse kinematics of the measured pose,
    against the reading, with the pattern of a candidate. The points are samples whose numbers are
    `shown`, by default of all; the means are those of all."""
    panels, axes, size = [], [], _size(found)
    for k, joint in enumerate(found.joints):
        unit, factor = value_unit(found.units[k])
        fine, small = _fine(found.units[k])
        traces = _traces(found, candidate, k, factor, small, shown)
        panels.append([trace | {"type": "scatter"} for trace in traces])
        axes.append((f"{joint} [{unit}]", f"{joint} residual [{fine}]"))
    return side_by_side(panels, axes, [-size, size])


def polar_panels(
    found: JointResiduals, candidate: Signature | None = None, shown: np.ndarray | None = None
) -> Spec | None:
    """Draw the same panels in polar form, outwards where the encoder reads too much; None if no
    joint turns."""
    turning = [k for k, unit in enumerate(found.units) if unit == "rad"]
    if not turning:
        return None
    factor, (fine, small) = value_unit("rad")[1], _fine("rad")
    theta, panels = found.readings[:, turning] * factor, []
    sector = (float(theta.min()) - SECTOR_MARGIN_DEG, float(theta.max()) + SECTOR_MARGIN_DEG)
    if sector[1] - sector[0] >= 180:
        sector = (0.0, 360.0)
    zero = {
        "mode": "lines",
        "x": round_values(np.linspace(*sector, 181)),
        "y": [0.0] * 181,
        "line": {"color": QUIET, "width": 1},
        "hoverinfo": "skip",
    }
    for k in turning:
        traces = [zero, *_traces(found, candidate, k, factor, small, shown)]
        # In a polar trace x is the angle (deg), and y is the radius.
        polar = {"x": "theta", "y": "r"}
        panels.append([{polar.get(key, key): trace[key] for key in trace} for trace in traces])
    return circles(panels, [found.joints[k] for k in turning], sector, _size(found), fine)


def _size(found: JointResiduals) -> float:
    """Return half the height that shows all but the extreme values, in the small unit."""
    scaled = [abs(found.errors[:, k]) * _fine(unit)[1] for k, unit in enumerate(found.units)]
    return 1.1 * max((float(np.nanquantile(one, 0.99)) for one in scaled), default=1.0)


def _fine(unit: str) -> tuple[str, float]:
    return {"rad": ("mrad", 1e3), "m": ("µm", 1e6)}[unit]


def _traces(
    found: JointResiduals,
    candidate: Signature | None,
    k: int,
    factor: float,
    small: float,
    shown: np.ndarray | None,
) -> list[Spec]:
    """Draw the points and the pattern; a pattern with a short period has no rolling mean."""
    points, mean = _points(found, k, factor, small, shown), _mean(found, k, factor, small)
    if candidate is None:
        return [points, mean]
    period = next((p.period for p in candidate.panels if p.component == found.joints[k]), None)
    laid = _pattern(found, candidate.joints[:, k], period, k, factor, small)
    laid["name"] = f"pattern of {candidate.effect}"
    if period:
        laid["line"] = {"color": PATTERN, "width": 1.5}
        points["marker"] = {"size": 5, "color": MEASURED}
        return [laid, points]
    return [points, mean, laid]


def _points(
    found: JointResiduals, k: int, factor: float, small: float, shown: np.ndarray | None
) -> Spec:
    kept, name = select_points(found.sample, shown, MAX_POINTS_PER_JOINT)
    x, y, numbers = found.readings[kept, k], found.errors[kept, k] * small, found.sample[kept]
    return {
        "mode": "markers",
        "name": name,
        "x": round_values(x * factor),
        "y": round_with_gaps(y),
        "marker": {"size": 4, "color": QUIET, "opacity": 0.8},
        "text": [f"sample {n}: {number(v)}" for n, v in zip(numbers, y, strict=True)],
        "customdata": numbers.tolist(),
        "hoverinfo": "text",
    }


def _mean(found: JointResiduals, k: int, factor: float, small: float) -> Spec:
    told = np.isfinite(found.errors[:, k])
    x, y = found.readings[told, k], found.errors[told, k]
    if len(x) > MAX_MEANS * WINDOW:  # rolling means of so many are a smear
        parts = np.array_split(np.argsort(x, kind="stable"), MAX_MEANS)
        at, mean = (np.array([values[part].mean() for part in parts]) for values in (x, y))
    else:
        means = compute_mean_profile("", x, y[:, None])
        at, mean = means.at, means.mean[:, 0]
    return {
        "mode": "lines",
        "name": "mean of the measured",
        "x": round_values(at * factor),
        "y": round_values(mean * small),
        "line": {"color": MEASURED, "width": 2},
        "hoverinfo": "skip",
    }


def _pattern(
    found: JointResiduals,
    pattern: np.ndarray,
    period: float | None,
    k: int,
    factor: float,
    small: float,
) -> Spec:
    """Draw a fine curve if the pattern is periodic, a line if it is smooth, otherwise points."""
    told = np.isfinite(pattern)
    x, y = found.readings[told, k], pattern[told]
    order = np.argsort(x, kind="stable")
    x, y = x[order], y[order]
    if period is not None:
        fine = np.linspace(x[0], x[-1], round(POINTS_PER_PERIOD * (x[-1] - x[0]) / period))
        x, y = fine, _interpolate_periodic(x, y, period, fine)
    is_line = period is not None or np.mean(np.diff(y) ** 2) < MAX_LINE_ROUGHNESS * np.var(y)
    if period is None:
        few = select_evenly(len(x), MAX_POINTS_PER_JOINT)
        x, y = x[few], y[few]
    return {
        "mode": "lines" if is_line else "markers",
        "x": round_values(x * factor),
        "y": round_values(y * small),
        "hoverinfo": "skip",
        "line": {"color": PATTERN, "width": 2},
        "marker": {"color": PATTERN, "size": 4},
    }


def _interpolate_periodic(
    x: np.ndarray, y: np.ndarray, period: float, at: np.ndarray
) -> np.ndarray:
    """Interpolate a periodic pattern y (N,) at readings x (N,): mean of the nearest samples."""
    order = np.argsort(x % period, kind="stable")
    around = np.take(
        y[order], np.arange(-(SAMPLES_PER_MEAN // 2), len(y) + SAMPLES_PER_MEAN // 2), mode="wrap"
    )
    smooth = np.convolve(around, np.full(SAMPLES_PER_MEAN, 1 / SAMPLES_PER_MEAN), mode="valid")
    return np.interp(at, (x % period)[order], smooth, period=period)
