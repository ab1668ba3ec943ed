"""Workers take the files of tests by their duration, and every file of the list is there."""

from pathlib import Path
from types import SimpleNamespace

from longest_first import LONG_FILES_S, sort_by_duration

TESTS = Path(__file__).parents[1]


def sorted_names(*tests):
    """The names of tests (file, mark) in the order in which workers take them."""
    items = [
        SimpleNamespace(
            path=TESTS / file,
            name=f"{file}{number}",
            get_closest_marker=lambda name, mark=mark: mark if name == mark else None,
        )
        for number, (file, mark) in enumerate(tests)
    ]
    sort_by_duration(items)
    return [item.name for item in items]


def test_the_file_that_takes_longest_comes_first_and_files_stay_together():
    quick, wide = ("a.py", None), ("b.py", "wide")
    assert sorted_names(quick, wide, quick, wide) == ["b.py1", "b.py3", "a.py0", "a.py2"]
    assert sorted_names(wide, *[quick] * 10)[:2] == ["a.py1", "a.py2"]


def test_a_file_of_few_long_tests_comes_before_one_of_many_short_ones():
    long, many = ("test_docs.py", "wide"), [("a.py", "wide")] * 90
    assert sorted_names(*many, long)[0] == "test_docs.py90"
    quick = ("test_docs.py", None)
    assert sorted_names(*many, quick)[-1] == "test_docs.py90"


def test_every_file_of_the_list_exists():
    assert {*LONG_FILES_S} <= {path.name for path in TESTS.glob("*/test_*.py")}
