"""Joints and pose together, with numbers worked by hand."""

import numpy as np
import pytest

from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.model.configuration import Configuration

QUARTER = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # a quarter turn about z


def test_a_row_holds_joints_position_and_the_rotation_row_by_row():
    one = Configuration(np.array([7.0, 8.0]), np.array([1.0, 2.0, 3.0]), QUARTER)
    assert one.rows.tolist() == [7, 8, 1, 2, 3, 0, -1, 0, 1, 0, 0, 0, 0, 1]
    back = Configuration.from_rows(np.stack([one.rows, one.rows + 1]))
    assert back.q.tolist() == [[7, 8], [8, 9]]
    assert back.r.tolist() == [[1, 2, 3], [2, 3, 4]]
    assert np.array_equal(back.R, [QUARTER, QUARTER + 1])


def test_one_part_provides_for_several_others():
    r = np.arange(6.0).reshape(2, 3)
    rows = Configuration(np.array([7.0]), r, np.eye(3)).rows
    assert rows.tolist() == [[7, *r[0], *np.eye(3).ravel()], [7, *r[1], *np.eye(3).ravel()]]


def test_a_change_turns_about_the_bases_axes():
    """Half a turn about the base's x takes the platform's x axis, along y, to -y."""
    one = Configuration(np.array([1.0]), np.zeros(3), QUARTER)
    moved = one.apply_change(np.array([0.5, 1, 2, 3, np.pi, 0, 0]))
    assert moved.q.tolist() == [1.5]
    assert moved.r.tolist() == [1, 2, 3]
    np.testing.assert_allclose(moved.R, [[0, -1, 0], [-1, 0, 0], [0, 0, -1]], atol=1e-15)


def test_the_change_between_two_configurations_moves_one_to_the_other():
    rng = np.random.default_rng(0)
    here, there = (
        Configuration(rng.normal(size=(5, 2)), rng.normal(size=(5, 3)), rotation_matrix(w))
        for w in rng.normal(size=(2, 5, 3))
    )
    assert here.apply_change(there.change_from(here)).rows == pytest.approx(there.rows, abs=1e-14)
