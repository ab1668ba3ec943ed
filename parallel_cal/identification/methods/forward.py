"""Forward calibration: measured poses minus solutions of the direct problem (5.3.4)."""

from __future__ import annotations

import numpy as np

from parallel_cal.identification.estimate import Estimate
from parallel_cal.identification.methods._explicit import Prediction
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.prior import Prior
from parallel_cal.model.model import Model


def estimate(
    model: Model, observations: Observations, free: np.ndarray, prior: bool | Prior | None = False
) -> Estimate:
    """Parameters that minimise the pose errors of eq. 5.22, in units of their noise.

    Weights: covariance of the measured pose plus that of the joints carried through the direct
    problem, so samples near a direct singularity count little (the thesis had to remove them).
    All measured coordinates that the mechanism moves count. FitError without convergence.
    """
    return Prediction(model, observations, free, direct=True).minimise_residuals(prior)
