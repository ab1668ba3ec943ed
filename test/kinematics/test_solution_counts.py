"""The study of `--all` counts by means of its own, and its page states what it counted."""

from pathlib import Path

from bench.truth.solution_counts import count_delta, count_hexapod, read_study

PAGE = Path(__file__).parents[2] / "docs" / "validation.md"


def test_no_robot_of_the_study_has_a_solution_that_is_missing_or_wrong():
    rows = read_study()
    assert {one.robot for one in rows} == {"delta", "hexapod"}
    assert len(rows) >= 300
    assert not any(one.missed or one.open for one in rows)
    assert all(one.complete for one in rows)
    text = PAGE.read_text()
    for robot, name in (("hexapod", "hexapods"), ("delta", "Deltas")):
        own = [one for one in rows if one.robot == robot]
        (row,) = [line for line in text.splitlines() if line.startswith(f"| {name}, ")]
        counted, listed = sum(one.counted for one in own), sum(one.listed for one in own)
        assert f"| {len(own)} |" in row
        assert f"| {counted} of {listed} | 0 | 0 |" in row


def test_a_robot_of_the_study_is_counted_again_alike():
    for count, robot in ((count_delta, "delta"), (count_hexapod, "hexapod")):
        (stored,) = [one for one in read_study() if (one.robot, one.number) == (robot, 1)]
        assert count(1) == stored
