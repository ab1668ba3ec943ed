"""The samples of a running node: made from the messages as they come, and kept on disk."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import suppress
from typing import Protocol, TypeVar

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.keyed_warning import KeyedWarning
from parallel_cal.campaign.cell import Sample
from parallel_cal.model.model import Model
from parallel_cal.nodes.calibration_settings import CalibrationSettings
from parallel_cal.nodes.collection_report import CollectionReport
from parallel_cal.nodes.collector import Collection, Collector
from parallel_cal.nodes.frames import Look, by_tf
from parallel_cal.nodes.inbox import Made, Snapshot
from parallel_cal.nodes.journal import Journal
from parallel_cal.nodes.message_recording import MessageRecording
from parallel_cal.nodes.subscriptions import MEASURED, MessageQueue
from parallel_cal.recordings.channels import CHANNELS, CORNERS

POLL_INTERVAL_S = 0.02  # s between two checks whether the samples are made
T = TypeVar("T")


class Call(Protocol):
    """Calls a function in the thread that spins, from another one."""

    def __call__(self, function: Callable[..., T], *args: object) -> T: ...


class LiveSamples:
    """Brings the collection and its journal up to date with the messages of a queue.

    All methods belong to the thread that spins, except `refresh_beside`.
    """

    def __init__(
        self,
        settings: CalibrationSettings,
        collector: Collector,
        journal: Journal | None,
        queue: MessageQueue,
        recording: MessageRecording,
        report: CollectionReport,
        look: Look,
    ):
        self.collector, self._settings, self._journal = collector, settings, journal
        self._queue, self._recording, self._report, self._look = queue, recording, report, look
        # One thread: two of them would take twice as long each.
        self._maker = ThreadPoolExecutor(1, thread_name_prefix="samples")

    def resume(self) -> None:
        """Take over the samples of a run that crashed; name journals that are not taken over."""
        if self._journal is None:
            return
        try:
            resumed = self.collector.resume(self._journal.resume())
        except ParallelCalError as error:
            self._journal.abandon()
            self._report.set_trouble(f"the journal could not be read: {error}")
            return
        if resumed:
            self._report.warn(
                f"{resumed} samples of the previous run were read from {self._journal.path}; "
                "call clear_samples to discard them"
            )
        if self._journal.left:
            self._report.warn(
                f"the previous run ended in order; its samples are in {self._journal.left} and "
                "are not part of this session. To continue with them, call load_samples with this "
                "path"
            )
        for path in self._journal.busy:
            self._report.warn(
                f"{path} is in use by another node of the same name, which keeps its samples "
                "there; this node begins a journal of its own"
            )

    def refresh(self) -> None:
        """Make samples of what came in, keep them, and publish the change."""
        self._adopt(_make_samples(self._take_snapshots()))

    def refresh_beside(self, call: Call, meanwhile: Callable[[], None]) -> None:
        """Do what `refresh` does, but make the samples in a thread of their own: it takes seconds.

        Call it in any thread except the one that spins; `call` calls a function in that one. While
        it waits, it calls `meanwhile` repeatedly; an exception of `meanwhile` ends the wait.
        """
        work = self._maker.submit(_make_samples, call(self._take_snapshots))
        while not wait([work], timeout=POLL_INTERVAL_S).done:
            meanwhile()
        call(self._adopt, work.result())

    def _take_snapshots(self) -> list[Snapshot]:
        now = time.time_ns()  # what arrives while messages are processed is no silence
        self._process_messages()
        settings = self._settings
        self.collector.configure(
            settings.joints(),
            settings.sample_options(),
            settings.get("auto_collect"),
            settings.passive,
        )
        return self.collector.take_snapshots(now)

    def _adopt(self, made: Sequence[tuple[Snapshot, Made]]) -> None:
        """Use the samples made, keep them, and publish the change."""
        samples, trouble = len(self.collector), self.collector.trouble
        if self.collector.adopt(made):
            self._report.note_changes(samples, trouble)
            self.keep()
            self._report.publish()

    def keep(self) -> None:
        """Write every change to the journal; a full disk does not end the node."""
        if self._journal is None:
            return
        try:
            self._journal.keep(self.collector.entries())
        except OSError as error:
            self._report.set_trouble(
                f"the journal cannot be written: {error.strerror}; samples are in memory only"
            )
        else:
            self._report.trouble = ""

    def close_journal(self, why: str) -> None:
        """Complete the journal; the next change begins another one."""
        self.keep()
        if self._journal is not None:
            self._journal.close(why)

    def finish(self) -> None:
        """Keep what came in last, however the node ends."""
        self._maker.shutdown(wait=False, cancel_futures=True)
        self._process_messages()
        self.collector.refresh()
        self.keep()
        if self._journal is not None and not self._report.trouble:
            with suppress(OSError):  # then the next run resumes it as after a crash
                self._journal.end("the node ended in order")

    def collection(self) -> Collection:
        """Return the samples in use; DatasetError says why there are none."""
        self.refresh()
        return self.collector.collection()

    def take(self, model: Model) -> Sample:
        """Return the sample of the current dwell, for a campaign of a model, as of the last
        refresh; DatasetError says why there is none."""
        entry = self.collector.entries()[self.collector.take()]
        self.keep()
        return Sample(by_tf(entry.alone, model, self._look), entry.start_ns)

    def warnings(self) -> list[str]:
        """Return a sentence for each doubt about the samples."""
        warnings = self.collector.warnings()
        if trouble := self._settings.model_trouble:
            text = f"the model file cannot be read: {trouble}; samples are collected without it"
            warnings.append(KeyedWarning(text, "model file"))
        frame, base = self.collector.frame, self._settings.base
        if frame and base and frame != base:
            text = (
                f"the poses are in frame '{frame}', the model's base is '{base}': the transform "
                "between them is estimated from the samples, unless TF provides it"
            )
            warnings.append(KeyedWarning(text, "frame", f"{frame} {base}"))
        return warnings

    def _process_messages(self) -> None:
        for received in self._queue.take_all():
            channel = received.channel
            self.collector.receive(
                channel, received.message, received.received_ns, received.sequence
            )
            if CHANNELS[channel].kind in MEASURED:
                self._queue.inflow.process(channel)
            if channel == CORNERS:  # a recording has the image, which can be searched again
                image = received.message
                received = received._replace(channel=image.topic, message=image.message)
            self._recording.write(received)


def _make_samples(snapshots: Sequence[Snapshot]) -> list[tuple[Snapshot, Made]]:
    return [(snapshot, snapshot.make_samples()) for snapshot in snapshots]
