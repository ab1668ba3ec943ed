"""Files that can be made again are kept for as long as what they were made of stays the same."""

import pytest

from parallel_cal.base.files import load_or_compute


@pytest.fixture
def made(tmp_path, monkeypatch):
    """made() -> (the document, how often it was made so far), of the files in the source folder."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder, times = tmp_path / "source", []
    folder.mkdir()
    (folder / "a.py").write_text("1")
    (folder / "b.py").write_text("2")

    def make():
        times.append(1)
        return [path.read_text() for path in sorted(folder.iterdir())]

    return lambda: (load_or_compute(sorted(folder.iterdir()), make), len(times))


def test_a_document_is_made_again_when_a_source_changes_and_not_before(made, tmp_path):
    assert made() == (["1", "2"], 1)
    assert made() == (["1", "2"], 1)
    (tmp_path / "source" / "b.py").write_text("3")
    assert made() == (["1", "3"], 2)
    (tmp_path / "source" / "b.py").rename(tmp_path / "source" / "c.py")
    assert made() == (["1", "3"], 3)
    (tmp_path / "source" / "c.py").unlink()
    assert made() == (["1"], 4)


def test_a_damaged_document_is_made_again(made, tmp_path):
    made()
    [file] = (tmp_path / "cache").rglob("*.json")
    file.write_text('["1", ')
    assert made() == (["1", "2"], 2)
    assert made() == (["1", "2"], 2)


def test_where_nothing_can_be_kept_it_is_made_each_time(made, tmp_path):
    (tmp_path / "cache").write_text("a file where the folder would be")
    assert made() == (["1", "2"], 1)
    assert made() == (["1", "2"], 2)
