"""Describe the measured region, where a verdict holds, and the model uncertainty beyond it.

Touches of a bed have no measured positions. If they are all at one height, a verdict holds there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.diagnosis.thresholds import MIN_POSES_BEYOND_REGION, POOL
from parallel_cal.identification.fit import FitResult
from parallel_cal.identification.predictions import predict_positions
from parallel_cal.identification.registration import SENSOR, shows_pose
from parallel_cal.model.region import REGION_MARGIN
from parallel_cal.planning.expectation import prediction_blocks
from parallel_cal.planning.posepool import make_pool
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.samples import READING

TOUCH = READING + "probe"
AT_ONE_HEIGHT = " at the height of these touches"
TOUCH_A_BLOCK = (
    "touch the top of a block of known height on the bed, at several places and heights: touches "
    "of one plane hardly show errors that grow with the height, such as encoder_gain"
)


def is_of_touches(dataset: Dataset) -> bool:
    """Whether the samples are touches of a bed, at which no device measured a pose."""
    return TOUCH in dataset.conditions and not dataset.measured.any()


def is_touched_at_one_height(result: FitResult) -> bool:
    """Whether all that shows heights are touches of one plane, parallel to the bed or nearly so."""
    dataset, mechanism = result.dataset, result.model.mechanism
    heights = dataset.conditions.get(TOUCH, np.empty(0))
    heights = heights[np.isfinite(heights)]
    if not len(heights) or dataset.measured[..., 2].any() or shows_pose(result.model):
        return False
    tall = mechanism.workspace.high[2] - mechanism.workspace.low[2]
    return bool(np.ptp(heights) < REGION_MARGIN * abs(tall))


@dataclass(frozen=True)
class Region:
    """The box (m) of the measured positions, and the model uncertainty (rms position error in m)
    inside it and in the rest of the workspace."""

    low: np.ndarray
    high: np.ndarray
    inside: float
    beyond: float

    @classmethod
    def of(cls, result: FitResult) -> Region | None:
        """None if the whole workspace was measured, or the robot does not control positions."""
        model, axes = result.model, [k for k in result.model.mechanism.controlled if k < 3]
        n = len(model.joints)
        # In {B}: a device may measure in a frame of its own.
        seen = predict_positions(model, result.observations)
        shown = result.observations.measured[:, [n + k for k in axes]].all(axis=1)
        shown &= np.isfinite(seen).all(axis=1)
        if not axes or model.covariance is None or not shown.any():
            return None
        # The robot as it moves in {B}, wherever the device stands.
        robot = model.with_sensors(tuple(one for one in model.sensors if one.name != SENSOR))
        free = result.free[[model.table.index_of(name) for name in robot.table.names]]
        covariance = np.asarray(robot.covariance)
        low, high = seen[shown].min(axis=0), seen[shown].max(axis=0)
        try:
            pool = make_pool(robot, POOL, np.random.default_rng(0), symmetric=False)
        except FitError:
            return None
        away = np.abs(pool.poses.position - (low + high) / 2)[:, axes]
        outside = (away > (0.5 + REGION_MARGIN) * (high - low)[axes]).any(axis=1)
        if outside.sum() < MIN_POSES_BEYOND_REGION:
            return None
        G = prediction_blocks(robot, free, np.ones(len(robot.structure.scale), bool), pool)[:, :3]
        variance = np.einsum("nij,jk,nik->n", G, covariance[np.ix_(free, free)], G)
        inner, outer = (
            float(np.sqrt(np.mean(v))) if len(v) else 0.0
            for v in (variance[~outside], variance[outside])
        )
        return cls(low, high, inner, outer)

    @property
    def description(self) -> str:
        """`inside x -20..20, ... mm; the model uncertainty is ...`, after a space."""
        box = ", ".join(
            f"{axis} {1e3 * low:.0f}..{1e3 * high:.0f}"
            for axis, low, high in zip("xyz", self.low, self.high, strict=True)
        )
        return (
            f" inside {box} mm; the model uncertainty is {1e6 * self.inside:.0f} um inside and "
            f"{1e6 * self.beyond:.0f} um in the rest of the workspace"
        )
