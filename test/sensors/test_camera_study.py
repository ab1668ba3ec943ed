"""The study behind docs/camera_model.md (bench/truth/camera.py): its tables, and some of its runs.

`CAMERA_STUDY_RUNS` sets the runs of each slow test, by default 20; the page's runs are those of
the bench.
"""

import os

import numpy as np
import pytest

from bench.truth import camera
from bench.truth.blind import rms

RUNS = int(os.environ.get("CAMERA_STUDY_RUNS", "20"))
KEPT = [*camera.kept(camera.STUDY).values()]


def first_of(robot, hidden=""):
    return camera.Case(robot, hidden, 1.0, 1)


def cells(lines):
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines[2:]]


def test_the_page_shows_the_tables_of_the_kept_outcomes():
    page = camera.PAGE.read_text(encoding="utf-8")
    for name, lines in camera.tables(KEPT).items():
        start, end = camera.MARKS[name]
        assert "\n".join([start, "", *lines, "", end]) in page


def test_errors_are_averaged_as_squares_and_intervals_as_shares():
    one = camera.Accuracy(first_of("delta"), 3e-4, 30e-6, 40e-6, 30e-6, 1.0, 0.875)
    other = camera.Accuracy(first_of("delta"), 4e-4, 40e-6, 40e-6, 30e-6, 0.9, 1.0)
    arm = camera.Accuracy(first_of("ur5"), 2e-4, 20e-6, 50e-6, 20e-6, 1.0, 1.0)
    delta, lone, together = cells(camera.accuracy_lines([arm, one, other]))
    assert lone[6] == "100.0%"
    assert delta[1:6] == ["2", "354 um", "35 um", "40 um", "30 um"]
    assert delta[6:] == ["95.0% +- 5.0%", "93.8% +- 6.2%"]
    assert together[1] == "3"
    assert together[6].startswith("96.7%")


def test_a_row_counts_how_what_hides_was_named():
    case = first_of("delta", "backlash")
    found = [
        camera.Finding(case, "explained", named, 1e-4, 1e-4, 2e-5, 9.0)
        for named in (("backlash",), ("backlash or hysteresis", "encoder_gain"), ())
    ]
    (row,) = cells(camera.effect_lines(found))
    assert row[3:7] == ["3", "1", "1", "1"]
    assert row[8] == "1"  # the gain


def test_a_case_that_is_in_the_file_is_not_run_again(monkeypatch, tmp_path):
    cases = camera.list_cases(2, [1.0], ["nothing on ur5"])
    results, ran = tmp_path / "results.jsonl", []

    def run(case):
        ran.append(case.seed)
        return camera.Accuracy(case, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0)

    camera.run_missing(cases[:1], {}, run, results)
    done = camera.run_missing(cases, camera.kept(results), run, results)
    assert ran == [1, 2]
    assert [o.case for o in done] == cases == [*camera.kept(results)]


@pytest.fixture(scope="module")
def measured():
    """Runs with nothing hidden, by robot."""
    return {
        robot: [camera.measure(c) for c in camera.list_cases(RUNS, [1.0], [f"nothing on {robot}"])]
        for robot in camera.ROBOTS
    }


@pytest.mark.slow
def test_intervals_of_positions_and_of_the_lens_hold_the_truth(measured):
    # All robots together, as the page counts: the share of 20 runs of one is uncertain by 1.5 %.
    some = [one for runs in measured.values() for one in runs]
    assert np.mean([one.positions for one in some]) >= 0.93
    assert np.mean([one.lens for one in some]) >= 0.93


@pytest.mark.slow
@pytest.mark.parametrize(("robot", "limit"), [("delta", 70e-6), ("stewart", 40e-6), ("ur5", 65e-6)])
def test_a_camera_identifies_a_robot_as_well_as_its_fit_states(measured, robot, limit):
    errors, stated = (rms([getattr(o, n) for o in measured[robot]]) for n in ("camera", "stated"))
    assert errors < limit
    assert 0.75 < errors / stated < 1.33


def look_for_all(hidden):
    robot = camera.KINDS[hidden].robot
    cases = camera.list_cases(RUNS, [1.0], [f"{hidden} on {robot}"])
    return [camera.look_for(case) for case in cases]


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [kind for kind in camera.KINDS if kind != "eccentricity"])
def test_a_hidden_effect_is_named(hidden):
    some = look_for_all(hidden)
    assert sum(o.how != "not" for o in some) >= 0.95 * len(some)


@pytest.mark.slow
def test_what_is_named_of_an_eccentricity_that_the_geometry_hides_makes_no_robot_worse():
    # The joints of a Delta turn too little to tell it from wrong lengths; the page says so.
    some = look_for_all("eccentricity")
    assert rms([o.after for o in some]) <= 1.05 * rms([o.before for o in some])
