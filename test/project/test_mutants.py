"""The faults of test/project/mutants.py can be planted, in every room, and a survivor is told."""

from pathlib import Path

import pytest
from mutants import (
    KILLED,
    MUTANTS,
    PACKAGE,
    ROOT,
    SURVIVED,
    Mutant,
    MutantError,
    judge,
    planted,
)


@pytest.mark.parametrize("mutant", MUTANTS, ids=str)
def test_a_fault_is_one_place_of_its_file_and_python_can_read_it(mutant):
    path = ROOT / PACKAGE / mutant.file
    compile(mutant.apply(path.read_text()), str(path), "exec")
    assert mutant.find_tests(ROOT)


def test_every_room_has_a_fault():
    rooms = {path.parent.name for path in (ROOT / PACKAGE).glob("*/__init__.py")}
    assert {mutant.room for mutant in MUTANTS} == rooms
    assert len(MUTANTS) >= 40


@pytest.fixture
def repository(tmp_path):
    """A package of one function, and a test of it for each number."""
    (tmp_path / PACKAGE).mkdir()
    (tmp_path / PACKAGE / "__init__.py").write_text("")
    (tmp_path / PACKAGE / "sums.py").write_text("def add(a, b):\n    return a + b\n")
    (tmp_path / "test").mkdir()
    for name, a in (("test_none.py", 0), ("test_two.py", 2)):
        (tmp_path / "test" / name).write_text(
            f"from {PACKAGE}.sums import add\n\n\ndef test_sum():\n    assert add({a}, 0) == {a}\n"
        )
    return tmp_path


def subtract(tests):
    return Mutant("sums.py", "a + b", "b - a", "the sum is a difference", tests)


@pytest.mark.wide
def test_a_fault_is_found_by_the_test_that_feels_it_and_taken_out_again(repository):
    sound = (repository / PACKAGE / "sums.py").read_text()
    found = judge(subtract("test_none.py test_two.py"), repository, [""])
    assert found == (KILLED, "test/test_two.py::test_sum")
    assert (repository / PACKAGE / "sums.py").read_text() == sound


@pytest.mark.wide
def test_a_fault_that_no_test_feels_survives(repository):
    assert judge(subtract("test_none.py"), repository, [""]) == (SURVIVED, "test_none.py")


@pytest.mark.wide
def test_a_test_that_fails_anyway_finds_nothing(repository):
    (repository / "test" / "test_two.py").write_text("def test_sum():\n    assert False\n")
    with pytest.raises(MutantError, match=r"test_two.py::test_sum fails without this mutant, too"):
        judge(subtract("test_two.py"), repository, [""])


@pytest.mark.parametrize(("text", "times"), [("a - b", 0), ("a", 3)])
def test_a_fault_whose_code_has_changed_is_an_error_with_file_and_text(repository, text, times):
    mutant = Mutant("sums.py", text, "b", "it is wrong", "test_two.py")
    with pytest.raises(MutantError) as refused, planted(mutant, Path(repository)):
        pass
    assert f"{PACKAGE}/sums.py: expected once" in str(refused.value)
    assert f"'it is wrong', found it {times} times" in str(refused.value)
    assert str(refused.value).endswith(f"The text was:\n{text}")
