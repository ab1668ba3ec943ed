"""Forward calibration: measured poses minus solutions of the direct problem (5.3.4)."""

from __future__ import annotations

import numpy as np

from parallel_cal.identification.descent import PredictedSystem, minimise
from parallel_cal.identification.error_jacobians import differentiate_errors
from parallel_cal.identification.estimate import Estimate, EstimationProblem
from parallel_cal.identification.explicit import Prediction
from parallel_cal.identification.linearisation import Linearisation, System
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.prediction_errors import PoseErrors
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


def minimise_pose_errors(model: Model, observations: Observations, free: np.ndarray) -> Model:
    """Find the `free` parameters (mask) for which the poses that were measured, or that images
    show, are nearest to the predicted ones.

    A fit weights errors by the noise of joints and poses. Frames alone cannot remove the errors of
    a robot, which are no noise. What remains after them is stated as an error of the poses, so it
    is this error that they minimise: no other frames leave a smaller one.

    The sum of squares of position errors, and of orientation errors times the mechanism's length,
    is minimised over the samples whose error the model knows at its start. Directions that these
    errors do not show stay. FitError without convergence.
    """
    scale = np.repeat([1.0, model.mechanism.length], 3)
    linearise = Linearisation(model, observations, free, weighted=False)
    known = np.zeros(0, dtype=bool)

    def reach(values: np.ndarray, before: System | None, step: np.ndarray) -> System | None:
        nonlocal known
        here = model.with_values(values)
        found = PoseErrors.of(here, observations)
        errors = np.hstack([found.position, found.orientation]) * scale
        if before is None:
            known = np.isfinite(errors) & found.pose.solved[:, None]
        elif not np.isfinite(errors[known]).all():
            return None
        x = np.where(np.isfinite(found.configurations), found.configurations, observations.x)
        _, rows, by_free = linearise.blocks(values, x)
        by = differentiate_errors(here, observations, rows, by_free, found.shown)
        J = np.hstack([by[kind].by_parameter for kind in ("position", "orientation")])
        J = np.where(known[:, :, None], -J * scale[:, None], 0.0)
        errors = np.where(known, errors, 0.0)
        unit = np.broadcast_to(np.eye(6), (len(errors), 6, 6))
        return PredictedSystem(errors, J, known.sum(axis=1), raw=errors, whitener=unit)

    problem = EstimationProblem(model, free, None, assumed=True)
    advice = "is the starting model of the right robot?"
    return model.with_values(minimise(problem, reach, advice).values, model.covariance)
