"""Where a model fails: residuals along everything recorded, odd samples by name."""

from __future__ import annotations

from typing import Any

import numpy as np

from parallel_cal.base.confidence import SIGMAS
from parallel_cal.diagnosis.fields import Field
from parallel_cal.diagnosis.lack_of_fit import regressors
from parallel_cal.diagnosis.scene import Scene
from parallel_cal.diagnosis.statistics import normal_below, runs_test
from parallel_cal.diagnosis.thresholds import GROSS, INFLUENTIAL, LEVELS, WINDOW


def along(here: Scene, found: Field) -> list[dict[str, Any]]:
    """For every regressor the rolling mean of each residual component with its 99 % band.

    `strength` is the largest mean in units of its own uncertainty, `p_value` the chance of one as
    large among so many; largest first.
    """
    z = found.noise_units
    entries = [_along(name, values, z) for name, values in regressors(here)]
    return sorted(entries, key=lambda entry: -entry["strength"])


def _along(name: str, values: np.ndarray, z: np.ndarray) -> dict[str, Any]:
    order = np.argsort(values, kind="stable")
    levels = np.unique(values)
    if len(levels) <= LEVELS:  # as direction or payload: a mean for each level, nothing rolls
        means = np.array([z[values == level].mean(axis=0) for level in levels])
        count = np.array([np.count_nonzero(values == level) for level in levels])
        at = levels
    else:
        window = min(WINDOW, max(3, len(z) // 4))
        means, at = _rolling(z[order], window), _rolling(values[order][:, None], window)[:, 0]
        count = np.full(len(means), window)
    scale = np.maximum(z.std(axis=0), 1e-12)
    strength = np.abs(means) / scale * np.sqrt(count)[:, None]
    return {
        "name": name,
        "at": at.tolist(),
        "mean": means.tolist(),
        "band": (SIGMAS / np.sqrt(count)).tolist(),
        "strength": float(strength.max(initial=0.0)),
        "p_value": min(1.0, 2 * strength.size * normal_below(-float(strength.max(initial=0.0)))),
        "runs_p_value": runs_test(z[order]),
    }


def _rolling(values: np.ndarray, window: int) -> np.ndarray:
    sums = np.cumsum(np.vstack([np.zeros((1, values.shape[1])), values]), axis=0)
    return np.asarray((sums[window:] - sums[:-window]) / window)


def regions(here: Scene, found: Field) -> list[dict[str, Any]]:
    """RMS error (m, rad) in the eight octants of the measured workspace, worst first."""
    n = len(here.model.joints)
    places = here.x[:, n : n + 3]
    middle = np.median(places, axis=0)
    octant = (places > middle) @ np.array([1, 2, 4])
    rows = []
    for o in np.unique(octant):
        inside = octant == o
        sides = [f"{axis}{'>' if o >> k & 1 else '<'}" for k, axis in enumerate("xyz")]
        errors = found.pose[inside]
        rows.append(
            {
                "region": " ".join(sides),
                "middle": middle.tolist(),
                "samples": int(inside.sum()),
                "position_rms": _rms(errors[:, :3]),
                "orientation_rms": _rms(errors[:, 3:]),
                "position_bias": errors[:, :3].mean(axis=0).tolist(),
            }
        )
    return sorted(rows, key=lambda row: -(row["position_rms"] + row["orientation_rms"]))


def _rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


def leverages(here: Scene) -> np.ndarray:
    """Share (N,) of the geometry's freedoms that each sample alone decides; 1 on average p/N."""
    return np.asarray(np.sum(here.by_sample(np.sum(here.basis**2, axis=1)), axis=1))


def odd_samples(here: Scene, found: Field) -> list[dict[str, Any]]:
    """Outliers, and samples without which the geometry would be another (Cook's distance).

    An outlier's squared residual in noise units, the typical one taken for the noise, would
    occur once in a thousand data sets; Cook's D above 1 moves the estimate by about its sigma.
    """
    from scipy.special import chdtrc

    blocks = here.by_sample(here.residual)
    k = max(1, round(here.dof / max(len(blocks), 1)))
    squared = np.sum(blocks**2, axis=1)
    scale = np.median(squared) / max(k - 2 / 3, 0.3)  # median of a chi-square is about k - 2/3
    leverage = leverages(here)
    p = chdtrc(k, squared / max(scale, 1e-300)) * len(blocks)
    cook = squared * leverage / max(here.basis.shape[1] * here.chi2_per_dof, 1e-300)
    odd = np.flatnonzero((p < GROSS) | (cook > INFLUENTIAL))
    rows = [
        {
            "sample": int(here.dataset.numbers[i]),
            "time": float(here.dataset.time[i]),
            "sigmas": float(np.sqrt(squared[i] / max(k * scale, 1e-300))),
            "p_value": float(min(p[i], 1.0)),
            "outlier": bool(p[i] < GROSS),
            "cooks_distance": float(cook[i]),
            "leverage": float(leverage[i]),
            "position_error": found.pose[i, :3].tolist(),
        }
        for i in odd
    ]
    return sorted(rows, key=lambda row: -row["sigmas"])
