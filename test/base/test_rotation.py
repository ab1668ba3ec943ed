"""Rotations and quaternions at the border."""

import numpy as np
import pytest

from parallel_cal.base.rotation import (
    matrix_to_quaternion,
    quaternion_to_matrix,
    rotation_matrix,
    rotation_vector,
    turns_from_mean,
)
from parallel_cal.recordings.samples import mean_rotation
from parallel_cal.virtual import robot as vr

HALF_TURNS = [[np.pi, 0, 0], [0, np.pi, 0], [0, 0, np.pi], [3, 0, 0], [0, -3, 0], [0, 0.1, 3.1]]


def some_rotations():
    rng = np.random.default_rng(0)
    return vr.turn(np.concatenate([rng.normal(size=(200, 3)) * 2, np.zeros((1, 3)), HALF_TURNS]))


def test_one_matrix_and_many_give_the_same_quaternions_with_w_not_negative():
    R = some_rotations()
    many = matrix_to_quaternion(R)
    assert np.abs([matrix_to_quaternion(one) for one in R] - many).max() < 1e-15
    assert many[:, 3].min() >= 0
    assert np.abs(np.linalg.norm(many, axis=1) - 1).max() < 1e-15


def test_quaternions_and_vectors_lead_back_to_the_matrix():
    R = some_rotations()
    assert np.abs(quaternion_to_matrix(matrix_to_quaternion(R)) - R).max() < 1e-14
    assert np.abs(rotation_matrix(rotation_vector(R)) - R).max() < 1e-14


def test_a_quarter_turn_about_z_by_hand():
    q = matrix_to_quaternion(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]))
    assert q == pytest.approx([0, 0, np.sqrt(0.5), np.sqrt(0.5)])


def test_one_rotation_and_many_give_the_same_bits():
    """Nodes answer one at a time, and are held against what many at once give."""
    rng = np.random.default_rng(0)
    R = rotation_matrix(rng.standard_normal((2000, 3)) * rng.choice([1e-3, 1, 3], (2000, 1)))
    single = np.array([matrix_to_quaternion(one) for one in R])
    assert np.array_equal(matrix_to_quaternion(R), single)


def turns_about_z(*degrees):
    return rotation_matrix(np.outer(np.radians(degrees), [0.0, 0.0, 1.0]))


@pytest.mark.parametrize(
    ("degrees", "mean"),
    [
        # The chordal mean about one axis is the direction of the sum of the unit vectors.
        ([0, 0, 120], 30),  # (1 + 1 - 1/2, sqrt(3)/2) = (3/2, sqrt(3)/2); the geodesic mean is 40
        ([0, 90, 90], np.degrees(np.arctan2(2, 1))),
        ([179.9, -179.9], 180),
        ([170, -170, -160], -173.30),  # (-2.9093, -0.3420): by hand
    ],
)
def test_the_mean_of_orientations_that_are_far_apart_is_the_chordal_one(degrees, mean):
    away = turns_from_mean(turns_about_z(*degrees))
    about = np.radians(np.array(degrees) - mean)
    assert away[:, :2] == pytest.approx(0, abs=1e-12)
    assert away[:, 2] == pytest.approx(np.arctan2(np.sin(about), np.cos(about)), abs=1e-4)


def test_the_mean_of_turns_of_120_degrees_about_x_y_and_z_is_one_of_90_about_their_middle():
    """The sum of the three matrices is sin(120 deg) [1 1 1]x, which a rotation by theta about
    (1, 1, 1) meets with 2 sin(theta): best at 90 degrees. So does the eigenvector of the largest
    eigenvalue of sum q q^T, (1; n) with n = (1, 1, 1) / sqrt(3), since cos(45) = sin(45)."""
    turns = 2 * np.pi / 3 * np.eye(3)
    R = rotation_matrix(turns)
    middle = np.pi / 2 * np.ones(3) / np.sqrt(3)
    assert rotation_vector(mean_rotation(R)) == pytest.approx(middle)
    q = matrix_to_quaternion(R)
    eigenvector = np.linalg.eigh(q.T @ q)[1][:, -1]
    assert abs(eigenvector @ matrix_to_quaternion(rotation_matrix(middle))) == pytest.approx(1.0)
    # One of them is away from the mean by the product of the quaternions: cos(half) = (1/2 +
    # sqrt(3)/2 / sqrt(3)) / sqrt(2) = 1 / sqrt(2).
    assert np.linalg.norm(turns_from_mean(R), axis=1) == pytest.approx(np.pi / 2)


def test_the_mean_rotation_is_nearest_to_all_and_turns_with_them():
    rng = np.random.default_rng(3)
    R = rotation_matrix(rng.normal(size=(7, 3)))
    mean = mean_rotation(R)
    by, before = rotation_matrix([0.3, -2.0, 1.0]), rotation_matrix([1.0, 0.5, -0.2])
    assert mean_rotation(by @ R @ before) == pytest.approx(by @ mean @ before, abs=1e-12)
    near = rotation_matrix(1e-3 * rng.normal(size=(50, 3))) @ mean
    sizes = [np.sum((R - one) ** 2) for one in (mean, *near)]
    assert np.argmin(sizes) == 0
