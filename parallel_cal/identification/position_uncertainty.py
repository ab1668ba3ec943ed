"""Model uncertainty of the platform's position over the workspace."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from parallel_cal.base.threads import single_threaded
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.predictions import condition_columns
from parallel_cal.identification.thresholds import RELATIVE_RANK
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.kinematics.solutions import Solutions
from parallel_cal.model.mechanism import POSE
from parallel_cal.model.model import Model

MIN_SHAPE_POSES = 4  # with fewer, frames absorb everything
POSES_PER_AXIS = 7  # poses from one end of the workspace to the other


@dataclass(frozen=True)
class PositionUncertainty:
    """Platform positions (M, 3) m in {B}, and the covariance (M, 3, 3) that follows from the
    identified parameters; `across` names the coordinates that were varied."""

    places: np.ndarray
    covariance: np.ndarray
    across: str

    @classmethod
    def of(cls, model: Model) -> PositionUncertainty | None:
        """Three grids through the middle of the workspace, at right angles; None if the model was
        not identified or controls fewer than two coordinates of a position."""
        if model.covariance is None or (solved := solve_middle_planes(model)) is None:
            return None
        spread = Kinematics(model.robot()).direct_covariance(solved)[:, :3, :3]
        return cls(solved.position, spread, _controlled_axes(model))


@dataclass(frozen=True)
class PositionDifference:
    """Where two models place the platform at the same joints, under neutral conditions.

    `places` (M, 3) m in {B} are those of the first model, `difference` (M, 3) m is the second minus
    the first; `sigmas` are the rms uncertainties of both, m (None: not identified).
    """

    places: np.ndarray
    difference: np.ndarray
    sigmas: tuple[float | None, float | None]

    @classmethod
    @single_threaded()
    def of(cls, first: Model, second: Model) -> PositionDifference | None:
        """On the planes of `solve_middle_planes`; None if the models reach no common pose there."""
        if (grid := solve_middle_planes(first)) is None:
            return None
        reached = [Kinematics(model.robot()).direct(grid.joints) for model in (first, second)]
        both = reached[0].solved & reached[1].solved
        if not both.any():
            return None
        one, other = (solutions[both] for solutions in reached)
        sigmas = (_compute_sigma(first, one), _compute_sigma(second, other))
        return cls(one.position, other.position - one.position, sigmas)


def _compute_sigma(model: Model, solved: Solutions) -> float | None:
    """Compute the rms uncertainty (m) of the predicted positions."""
    if model.covariance is None:
        return None
    spread = Kinematics(model.robot()).direct_covariance(solved)[:, :3, :3]
    return float(np.sqrt(np.mean(np.trace(spread, axis1=1, axis2=2))))


def solve_middle_planes(model: Model) -> Solutions | None:
    """Solve the poses of a robot on three grids through the middle of its workspace, at right
    angles; None if it controls fewer than two coordinates of a position or reaches no pose."""
    mechanism = model.mechanism
    axes = [POSE.index(name) for name in _controlled_axes(model)]
    if len(axes) < 2:
        return None
    low, high = np.array(mechanism.workspace.low), np.array(mechanism.workspace.high)
    grids = []
    for one, other in ((a, b) for a in axes for b in axes if a < b):
        i, j = mechanism.controls.index(POSE[one]), mechanism.controls.index(POSE[other])
        grid = np.tile((low + high) / 2, (POSES_PER_AXIS**2, 1))
        grid[:, [i, j]] = np.stack(
            np.meshgrid(*np.linspace(low[[i, j]], high[[i, j]], POSES_PER_AXIS).T), axis=-1
        ).reshape(-1, 2)
        grids.append(grid)
    poses = mechanism.poses(np.unique(np.vstack(grids), axis=0))
    found = Kinematics(model.robot()).inverse(*poses)
    solved = found[found.solved]
    return solved if len(solved) else None


def compute_shape_sigma(model: Model, observations: Observations) -> float | None:
    """Compute the rms uncertainty (m) of the positions at the measured joints, without what the
    frames of base and platform can absorb: it does not depend on where these frames were put. None
    if the model was not identified, or reaches fewer than four poses."""
    joints = observations.x[:, : len(model.joints)]
    spread = compute_shape_covariance(model, joints, condition_columns(model, observations))
    if spread is None:
        return None
    return float(np.sqrt(np.nanmean(np.trace(spread, axis1=1, axis2=2))))


def compute_shape_covariance(
    model: Model, joints: np.ndarray, at: Mapping[str, Any] | None = None
) -> np.ndarray | None:
    """Compute the covariance (N, 3, 3), m^2, of the positions at the joints (N, nq) under the
    conditions `at`, without what the frames of base and platform can absorb: that of the position
    of each pose after the frames were put where all of these poses fit best. NaN where the model
    reaches no pose. None if the model was not identified, or reaches fewer than four poses."""
    if model.covariance is None:
        return None
    n, moved = len(model.joints), model.mechanism.moved
    reached = Kinematics(model).direct(joints, at)
    solved = np.flatnonzero(reached.solved)
    if len(solved) < MIN_SHAPE_POSES:
        return None
    rows = reached.configuration.rows[solved]
    a = model.condition_rows(at, len(joints))[solved]
    C, J = model.structure.jacobians(rows, a, model.values)
    by = np.zeros((len(solved), 6, J.shape[2]))
    by[:, moved] = -np.linalg.pinv(C[:, :, [n + i for i in moved]]) @ J
    G = by[:, :3].reshape(-1, J.shape[2])
    x, y, z = reached.position[solved].T
    none = np.zeros(len(solved))
    turns = np.moveaxis(np.array([[none, z, -y], [-z, none, x], [y, -x, none]]), -1, 0)
    ones = np.tile(np.eye(3), (len(solved), 1, 1))
    frames = np.concatenate([ones, turns, reached.rotation[solved]], axis=2).reshape(-1, 9)
    left, sizes, _ = np.linalg.svd(frames, full_matrices=False)
    basis = left[:, sizes > RELATIVE_RANK * sizes[0]]
    remaining = (G - basis @ (basis.T @ G)).reshape(-1, 3, J.shape[2])
    spread = np.full((len(joints), 3, 3), np.nan)
    spread[solved] = remaining @ np.asarray(model.covariance) @ remaining.transpose(0, 2, 1)
    return spread


def _controlled_axes(model: Model) -> str:
    return "".join(name for name in POSE[:3] if name in model.mechanism.controls)
