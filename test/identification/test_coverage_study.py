"""The intervals of a fit, counted in simulated sessions: the study and its table."""

import numpy as np
import pytest

from bench.truth import coverage
from bench.truth.foreign_five_bar import position
from parallel_cal.identification.fit import fit
from parallel_cal.model.model import new_model


def test_the_page_shows_the_table_of_the_kept_sessions():
    page = coverage.PAGE.read_text(encoding="utf-8")
    table = coverage.make_table(coverage.read_study())
    assert f"{coverage.START}\n\n{table}\n\n{coverage.END}" in page


def test_a_row_counts_the_sessions_that_count():
    kept = [coverage.Outcome("search", k, held) for k, held in enumerate([True, False, None])]
    [row] = [line for line in coverage.make_table(kept).splitlines() if "a search" in line]
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


def test_an_effect_that_is_zero_has_estimates_on_both_sides_of_zero():
    """Cut off at 0, its interval would begin at 0 in half of the sessions and hold it always."""
    widths = []
    for number in range(8):
        session = coverage.draw_session(np.random.default_rng([77, number]))
        result = fit(new_model("five_bar"), session.data, effects=["backlash"], hold_out=0)
        widths += [result.parameters()[f"backlash.{side}.width"] for side in ("left", "right")]
    z = np.array([one.value / one.sigma for one in widths])
    assert 4 <= np.sum(z < 0) <= 12
    assert np.std(z) == pytest.approx(1.0, abs=0.5)


@pytest.mark.parametrize("case", ["bound", "compliance"])
def test_the_interval_of_an_effect_that_is_zero_holds_zero(case):
    drawn = (coverage.CASES[case].run(case, k, np.random.default_rng([77, k])) for k in range(4))
    found = [(one.parameters, one.of) for one in drawn]
    inside, of = np.sum(found, axis=0)
    assert of == (8 if case == "bound" else 12)
    assert inside >= of - 2
