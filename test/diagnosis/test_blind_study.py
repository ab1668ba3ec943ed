"""The table of the blind study counts the outcomes that are kept beside the page."""

from dataclasses import replace

from bench.truth import blind

OUTCOMES = [*blind.kept(blind.STUDY).values()]


def first_of(family):
    return next(outcome for outcome in OUTCOMES if outcome.case.family == family)


def test_the_page_shows_the_table_of_the_kept_outcomes():
    page = blind.PAGE.read_text(encoding="utf-8")
    assert "\n".join([blind.START, "", *blind.table_lines(OUTCOMES), "", blind.END]) in page


def test_a_row_counts_what_is_correct_for_its_family():
    null, single, outside = (first_of(family) for family in ("null", "single", "outside"))
    named = replace(null, named=("backlash",))
    refused = replace(single, error="refused", named=(), against=())
    rows = blind.table_lines([null, named, single, refused, replace(outside, verdict="explained")])
    cells = [[cell.strip() for cell in row.split("|")[1:-1]] for row in rows[2:]]
    assert [row[3] for row in cells] == ["1 of 2", "1 of 2", "0 of 1"]
    assert [row[6] for row in cells] == ["0", "1", "0"]
    assert cells[0][4] == "1.3%..98.7%"


def test_an_error_and_a_worse_robot_are_counted():
    single = first_of("single")
    rows = blind.table_lines([replace(single, verdict="error"), replace(single, after=1.0)])
    cells = [cell.strip() for cell in rows[2].split("|")[1:-1]]
    assert (cells[3], cells[5], cells[7]) == ("1 of 2", "1", "1")
