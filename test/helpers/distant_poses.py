"""Poses between which Newton's method may leave the joint limits."""

import numpy as np

from parallel_cal.kinematics.kinematics import Kinematics, Solutions
from parallel_cal.model.mechanism import poses_in_workspace


def distant_poses(kinematics: Kinematics, n: int) -> Solutions:
    """Draw poses all over the workspace; of Argos 27, which turns by more, at random joints."""
    rng, mechanism = np.random.default_rng(0), kinematics.model.mechanism
    if mechanism.name == "argos27":
        poses = kinematics.direct(rng.uniform(-0.75, 0.75, (n, 3)))
    else:
        poses = kinematics.inverse(*poses_in_workspace(mechanism, n, rng))
    assert poses.ok.all()
    return poses
