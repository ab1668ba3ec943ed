"""Datasets for tests: measured by the virtual robot, no file in between."""

import numpy as np
import virtual_day as vd

from parallel_cal.recordings.dataset import Dataset
from parallel_cal.virtual import argos as va
from parallel_cal.virtual import robot as vr

JOINTS = ("joint1", "joint2", "joint3")
JOINT_SIGMA = vr.THESIS_NOISE.joint


def measured(seed=0, *, robot=vr.MOCK_UP, noise=vr.THESIS_NOISE, effects=(), **session):
    """What the device of the thesis measures on a virtual Delta, as a Dataset."""
    return as_dataset(
        vd.dwell_samples(robot, seed=seed, noise=noise, effects=effects, **session), noise
    )


def as_dataset(samples, noise=vr.THESIS_NOISE, measured=None):
    n = len(samples["q"])
    cov = np.zeros((n, 6, 6))
    cov[:, range(6), range(6)] = [noise.position**2] * 3 + [noise.orientation**2] * 3
    conditions = {f"direction.{j}": samples["direction"][:, i] for i, j in enumerate(JOINTS)}
    return Dataset.from_arrays(
        JOINTS,
        samples["q"],
        samples["r"],
        samples["R"],
        measured=np.ones((n, 6), dtype=bool) if measured is None else measured,
        pose_cov=cov,
        joint_sigma=[noise.joint] * 3,
        conditions={"time": samples["time"], **conditions},
        pose_id=samples["pose_index"],
        source="virtual robot",
    )


def orientations():
    """Orientations alone, of the thesis' Argos in 40 poses."""
    rng, noise = np.random.default_rng(0), vr.Noise(5e-5, 5e-6, 3e-4)
    robot, home = va.Argos(va.spherical(va.TABLE_5_22)), va.Argos.home_turn
    q = np.radians(rng.uniform(-30, 30, (40, 3)))
    R = np.array([robot.orientation_at_origin(row, home) for row in q])
    dq, _, w = noise.draw(rng, len(q))
    return Dataset.from_arrays(
        JOINTS,
        q + dq,
        np.zeros((40, 3)),
        vr.turn(w) @ R,
        measured=np.tile([False] * 3 + [True] * 3, (40, 1)),
        pose_cov=np.diag([1.0] * 3 + [noise.orientation**2] * 3),
        joint_sigma=noise.joint,
    )


def redrawn(samples, seed, noise=vr.THESIS_NOISE):
    """The same session measured again: only the noise is new."""
    q, r, w = noise.draw(np.random.default_rng(seed), len(samples["q"]))
    return samples | {
        "q": samples["reading"] + q,
        "r": samples["true_r"] + r,
        "R": vr.turn(w) @ samples["true_R"],
    }


def quiet(factor=1e-6):
    """Next to no noise, in the thesis' proportions."""
    n = vr.THESIS_NOISE
    return vr.Noise(n.joint * factor, n.position * factor, n.orientation * factor)
