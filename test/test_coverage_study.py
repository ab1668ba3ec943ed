"""The intervals of a fit, counted in simulated sessions: the study and its table."""

import numpy as np
import pytest

from bench import coverage
from bench.foreign_five_bar import position


def test_the_page_shows_the_table_of_the_kept_sessions():
    page = coverage.PAGE.read_text(encoding="utf-8")
    table = coverage.make_table(coverage.read_study())
    assert f"{coverage.START}\n\n{table}\n\n{coverage.END}" in page


def test_a_row_counts_the_sessions_that_count():
    kept = [coverage.Outcome("search", k, held) for k, held in enumerate([True, False, None])]
    row = coverage.make_table(kept).splitlines()[-1]
    assert row.endswith("| 2 of 3 | 50.0% (1.3%..98.7%) |  |")


def test_the_robot_of_the_study_stands_where_its_cranks_say():
    drawn = np.array([[-0.05, 0.0, 0.1, 0.15, 0.0], [0.05, 0.0, 0.1, 0.15, 0.0]])
    upright = position(drawn, np.full((1, 2), np.pi / 2))
    # Elbows 0.1 m apart at a height of 0.1 m, rods of 0.15 m: sqrt(0.15^2 - 0.05^2) above them.
    assert upright[0] == pytest.approx([0, 0.1 + np.sqrt(0.02)])


def test_a_session_is_the_same_again_and_its_sigmas_are_those_of_its_noise():
    outcomes = [
        coverage.with_stated_noise("stated", 11, np.random.default_rng([coverage.SEED, 11]))
        for _ in range(2)
    ]
    assert outcomes[0] == outcomes[1]
    assert outcomes[0].of == 10
    assert outcomes[0].parameters >= 8
