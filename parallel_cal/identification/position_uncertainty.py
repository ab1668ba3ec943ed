"""Model uncertainty of the platform's position over the workspace."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from parallel_cal.base.threads import single_threaded
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.predictions import condition_columns
from parallel_cal.identification.registration import frames_of
from parallel_cal.identification.thresholds import RELATIVE_RANK
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.kinematics.solutions import Solutions
from parallel_cal.model.effect import CONDITIONS
from parallel_cal.model.mechanism import POSE
from parallel_cal.model.model import Model

MIN_SHAPE_POSES = 4  # with fewer, frames absorb everything
POSES_PER_AXIS = 7  # poses from one end of the workspace to the other
SEED = 0  # of the samples whose conditions the places of a map get
HOME_TOLERANCE = 1e-6  # rad: the workspace's middle orientation is then that of home


@dataclass(frozen=True)
class PositionUncertainty:
    """Platform positions (M, 3) m in {B}, and the covariance (M, 3, 3) that follows from the
    identified parameters; `across` names the coordinates that were varied, and `validity` says in
    words for which orientation and conditions it holds."""

    places: np.ndarray
    covariance: np.ndarray
    across: str
    validity: str

    @classmethod
    def of(cls, model: Model) -> PositionUncertainty | None:
        """Three grids through the middle of the workspace, at right angles; None if the model was
        not identified or controls fewer than two coordinates of a position."""
        if model.covariance is None or (solved := solve_middle_planes(model)) is None:
            return None
        spread = Kinematics(model.robot()).direct_covariance(solved)[:, :3, :3]
        return cls(solved.position, spread, _controlled_axes(model), _describe_validity(model))


@dataclass(frozen=True)
class PositionDifference:
    """Where two models place the target at the same joints, as the measuring device sees it.

    `places` (M, 3) m in {B} are those of the platform by the first model, `difference` (M, 3) m is
    the second minus the first in its {B}. Each fit places {B} anew in the frame of the device:
    `frames_apart` (m) is the rms difference of the positions in {B} that this alone causes.
    `sigmas` are the rms uncertainties of both, m (None: not identified). `validity` says in words
    for which orientation and conditions it holds.
    """

    places: np.ndarray
    difference: np.ndarray
    frames_apart: float
    sigmas: tuple[float | None, float | None]
    validity: str

    @classmethod
    @single_threaded()
    def of(
        cls, first: Model, second: Model, recorded: Mapping[str, np.ndarray] | None = None
    ) -> PositionDifference | None:
        """On the planes of `solve_middle_planes`; None if the models reach no common pose there.

        Each place gets the conditions of one sample, drawn at random with a fixed seed from those
        `recorded`: columns (N,) by name. Conditions that were not recorded are neutral.
        """
        if (grid := solve_middle_planes(first)) is None:
            return None
        kinds = [kind for model in (first, second) for kind in find_robot_conditions(model)]
        columns = {k: v for k, v in (recorded or {}).items() if k.partition(".")[0] in kinds}
        at: dict[str, np.ndarray] = {}
        if columns:
            count = len(next(iter(columns.values())))
            rows = np.random.default_rng(SEED).integers(count, size=len(grid))
            at = {name: np.asarray(values)[rows] for name, values in columns.items()}
        robots = first.robot(), second.robot()
        reached = [Kinematics(robot).direct(grid.joints, at) for robot in robots]
        both = reached[0].solved & reached[1].solved
        if not both.any():
            return None
        one, other = (solutions[both] for solutions in reached)
        at = {name: values[both] for name, values in at.items()}
        sigmas = (_compute_sigma(first, one, at), _compute_sigma(second, other, at))
        validity = _describe_validity(first, second, recorded=list(columns))
        frames = frames_of(first), frames_of(second)
        seen = [f.see(s.position, s.rotation)[0] for s, f in zip((one, other), frames, strict=True)]
        difference = (seen[1] - seen[0]) @ frames[0].F.T
        moved = np.linalg.norm(other.position - one.position - difference, axis=1)
        apart = float(np.sqrt(np.mean(moved**2)))
        return cls(one.position, difference, apart, sigmas, validity)


def _compute_sigma(model: Model, solved: Solutions, at: Mapping[str, np.ndarray]) -> float | None:
    """Compute the rms uncertainty (m) of the positions predicted under the conditions `at`."""
    if model.covariance is None:
        return None
    spread = Kinematics(model.robot()).direct_covariance(solved, at)[:, :3, :3]
    return float(np.sqrt(np.mean(np.trace(spread, axis1=1, axis2=2))))


def find_robot_conditions(model: Model) -> list[str]:
    """Return the kinds of conditions, such as `direction`, on which the robot's own effects
    depend."""
    needs = (need for e in model.effects if not e.of_device for need in e.needs)
    return list(dict.fromkeys(need.partition(".")[0] for need in needs))


def _describe_validity(*models: Model, recorded: Sequence[str] = ()) -> str:
    """Say in words for which orientation and conditions a map of `solve_middle_planes` holds; empty
    if it depends on neither."""
    m, parts = models[0].mechanism, []
    if set(POSE[3:]) & set(m.controls):
        middle = np.add(m.workspace.low, m.workspace.high) / 2
        home = np.array([*m.home.position, *m.home.rotation_vector])[m.controlled]
        _, R = m.poses(np.array([middle, home]))
        at_home = np.allclose(R[0], R[1], rtol=0, atol=HOME_TOLERANCE)
        parts.append("in home orientation" if at_home else "in the workspace's middle orientation")
    kinds = list(dict.fromkeys(kind for model in models for kind in find_robot_conditions(model)))
    drawn = {name.partition(".")[0] for name in recorded}
    if given := [kind for kind in kinds if kind in drawn]:
        *others, last = given
        named = f"{', '.join(others)} and {last}" if others else last
        parts.append(f"each place with the {named} of a sample drawn at random")
    if neutral := [kind for kind in kinds if kind not in drawn]:
        parts.append(f"at neutral conditions ({', '.join(map(_describe_neutral, neutral))})")
    return ", ".join(parts)


def _describe_neutral(kind: str) -> str:
    unit, value, _ = CONDITIONS[kind]
    return f"{kind} {value:g} {unit}" if value else f"{kind} 0"


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
    moved = model.mechanism.moved
    reached = Kinematics(model).direct(joints, at)
    solved = np.flatnonzero(reached.solved)
    if len(solved) < MIN_SHAPE_POSES:
        return None
    rows = reached.configuration.rows[solved]
    a = model.condition_rows(at, len(joints))[solved]
    C, J = model.structure.jacobians(rows, a, model.values)
    by = np.zeros((len(solved), 6, J.shape[2]))
    follows = -np.linalg.pinv(C[:, :, model.mechanism.dependent_columns]) @ J
    by[:, moved] = follows[:, : len(moved)]
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
