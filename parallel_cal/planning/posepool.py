"""Poses that a robot could measure: in the workspace, inside limits, away from singularities."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.base.rotation import rotation_matrix, rotation_vector
from parallel_cal.kinematics.kinematics import Kinematics, Solutions
from parallel_cal.kinematics.singularity import distances
from parallel_cal.model.mechanism import poses_in_workspace
from parallel_cal.model.model import Model

CLEARANCE = 0.2  # of home's distance from a singularity; nearer ones are not measured at
FOLD = 3
SAME = 1e-6  # m and rad


@dataclass(frozen=True)
class Pool:
    """K groups of poses that are chosen together: one pose each, or a symmetric set.

    groups (K, size) indexes poses; a (N, n_conditions) is what each is measured under.
    """

    poses: Solutions
    groups: np.ndarray
    a: np.ndarray


def make_pool(model: Model, n: int, rng: np.random.Generator, symmetric: bool) -> Pool:
    """About n poses drawn in the workspace, those kept that may be measured at."""
    r, R = poses_in_workspace(model.mechanism, n, rng)
    if symmetric:
        check_symmetric(model)
        r, R = turned_about_z(r[: -(-n // FOLD)], R[: -(-n // FOLD)])
    poses = Kinematics(model).inverse(r, R)
    good = usable(model, poses)
    size = FOLD if symmetric else 1
    kept = np.flatnonzero(good.reshape(-1, size).all(axis=1))
    if not len(kept):
        raise FitError(
            f"none of {len(r)} poses in the workspace is reachable inside the joint limits and "
            "away from singularities; make the workspace in the model file smaller"
        )
    rows = (kept[:, None] * size + np.arange(size)).ravel()
    a = conditions(model, len(rows), rng)
    return Pool(poses[rows], np.arange(len(rows)).reshape(-1, size), a)


def given_pool(model: Model, poses: Solutions, rng: np.random.Generator) -> Pool:
    """The usable ones of given poses."""
    kept = poses[np.flatnonzero(usable(model, poses))]
    return Pool(kept, np.arange(len(kept))[:, None], conditions(model, len(kept), rng))


def usable(model: Model, poses: Solutions) -> np.ndarray:
    """Mask (N,): solved both ways on home's branch, inside workspace and joint limits, no
    singularity near nor between the pose and home."""
    back = Kinematics(model).direct(np.where(poses.ok[:, None], poses.joints, np.nan))
    agree = np.abs(back.position - poses.position).max(axis=1) < SAME
    return poses.ok & back.ok & agree & inside(model, poses) & clear(model, poses)


def clear(model: Model, poses: Solutions) -> np.ndarray:
    """Mask (N,): as far from both singularities as CLEARANCE of home's distance, on its side."""
    home = distances(model, Kinematics(model).direct(np.array([model.mechanism.home.joints])))
    here = distances(model, poses)
    far = (here.direct > CLEARANCE * home.direct) & (here.inverse > CLEARANCE * home.inverse)
    same = (here.direct_sign == home.direct_sign) & (here.inverse_sign == home.inverse_sign)
    return np.asarray(far & same)


def inside(model: Model, poses: Solutions) -> np.ndarray:
    """Mask (N,): controlled coordinates inside the workspace's box."""
    m = model.mechanism
    x = np.concatenate([poses.position, rotation_vector(poses.rotation)], axis=1)
    low, high = np.array(m.workspace.low) - SAME, np.array(m.workspace.high) + SAME
    return np.asarray(((x[:, m.controlled] >= low) & (x[:, m.controlled] <= high)).all(axis=1))


def conditions(model: Model, n: int, rng: np.random.Generator) -> np.ndarray:
    """(n, n_conditions): neutral, but each joint's approach from either side at random."""
    a = model.condition_rows(None, n)
    for k, name in enumerate(model.conditions):
        if name.startswith("direction."):
            a[:, k] = rng.choice([-1.0, 1.0], n)
    return a


def turned_about_z(r: np.ndarray, R: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every pose and its copies turned about z, one after another: (3 N, 3), (3 N, 3, 3)."""
    w = np.zeros((FOLD, 3))
    w[:, 2] = 2 * np.pi / FOLD * np.arange(FOLD)
    T = rotation_matrix(w)
    turned = T[None] @ R[:, None] @ T[None].transpose(0, 1, 3, 2)
    return (T[None] @ r[:, None, :, None]).reshape(-1, 3), turned.reshape(-1, 3, 3)


def check_symmetric(model: Model) -> None:
    """FitError unless a third of a turn about z merely exchanges the joints of the nominal
    robot."""
    m = model.mechanism
    r, R = turned_about_z(*poses_in_workspace(m, 5, np.random.default_rng(0)))
    nominal = model.with_values(model.table.nominal)
    joints = Kinematics(nominal).inverse(r, R).joints
    sets = joints.reshape(-1, FOLD, len(m.joints))
    if len(m.joints) % FOLD == 0:
        shift = len(m.joints) // FOLD
        for way in (shift, -shift):
            if np.allclose(np.roll(sets[:, 0], way, axis=1), sets[:, 1], atol=SAME):
                return
    raise FitError(f"{m.name} is not symmetric: a third of a turn about z changes its joints")
