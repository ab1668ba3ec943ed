"""Linear calibration: the closure linearised once, at the starting parameters (5.3.6)."""

from __future__ import annotations

import numpy as np

from parallel_cal.evidence import Evidence
from parallel_cal.methods._descent import judged
from parallel_cal.methods.implicit import Estimate, Linearisation, _finished, _prior, _step
from parallel_cal.model import Model


def estimate(
    model: Model,
    evidence: Evidence,
    free: np.ndarray,
    prior: bool = False,
    weighted: bool = True,
) -> Estimate:
    """One Gauss-Newton step of implicit calibration: J dp = -f (eq. 5.29), by SVD.

    Weights: the noise that the closure inherits at the measured quantities;
    `weighted=False` is the thesis' equation. chi2 is that of the closure at the values found,
    so it shows what the linearisation left out.
    """
    tolerance = model.table.tolerance[free]
    linearise = Linearisation(model, evidence, free, weighted)
    system = linearise(np.array(model.values), linearise.start())
    step, _ = _step(system, tolerance, 0.0, _prior(model, model.values, free, prior))
    values = np.array(model.values)
    values[free] += step
    if weighted:
        found = linearise(values, system.adjusted(step))
        return _finished(model, values, found, free, prior, 1)
    J = system.jacobian.reshape(-1, len(tolerance)) * tolerance
    return judged(model, values, evidence, free, 1, -np.linalg.pinv(J) * tolerance[:, None])
