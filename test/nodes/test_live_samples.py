"""Every change of a running node's samples is on disk before it is published."""

from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy")
pytest.importorskip("parallel_cal_msgs")

from test_journal import BAG

from parallel_cal.nodes.collector import Collector
from parallel_cal.nodes.inbox import Inbox
from parallel_cal.nodes.journal import Journal, read_journal
from parallel_cal.nodes.live_samples import LiveSamples
from parallel_cal.recordings.loading import load_dataset

pytestmark = pytest.mark.ros


class Report:
    """What a node would log and publish; `kept` is what the journal held when it published."""

    def __init__(self, journal):
        self.trouble, self.kept, self._journal = "", None, journal

    def note_changes(self, samples, trouble):
        pass

    def publish(self):
        self.kept = read(self._journal)

    def set_trouble(self, trouble):
        self.trouble = trouble


def read(journal):
    """The numbers of the samples that another node would resume from the file of a journal."""
    parts = read_journal(journal.path) if journal.path else []
    return sorted(number for part in parts for number in part.ids)


@pytest.fixture(scope="module")
def dataset():
    return load_dataset(BAG).select(range(5))


@pytest.fixture
def live(tmp_path, dataset):
    """The samples of a node without messages, with its journal and its report."""
    collector, journal = Collector(), Journal(tmp_path, "node")
    report = Report(journal)
    settings = SimpleNamespace(
        joints=lambda: collector.joints,
        sample_options=lambda: collector.options,
        passive=(),
        get=lambda name: True,
    )
    queue = SimpleNamespace(take_all=lambda: [])
    # As if a motion with five standstills had just been received.
    collector._inboxes.insert(0, Inbox.from_dataset(dataset, collector._numbers, 0))
    collector.adopt = lambda made: True
    return LiveSamples(settings, collector, journal, queue, None, report, None), journal, report


def test_samples_are_in_the_journal_before_they_are_published(live):
    samples, _, report = live
    samples.refresh()
    assert report.kept == sorted(samples.collector.entries())
    assert len(report.kept) == 5


def test_a_removed_sample_is_removed_from_the_journal(live):
    samples, journal, report = live
    samples.refresh()
    first, *others = report.kept
    samples.collector.remove(first)
    samples.keep()
    assert read(journal) == others


def test_a_journal_that_cannot_be_written_is_reported_until_it_can(live, monkeypatch):
    samples, journal, report = live

    def fail(entries):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as full:
        full.setattr(journal, "keep", fail)
        samples.refresh()
    assert "No space left on device; samples are in memory only" in report.trouble
    samples.keep()
    assert report.trouble == ""
    assert len(read(journal)) == 5


@pytest.mark.parametrize(
    "end", [LiveSamples.finish, lambda samples: samples.close_journal("saved")]
)
def test_however_a_node_ends_its_journal_has_what_came_in_last(live, end, tmp_path):
    samples, journal, _ = live
    end(samples)
    assert journal.path == ""
    (path,) = tmp_path.glob("*.journal")
    assert len(read(SimpleNamespace(path=path))) == 5
