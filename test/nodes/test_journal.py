"""What a journal holds is what was taken, wherever its last line was cut off."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from parallel_cal.base.errors import DatasetError
from parallel_cal.nodes.collector import Collector
from parallel_cal.nodes.journal import Journal
from parallel_cal.recordings.loading import load_dataset

BAG = Path(__file__).parents[2] / "bags" / "delta_clean"
SAME = ("q", "r", "R", "measured", "pose_cov", "time", "duration", "count_q", "count_pose")


@pytest.fixture(scope="module")
def collector():
    collector = Collector()
    collector.load(BAG)
    return collector


def resumed(folder):
    collector = Collector()
    journal = Journal(folder, "node")
    collector.resume(journal.resume())
    os.close(journal._file)
    return collector


def test_what_was_kept_is_resumed_bit_for_bit_under_its_numbers(collector, tmp_path):
    journal = Journal(tmp_path, "node")
    journal.keep(collector.entries())
    os.close(journal._file)  # as a killed process leaves it
    before, after = collector.collection(), resumed(tmp_path).collection()
    assert after.ids.tolist() == before.ids.tolist()
    for name in SAME:
        np.testing.assert_array_equal(getattr(after.dataset, name), getattr(before.dataset, name))
    for name, column in before.dataset.conditions.items():
        np.testing.assert_array_equal(after.dataset.conditions[name], column)
    assert after.dataset.pose_id.tolist() == before.dataset.pose_id.tolist()


@pytest.mark.parametrize("seed", range(5))
def test_of_a_journal_cut_off_anywhere_every_whole_line_is_there(collector, tmp_path, seed):
    journal = Journal(tmp_path, "node")
    journal.keep(collector.entries())
    os.close(journal._file)
    content = Path(journal.path).read_bytes()
    end = int(np.random.default_rng(seed).integers(3000, len(content)))
    Path(journal.path).write_bytes(content[:end])
    again = Journal(tmp_path, "node")
    assert sum(len(part.ids) for part in again.resume()) == content[:end].count(b"\n")
    again.keep(collector.entries())  # and it goes on where it was cut
    os.close(again._file)
    assert len(resumed(tmp_path)) == 94


def test_what_is_no_text_behind_a_crash_takes_no_other_line_with_it(collector, tmp_path):
    journal = Journal(tmp_path, "node")
    journal.keep(collector.entries())
    os.write(journal._file, b'{"id": 95, "start_ns"\x00\x00\xff\xfe')
    os.close(journal._file)
    assert len(resumed(tmp_path)) == 94


def test_what_was_removed_or_saved_does_not_come_back(collector, tmp_path):
    journal = Journal(tmp_path, "node")
    entries = collector.entries()
    journal.keep(entries)
    first = min(entries)
    journal.keep({k: e for k, e in entries.items() if k != first})
    os.close(journal._file)
    assert len(resumed(tmp_path)) == 93
    journal = Journal(tmp_path, "node")
    journal.resume()
    journal.close("saved")
    assert Journal(tmp_path, "node").resume() == []
    journal.keep({k: e for k, e in entries.items() if k != first})  # nothing new since
    assert journal.path == ""


def test_a_journal_that_another_node_uses_is_not_touched(collector, tmp_path):
    journal = Journal(tmp_path, "node")
    journal.keep(collector.entries())
    assert Journal(tmp_path, "node").resume() == []
    assert Journal(tmp_path, "other").resume() == []
    journal.close("")


def test_a_session_that_ended_in_order_does_not_join_the_next_one(collector, tmp_path):
    journal = Journal(tmp_path, "node")
    journal.keep(collector.entries())
    path = journal.path
    journal.end("the node ended in order")
    following = Journal(tmp_path, "node")
    assert following.resume() == []
    assert following.left == path
    loaded = Collector()
    assert loaded.load(path) == len(collector)
    assert np.array_equal(loaded.collection().dataset.q, collector.collection().dataset.q)


def test_an_older_journal_does_not_join_after_a_session_that_ended_in_order(collector, tmp_path):
    """It was left by a node that crashed long ago, or that had other joints."""
    older = Journal(tmp_path, "node")
    older.keep(collector.entries())
    os.close(older._file)
    newer = Journal(tmp_path, "node")
    newer.keep(collector.entries())
    newer.end("the node ended in order")
    assert Journal(tmp_path, "node").resume() == []


def test_a_journal_that_another_node_uses_is_named(collector, tmp_path):
    journal = Journal(tmp_path, "node")
    journal.keep(collector.entries())
    second = Journal(tmp_path, "node")
    assert second.resume() == []
    assert second.busy == [journal.path]
    journal.close("")


def test_a_journal_without_samples_is_not_loaded(collector, tmp_path):
    path = tmp_path / "node-1.journal"
    path.write_text('{"id": 3}\n')
    before = len(collector)
    with pytest.raises(DatasetError, match=r"node-1\.journal: a journal without samples"):
        collector.load(path)
    assert len(collector) == before


def test_an_invalid_journal_is_an_error_with_its_name(tmp_path):
    line = {"id": 1, "start_ns": 0, "sample": {"q": [None]}}
    (tmp_path / "node-1.journal").write_text(json.dumps(line) + "\n")
    with pytest.raises(DatasetError, match=r"node-1\.journal"):
        Journal(tmp_path, "node").resume()


def test_other_joints_are_not_resumed(collector, tmp_path):
    journal = Journal(tmp_path, "node")
    journal.keep(collector.entries())
    os.close(journal._file)
    other = Collector(joints=("elbow",))
    with pytest.raises(DatasetError, match="elbow"):
        other.resume(Journal(tmp_path, "node").resume())
    assert len(other) == 0


def test_an_abandoned_journal_stays_as_it_is_and_the_next_change_begins_another(
    collector, tmp_path
):
    journal = Journal(tmp_path, "node")
    journal.keep(collector.entries())
    path, content = Path(journal.path), Path(journal.path).read_bytes()
    journal.abandon()
    assert journal.path == ""
    journal.keep(dict(list(collector.entries().items())[:3]))
    assert journal.path != str(path)
    assert path.read_bytes() == content
    assert len(Path(journal.path).read_text().splitlines()) == 3


def test_samples_measured_after_a_restart_join_those_before_it(tmp_path):
    """The recording's own dataset, taken in two runs."""
    dataset = load_dataset(BAG)
    first, journal = Collector(), Journal(tmp_path, "node")
    dataset.select(range(40)).to_json(tmp_path / "a.json")
    dataset.select(range(40, 94)).to_json(tmp_path / "b.json")
    first.load(tmp_path / "a.json")
    journal.keep(first.entries())
    os.close(journal._file)
    second = resumed(tmp_path)
    assert len(second) == 40
    assert next(second._numbers) == 41


def test_a_folder_in_which_no_journal_can_be_written_is_named_before_the_first_sample(tmp_path):
    assert Journal(tmp_path / "new" / "folder", "node").describe_obstacle() == ""
    assert not (tmp_path / "new").exists()
    (tmp_path / "file").write_text("")
    obstacle = Journal(tmp_path / "file" / "j", "node").describe_obstacle()
    assert obstacle == f"{tmp_path / 'file'} is not a folder"
