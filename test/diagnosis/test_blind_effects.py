"""The table of the blind study of lines, struts and drives counts the outcomes beside the page."""

import dataclasses

import pytest

from bench.truth import new_effects as ne

PLAYED = ne.Case("stewart", "twisted struts", 0)
WELL = ne.Outcome(PLAYED, "explained", ("strut_rotation",), 20e-6, 3e-6, 3e-6)
EITHER = ne.Outcome(PLAYED, "explained", ("encoder_gain or strut_rotation",), 20e-6, 5e-6, 3e-6)
MISSED = ne.Outcome(PLAYED, "at_noise", ("backlash",), 20e-6, 20e-6, 3e-6)
NONE = ne.Outcome(ne.Case("stewart", "", 0), "at_noise", (), 3e-6, 3e-6, 3e-6)


def cells(outcomes):
    return [[c.strip() for c in line.split("|")[1:-1]] for line in ne.table_lines(outcomes)[2:]]


def test_the_page_shows_the_table_of_the_kept_outcomes():
    page = ne.PAGE.read_text(encoding="utf-8")
    outcomes = [*ne.kept(ne.STUDY).values()]
    lines = [*ne.table_lines(outcomes), "", *ne.total_lines(outcomes)]
    assert "\n".join([ne.START, "", *lines, "", ne.END]) in page


def test_a_row_counts_how_what_hides_was_named():
    nothing, struts = cells([WELL, EITHER, MISSED, NONE])
    assert struts[2:6] == ["3", "1", "1", "1"]
    assert struts[7] == "1"  # the backlash
    assert nothing[:6] == ["nothing", "hexapod", "1", "-", "-", "1"]


def test_the_totals_are_the_sums_of_the_rows():
    nothing, named = ne.total_lines([WELL, EITHER, MISSED, NONE])
    assert "named in 1 of 1 sessions that hid nothing, with 1 set-ups" in nothing
    assert (
        "Of 3 sessions that hid an effect, 1 named it alone, 1 in an `A or B`, and 1 did" in named
    )
    assert named.endswith("Other effects were named: 1.")


def test_errors_are_compared_with_the_best_possible_model():
    """3 and 5 um beside 3 and 3 um: sqrt(34 / 18)."""
    assert ne.ratio_to_best([WELL, EITHER]) == pytest.approx((34 / 18) ** 0.5)
    assert cells([WELL])[0][8:] == ["1", "20 -> 3 um", "1.00"]


def test_only_models_that_add_made_are_compared_with_the_best_one():
    refused = dataclasses.replace(EITHER, after=EITHER.before)
    assert ne.ratio_to_best([WELL, refused]) == pytest.approx(1)
    assert cells([WELL, refused])[0][8] == "1"


def test_the_first_round_has_five_draws_of_every_row_before_the_sixth_of_any():
    cases = ne.list_cases(6, ["twisted struts", "offset joints"])
    assert [c.seed for c in cases] == [*range(5), *range(5), 5, 5]


# One of each robot, of the robot or of its device; the others are checked at night.
TYPICAL = (
    *("cross-talk", "refraction", "leaning base", "pulleys"),
    *("heavy links", "late drives", "warm rods", "probe beside"),
)


@pytest.mark.wide
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[] if n in TYPICAL else pytest.mark.slow) for n in ne.KINDS]
)
def test_what_hides_moves_the_robot_unless_only_the_device_errs(name):
    kind = ne.KINDS[name]
    robot = ne.ROBOTS[kind.robots[0]]
    effect = ne.sized(robot, kind, 0)
    moved = ne.true_error(robot.model(), robot, [effect], 0)
    still = ne.true_error(robot.model(), robot, [], 0)
    assert (moved != still) == ne.is_of_robot(effect)
