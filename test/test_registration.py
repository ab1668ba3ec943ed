"""A device that stands anywhere, before platforms that hardly turn: no pose tells of its target."""

from dataclasses import replace

import numpy as np
import pytest
from datasets import measured, quiet

from parallel_cal.base.rotation import nearest_rotation, rotation_matrix
from parallel_cal.identification.fit import fit
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import new_model
from parallel_cal.model.shelf import load_sensor

SHIFT, TURN = np.array([1.2, -1.4, 0.3]), rotation_matrix(np.array([0.3, -0.2, 2.0]))


def seen_by_a_tracker(data, target=(0.0, 0.0, 0.0), turned=(0.0, 0.0, 0.0)):
    """The same poses in a frame of its own, of a target put anywhere."""
    r = (data.r + data.R @ np.array(target) - SHIFT) @ TURN
    return replace(data, r=r, R=TURN.T @ data.R @ rotation_matrix(np.array(turned)), frame="far")


def error_at_unseen_poses(model):
    """Rms distance (m) of the robot alone from the virtual one, moved upon each other."""
    fresh = measured(2, noise=quiet())
    ours = Kinematics(model.robot()).direct(fresh.q).position
    ours, theirs = ours - ours.mean(axis=0), fresh.r - fresh.r.mean(axis=0)
    away = theirs - ours @ nearest_rotation(ours.T @ theirs)
    return np.sqrt(np.mean(np.sum(away**2, axis=1)))


@pytest.mark.parametrize(
    "turned", [(0, 0, 0), pytest.param((0.1, 0.4, -0.2), marks=pytest.mark.wide)]
)
def test_a_delta_before_a_tracker_that_stands_anywhere_is_as_good_as_before_its_own(turned):
    data = measured(1)
    own = error_at_unseen_poses(fit(new_model("delta54"), data, hold_out=0).model)
    found = fit(new_model("delta54"), seen_by_a_tracker(data, turned=turned), hold_out=0)
    assert own < 10e-6
    assert error_at_unseen_poses(found.model) < own + 2e-6
    where = found.registration
    assert np.abs(np.array(where.position) - SHIFT).max() < 5e-3
    assert np.abs(np.array(where.target_position)).max() < 1e-3
    assert "does not turn enough to tell" in where.words


def test_a_target_that_is_stated_is_where_it_is_stated():
    target = (0.05, 0.02, -0.03)
    device = load_sensor("device_frame", target_position=target)
    data = replace(seen_by_a_tracker(measured(1), target), frame="")
    found = fit(new_model("delta54").with_sensors((device,)), data, hold_out=0)
    assert error_at_unseen_poses(found.model) < 12e-6
    assert np.abs(np.array(found.registration.target_position) - target).max() < 2e-3
