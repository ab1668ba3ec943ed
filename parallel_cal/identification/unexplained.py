"""Motion that a fit leaves unexplained, whatever its noise.

Noise that nobody stated is estimated from the residuals, so that chi2 cannot show that a model does
not describe the samples. How far the platform moved does not depend on the noise.
"""

from __future__ import annotations

import numpy as np

from parallel_cal.base.rotation import turns_from_mean
from parallel_cal.base.units import MM
from parallel_cal.identification.fit import FitResult
from parallel_cal.identification.thresholds import (
    MAX_UNEXPLAINED_SHARE,
    MIN_SCALE_SAMPLES,
)


def describe_unexplained_motion(result: FitResult) -> str:
    """Say how much of the measured positions, and of the orientations, a fit leaves unexplained;
    empty if both are explained, or if the stated noise is as large.

    Only coordinates that the robot controls count: the others hardly move. Single wild samples do
    not count, because the error is a median.
    """
    mechanism, dataset = result.model.mechanism, result.dataset
    found = []
    for kind, first in (("position", 0), ("orientation", 3)):
        own = [i for i in mechanism.controlled if first <= i < first + 3]
        errors = result.after.norms(kind)
        known = np.isfinite(errors) & dataset.measured[:, own].all(axis=1)
        if not own or known.sum() < MIN_SCALE_SAMPLES:
            continue
        if kind == "position":
            shown = dataset.r[known][:, own]
            away = shown - shown.mean(axis=0)
        else:
            away = turns_from_mean(dataset.R[known])
        motion = float(np.sqrt(np.mean(np.sum(away**2, axis=1))))
        error = float(np.median(errors[known]))
        if error <= MAX_UNEXPLAINED_SHARE * motion:
            continue
        floor = result.simulated_noise
        stated = floor.summary.rms(kind)
        # Of the noise, only that of the device may be stated. Revisits differ by as much as all
        # else if poses and joints do not belong together.
        if stated is None or floor.revisits:
            part = slice(first - 6, first - 3 or None)
            variance = np.diagonal(result.observations.S, axis1=1, axis2=2)[known, part].copy()
            for unknown in result.observations.unknown:
                variance[unknown.coordinates[known, part]] = 0.0
            stated = float(np.sqrt(np.mean(np.sum(variance, axis=1))))
        if error**2 - stated**2 > (MAX_UNEXPLAINED_SHARE * motion) ** 2:
            unit, factor = ("mm", 1 / MM) if kind == "position" else ("deg", np.degrees(1.0))
            found.append(
                f"the {kind}s by {factor * error:.3g} {unit} (median), {100 * error / motion:.0f} "
                f"% of their measured motion ({factor * motion:.4g} {unit} rms)"
            )
    return f"the fitted model misses {' and '.join(found)}" if found else ""
