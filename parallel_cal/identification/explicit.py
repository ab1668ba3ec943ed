"""Solve the closure for some coordinates, for forward and inverse calibration."""

from __future__ import annotations

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.identification.descent import PredictedSystem, check_measured, minimise
from parallel_cal.identification.estimate import Estimate, EstimationProblem
from parallel_cal.identification.linearisation import Linearisation
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.prior import Prior
from parallel_cal.identification.thresholds import (
    MIN_DIRECT_SINGULAR_VALUE_RATIO,
    NEWTON_STEP,
    RELATIVE_RANK,
)
from parallel_cal.model.mechanism import POSE
from parallel_cal.model.model import Model


class Prediction:
    """Measured minus predicted `unknown` coordinates, given the others, in noise units.

    With the closure's blocks C (d/d configuration) and J (d/d parameters) at the solution,
    du = -C_u^-1 (C_g dg + J dv): noise S of (g, u) reaches the residual as T S T^T with
    T = C_u^-1 C. Starting Newton's method at the measured u keeps the robot's branch.
    Samples are excluded if the starting model has no solution, or is singular, there.
    """

    def __init__(self, model: Model, observations: Observations, free: np.ndarray, direct: bool):
        m, n = model.mechanism, len(model.joints)
        moving, joints = [n + i for i in m.moved], list(range(n))
        parasitic = [n + i for i in m.parasitic]
        self.unknown = np.array((moving if direct else joints + parasitic) + m.passive_columns)
        self.given = np.array(joints if direct else [n + i for i in m.controlled])
        names = [*model.joints, *POSE]
        method = "forward" if direct else "inverse"
        check_measured(observations, self.given, [names[c] for c in self.given], method)
        self._model, self._free = model, free
        self._scale = model.structure.scale[self.unknown]
        self._use_observations(observations)
        # Use the samples that the starting model solves away from singularities. Judge both the
        # solution and the measured configuration: a solution may lie across the singularity.
        _, solved, _, ok = self.solve(model.values)
        measured = self._closure.blocks(model.values, observations.x)[1]
        both = np.stack([solved, measured])[:, :, :, self.unknown] / self._scale
        size = np.linalg.svd(both, compute_uv=False)[:, :, -1].min(axis=0)
        ratio = MIN_DIRECT_SINGULAR_VALUE_RATIO if direct else RELATIVE_RANK
        used = np.asarray(ok & (size > ratio * size.max()))
        if not used.any():
            raise FitError("the starting model solves no sample: is it of the right robot?")
        self._use_observations(observations.select(used))

    def _use_observations(self, observations: Observations) -> None:
        self._observations = observations
        self._closure = Linearisation(self._model, observations, self._free, True)
        self._last = observations.x.copy()

    def solve(self, values: np.ndarray) -> tuple[np.ndarray, ...]:
        """Configurations that close at the given coordinates, their blocks C and J, and a mask (N,)
        of success."""
        x = self._last.copy()
        for _ in range(20):
            phi, C, J = self._closure.blocks(values, x)
            step = -np.einsum("nij,nj->ni", np.linalg.pinv(C[:, :, self.unknown]), phi)
            size = np.abs(step * self._scale).max(axis=1)
            if not np.nanmax(size) > NEWTON_STEP:
                break
            change = np.zeros((len(x), C.shape[2]))
            change[:, self.unknown] = np.clip(step, -0.2 / self._scale, 0.2 / self._scale)
            x = self._model.configuration(x).apply_change(change).rows
        return x, C, J, size < 1e-9

    def __call__(self, values: np.ndarray) -> PredictedSystem | None:
        x, C, J, ok = self.solve(values)
        if not ok.all():
            return None
        self._last = x
        residual = self._closure.compute_adjustments(x)[:, self.unknown]
        inverse = np.linalg.pinv(C[:, :, self.unknown])
        # The noise of every measured coordinate counts, even of one that does not move.
        T = inverse @ C * self._observations.measured[:, None, :]
        W = T @ self._observations.S @ T.transpose(0, 2, 1)
        # Rows of unmeasured coordinates are zero; the others are in units of their noise.
        seen = self._observations.measured[:, self.unknown]
        W = np.where(seen[:, :, None] & seen[:, None, :], W, 0.0)
        W[:, range(W.shape[1]), range(W.shape[1])] += ~seen
        rows = np.concatenate([residual[:, :, None], inverse @ J], axis=2) * seen[:, :, None]
        L = np.linalg.cholesky(W)
        white = np.linalg.solve(L, rows)
        return PredictedSystem(
            white[:, :, 0], white[:, :, 1:], seen.sum(axis=1), raw=rows[:, :, 0], whitener=L
        )

    def minimise_residuals(self, prior: bool | Prior | None) -> Estimate:
        """Find the parameters that minimise the residuals; FitError without convergence."""
        return minimise(
            EstimationProblem(self._model, self._free, prior, self._observations.noise_assumed),
            lambda values, before, step: self(values),
            "leave out samples near singularities, or use the implicit method",
        )
