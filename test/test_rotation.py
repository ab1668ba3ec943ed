"""Rotations and quaternions at the border."""

import numpy as np
import pytest

from parallel_cal.base.rotation import (
    matrix_to_quaternion,
    quaternion_to_matrix,
    rotation_matrix,
    rotation_vector,
)
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
