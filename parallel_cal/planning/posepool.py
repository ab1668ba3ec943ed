"""Draw poses that a robot can measure: in the workspace, inside joint limits, away from
singularities, with an approach if the model needs one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.kinematics.contacts import spread_over_contacts
from parallel_cal.kinematics.kinematics import Kinematics, Solutions
from parallel_cal.kinematics.singularity import distances
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import Model
from parallel_cal.planning.approach import (
    POSE_TOLERANCE,
    Approaches,
    approaches,
    fill,
    needs_approach,
)

CLEARANCE = 0.2  # of home's distance from a singularity: nearer poses are not used
FOLD = 3


@dataclass(frozen=True)
class Pool:
    """K groups of poses that are selected together: one pose each, or a symmetric set.

    groups (K, size) indexes poses; a (N, n_conditions) are the conditions of each pose; `approach`
    says how the robot reaches it, None if that does not matter.
    """

    poses: Solutions
    groups: np.ndarray
    a: np.ndarray
    approach: Approaches | None

    def rows(self, index: np.ndarray) -> Pool:
        """Some poses, each its own group."""
        approach = None if self.approach is None else self.approach[index]
        return Pool(self.poses[index], np.arange(len(index))[:, None], self.a[index], approach)

    def lengthen_approach(self, model: Model, least: np.ndarray | float) -> Pool:
        """The pool with approaches of at least this length (nq,), from the same side."""
        if self.approach is None:
            return self
        travels, a = self.approach.ways, self.a.copy()
        travels = np.copysign(np.maximum(np.abs(travels), least), travels)
        fill(a, model, travels)
        return replace(self, a=a, approach=replace(self.approach, ways=travels))


def make_pool(
    model: Model,
    n: int,
    rng: np.random.Generator,
    symmetric: bool,
    reach: float = 1.0,
    least_travels: np.ndarray | float = 0.0,
    in_contact: bool = False,
) -> Pool:
    """Draw about n poses in the workspace, or in a box `reach` times as large; keep the usable
    ones. Each joint approaches over more than `least_travels` (nq,), if the model needs an
    approach."""
    m = model.mechanism
    middle = np.add(m.workspace.low, m.workspace.high) / 2
    r, R = m.poses(middle + reach * (m.sample(n, rng) - middle))
    if symmetric:
        check_symmetric(model)
        r, R = rotate_about_z(r[: -(-n // FOLD)], R[: -(-n // FOLD)])
    # Quick: the pool is large, so a pose that is not solved at the first attempt is dropped.
    poses = Kinematics(model, quick=True).inverse(r, R)
    if in_contact:
        poses = poses[np.flatnonzero(poses.ok)]
        poses = spread_over_contacts(model, poses, model.condition_rows(None, len(poses)))[0]
    # Something on the table may stand beside the workspace: joint limits decide.
    good = find_usable_poses(model, poses, np.inf if in_contact else reach)
    approach = None
    if needs_approach(model):
        approach = approaches(model, poses, rng, reach, good, least_travels)
        good &= approach.ok
    size = FOLD if symmetric else 1
    kept = np.flatnonzero(good.reshape(-1, size).all(axis=1))
    if not len(kept):
        raise FitError(
            f"none of {len(r)} poses in the workspace is reachable inside the joint limits and "
            "away from singularities; make the workspace in the model file smaller"
        )
    rows = (kept[:, None] * size + np.arange(size)).ravel()
    groups = np.arange(len(rows)).reshape(-1, size)
    return _pool(model, poses[rows], groups, None if approach is None else approach[rows])


def given_pool(model: Model, poses: Solutions, rng: np.random.Generator) -> Pool:
    """Keep the usable ones of given poses."""
    kept = poses[np.flatnonzero(find_usable_poses(model, poses))]
    approach = approaches(model, kept, rng) if needs_approach(model) else None
    if approach is not None:
        reached = np.flatnonzero(approach.ok)
        kept, approach = kept[reached], approach[reached]
    return _pool(model, kept, np.arange(len(kept))[:, None], approach)


def _pool(model: Model, poses: Solutions, groups: np.ndarray, approach: Approaches | None) -> Pool:
    """Make a pool under neutral conditions, except for those that the approach causes."""
    a = model.condition_rows(None, len(poses))
    if approach is not None:
        fill(a, model, approach.ways)
    return Pool(poses, groups, a, approach)


def find_usable_poses(model: Model, poses: Solutions, reach: float = 1.0) -> np.ndarray:
    """Return the mask (N,) of the poses that forward and inverse kinematics solve on home's branch,
    inside workspace (`reach` times as large) and joint limits, with no singularity near the pose
    or between it and home."""
    back = Kinematics(model).direct(np.where(poses.ok[:, None], poses.joints, np.nan))
    agree = np.abs(back.position - poses.position).max(axis=1) < POSE_TOLERANCE
    return (
        poses.ok
        & back.ok
        & agree
        & find_inside_poses(model, poses, reach)
        & find_clear_poses(model, poses)
    )


def find_clear_poses(model: Model, poses: Solutions) -> np.ndarray:
    """Return the mask (N,) of the poses that are on home's side of both singularities, and further
    from them than CLEARANCE times home's distance."""
    home = distances(model, Kinematics(model).direct(np.array([model.mechanism.home.joints])))
    here = distances(model, poses)
    far = (here.direct > CLEARANCE * home.direct) & (here.inverse > CLEARANCE * home.inverse)
    same = (here.direct_sign == home.direct_sign) & (here.inverse_sign == home.inverse_sign)
    return np.asarray(far & same)


def find_inside_poses(model: Model, poses: Solutions, reach: float = 1.0) -> np.ndarray:
    """Return the mask (N,) of the poses with controlled coordinates inside the workspace's box,
    `reach` times as large."""
    m = model.mechanism
    low, high = np.array(m.workspace.low), np.array(m.workspace.high)
    here = m.controlled_coordinates(poses.position, poses.rotation)
    away = np.abs(here - (low + high) / 2)
    return np.asarray((away <= reach * (high - low) / 2 + POSE_TOLERANCE).all(axis=1))


def rotate_about_z(r: np.ndarray, R: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return every pose followed by its copies turned about z: (3 N, 3), (3 N, 3, 3)."""
    w = np.zeros((FOLD, 3))
    w[:, 2] = 2 * np.pi / FOLD * np.arange(FOLD)
    T = rotation_matrix(w)
    turned = T[None] @ R[:, None] @ T[None].transpose(0, 1, 3, 2)
    return (T[None] @ r[:, None, :, None]).reshape(-1, 3), turned.reshape(-1, 3, 3)


def check_symmetric(model: Model) -> None:
    """FitError unless a third of a turn about z merely exchanges the joints of the nominal
    robot."""
    m = model.mechanism
    r, R = rotate_about_z(*poses_in_workspace(m, 5, np.random.default_rng(0)))
    nominal = model.with_values(model.table.nominal)
    joints = Kinematics(nominal).inverse(r, R).joints
    sets = joints.reshape(-1, FOLD, len(m.joints))
    if len(m.joints) % FOLD == 0:
        shift = len(m.joints) // FOLD
        for step in (shift, -shift):
            if np.allclose(np.roll(sets[:, 0], step, axis=1), sets[:, 1], atol=POSE_TOLERANCE):
                return
    raise FitError(f"{m.name} is not symmetric: a third of a turn about z changes its joints")
