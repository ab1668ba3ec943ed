"""Where {B} lies after poses in a device's own frame, which do not determine it."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from parallel_cal.base.rotation import nearest_rotation, rotation_matrix, rotation_vector
from parallel_cal.identification.fit import fit
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import Noise, new_model
from parallel_cal.recordings.dataset import Dataset

NOISE = Noise(1e-6, 5e-6, 2e-5)
TARGET, TARGET_TURN = np.array([0.03, 0.01, 0.05]), rotation_matrix(np.array([0.1, 0.0, 0.05]))
POSITION, TURN = np.array([1.2, -0.7, 0.4]), rotation_matrix(np.array([0.3, -0.2, 2.0]))


def drawn():
    return replace(new_model("stewart42"), noise=NOISE)


def built(seed):
    """A hexapod whose parts deviate from the drawing by half a tolerance."""
    model = drawn()
    away = 0.5 * model.table.tolerance * np.random.default_rng(seed).normal(size=len(model.values))
    return model.with_values(model.table.nominal + away)


def measured_by_a_tracker(robot, seed, n=60):
    """Samples of a robot in the frame of a tracker 1.4 m away, and the positions in {B}."""
    rng, mechanism = np.random.default_rng(seed), robot.mechanism
    reached = Kinematics(robot).inverse(*mechanism.poses(mechanism.sample(n, rng)))
    ok = reached.status == 0
    r, R = reached.position[ok], reached.rotation[ok]
    seen = (r + R @ TARGET - POSITION) @ TURN + NOISE.position * rng.normal(size=r.shape)
    noise = (rotation_matrix(NOISE.orientation * rng.normal(size=3)) for _ in r)
    seen_R = TURN.T @ R @ TARGET_TURN @ np.array(list(noise))
    q = reached.joints[ok] + NOISE.joint * rng.normal(size=(len(r), 6))
    return Dataset.from_arrays(mechanism.joints, q, seen, seen_R, frame="tracker"), r


@cache
def fitted_before_a_tracker(seed):
    """A hexapod before a tracker: the samples, and the fit of the drawn one."""
    data, _ = measured_by_a_tracker(built(seed), seed)
    return data, fit(drawn(), data, hold_out=0)


def base_balls(model):
    numbers = model.table.mapping(model.values)
    return np.array([[numbers[f"leg{i}.C_{c}"] for c in "xyz"] for i in range(1, 7)])


def tilt(one, other):
    """The angle (rad) of the best rigid motion between points (n, 3)."""
    moved = (other - other.mean(axis=0)).T @ (one - one.mean(axis=0))
    return np.linalg.norm(rotation_vector(nearest_rotation(moved)))


@pytest.mark.wide
@pytest.mark.parametrize("seed", [1, 4, 6])
def test_the_identified_base_lies_where_the_drawing_fits_best(seed):
    """It was tilted by 1.3 to 2.7 mrad, as the drawn robot was before the tracker."""
    _, result = fitted_before_a_tracker(seed)
    found = result.model
    assert tilt(base_balls(drawn()), base_balls(found)) < 0.2e-3


@pytest.mark.wide
def test_a_fit_states_the_change_of_the_poses_in_the_base_and_after_the_best_rigid_motion():
    data, result = fitted_before_a_tracker(1)
    joints = data.q
    before, after = (Kinematics(m).direct(joints) for m in (drawn(), result.model.robot()))
    motion = result.base_motion
    change = np.sqrt(np.mean(np.sum((after.position - before.position) ** 2, axis=1)))
    assert motion.change == pytest.approx(change, rel=1e-6)
    assert motion.change_of_shape < 0.5 * motion.change
    moved = after.position @ rotation_matrix(np.array(motion.rotation)).T + motion.position
    stated = before.position + before.rotation @ np.array(motion.platform_position)
    left = np.sqrt(np.mean(np.sum((moved - stated) ** 2, axis=1)))
    assert motion.change_of_shape == pytest.approx(left, rel=1e-6)
    assert motion.description in result.warnings
    assert "the origin of 'platform' of the identified robot is " in motion.description
    assert result.document()["base_motion"]["change"] == motion.change


@pytest.mark.wide
def test_fixed_features_tie_the_base_to_them():
    """Two legs' balls as drawn, and one more height: the tracker's frame follows from them."""
    features = ("leg1.C_*", "leg3.C_x", "leg3.C_z", "leg5.C_z")
    numbers = dict(zip(drawn().table.names, drawn().values, strict=True))
    robot = built(1)
    tied = robot.table.matching(features)
    robot = robot.with_values(np.where(tied, drawn().values, robot.values))
    data, r = measured_by_a_tracker(robot, 1)
    result = fit(drawn(), data, hold_out=0, fix=features)
    found = result.model.table.mapping(result.model.values)
    assert all(found[name] == numbers[name] for name in np.array(robot.table.names)[tied])
    reached = Kinematics(result.model.robot()).direct(data.q).position
    free = fit(drawn(), data, hold_out=0).model.robot()
    of_free = Kinematics(free).direct(data.q).position
    errors = [np.sqrt(np.mean(np.sum((p - r) ** 2, axis=1))) for p in (reached, of_free)]
    assert errors[0] < errors[1]
