"""Buffer the raw messages of one clock and read them exactly as a recording is read."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parallel_cal.base.errors import BagError, DatasetError, ParallelCalError, UnfitError
from parallel_cal.base.keyed_warning import KeyedWarning
from parallel_cal.recordings.channels import CHANNELS, list_channels
from parallel_cal.recordings.cleaning import assemble
from parallel_cal.recordings.clocks import align_clocks
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.gate import MAX_STAMP_JUMP_NS
from parallel_cal.recordings.loading import dataset_from_aligned
from parallel_cal.recordings.options import ReadOptions, SampleOptions
from parallel_cal.recordings.pairing import find_bracketed
from parallel_cal.recordings.pose_messages import frame_of, stamp_of
from parallel_cal.recordings.recording import MESSAGE_COLUMNS, Bools, Dropped, Raw
from parallel_cal.recordings.samples import max_gap

# s by which the middle of a sample moves at most when it is read again, if its duration is zero.
SAME_SAMPLE_TOLERANCE_S = 1e-6


@dataclass(frozen=True)
class Made:
    """What a snapshot's messages give: the samples, or the `trouble` that prevents them.

    `paired` and `dropped` count the poses; they are None if the messages cannot be read. `misfit`
    is set if the messages can never become samples.
    """

    paired: int | None = None
    dropped: int | None = None
    dataset: Dataset | None = None
    start_ns: int = 0
    trouble: str = ""
    misfit: str = ""


@dataclass(frozen=True)
class Snapshot:
    """The messages of an inbox at one moment, which any thread can make samples of."""

    inbox: Inbox
    number: int
    raws: Mapping[str, Raw]
    joints: Sequence[str] | None
    options: SampleOptions
    passive: Sequence[str] = ()

    @property
    def messages(self) -> int:
        return sum(len(raw.stamp) for raw in self.raws.values())

    def make_samples(self) -> Made:
        # Samples need joint states and at least one kind of measurement.
        raws, poses = self.raws, find_poses(self.raws)
        measured = (poses, *(raws[name] for name in list_channels("words", "readings", "images")))
        silent = [] if raws["joint_states"].stamp else [raws["joint_states"].topic]
        newest = raws["joint_states"].rows[-1:]
        encoded = any(name in self.passive for names, _, _ in newest for name in names)
        if not encoded and not any(raw.stamp for raw in measured):
            silent.append(" or ".join(raw.topic for raw in measured))
        if silent:
            return Made(trouble=f"no messages received on {' and '.join(silent)} yet")
        found = Made()
        try:
            received = {name: raw for name, raw in raws.items() if raw.stamp}
            # One recording serves the counts and the samples, so that they agree.
            reading = ReadOptions(joints=self.joints, passive=self.passive)
            recording = align_clocks(assemble(received, reading, "live"))
            # A measurement needs a joint state before and after it; the newest may still get one.
            states, time = recording.joints, recording.pose.time
            near = find_bracketed(states, time, max_gap(states, self.options))
            pending = (time > states.time[-1]) & ~near
            paired = int(near.sum())
            found = Made(paired, len(poses.stamp) - paired - int(pending.sum()))
            dataset = dataset_from_aligned(recording, self.options)
            return replace(found, dataset=dataset, start_ns=recording.start_ns)
        except ParallelCalError as error:
            words, misfit = str(error), ""
            if isinstance(error, BagError | UnfitError):
                misfit = KeyedWarning(words, "unusable messages", type(error).__name__)
            return replace(found, trouble=words, misfit=misfit)
        except Exception as error:  # an internal fault must not stop the collection
            return replace(found, trouble=f"internal error: {error!r}")


class Inbox:
    """The raw messages of one clock and the samples made of them, each with a permanent number.

    Further messages may refine a sample while the robot still rests, so a sample is recognised by
    its time. `removed` and `taken` hold the numbers that the user excluded or took.
    """

    def __init__(self, topics: Mapping[str, str], numbers: Iterator[int]):
        self.raws = {n: Raw(topics.get(n, n), c.types[0]) for n, c in CHANNELS.items()}
        self.dataset: Dataset | None = None
        self.ids: NDArray[np.int64] = np.zeros(0, np.int64)
        self.removed: list[int] = []
        self.taken: list[int] = []
        self.start_ns = 0
        self.paired = self.dropped = 0
        self.trouble = self.misfit = ""
        self.closed = False
        self._numbers, self._snapshots = numbers, count(1)
        self._seen = 0  # number of messages in the last snapshot
        # Number of the last snapshot whose samples were adopted, and the messages in it.
        self._adopted = self._read = 0
        self._until = 0  # stamp of the last joint state in that snapshot

    @classmethod
    def from_dataset(cls, dataset: Dataset, numbers: Iterator[int], start_ns: int = 0) -> Inbox:
        """Make a closed inbox with the samples of a file."""
        inbox = cls({}, numbers)
        inbox._adopt(dataset, start_ns)
        inbox.taken = inbox.ids.tolist()
        inbox.closed = True
        return inbox

    def jumps_back(self, channel: str, stamp: int) -> bool:
        """Return whether a stamp is of another clock: a bag played again, a simulation reset."""
        last = self.raws[channel].stamp[-1:]
        return bool(last) and stamp > 0 and stamp < last[0] - MAX_STAMP_JUMP_NS

    def add(self, channel: str, stamp: int, log: int, message: Any, publisher: str = "") -> None:
        """Append one message; times in ns.

        A stamp of 0 was not believed. If the message has one, it takes its place after the message
        before it, so that the reader says what else is wrong with it.
        """
        raw, kind = self.raws[channel], CHANNELS[channel]
        if not stamp and kind.kind == "joints" and stamp_of(message) > 0:
            stamp = raw.stamp[-1] + 1 if raw.stamp else stamp_of(message)
        if kind.kind == "condition" and raw.stamp[-1:] == [stamp]:
            return  # a latched message arrives twice, see subscriptions
        origin = sys.intern((frame_of(message) or "(empty)") + publisher)
        raw.append(log, stamp, kind.decode(message), origin)

    def inherit(self, other: Inbox, channels: Iterable[str]) -> None:
        """Copy the last message of each channel, because it may never be published again."""
        for channel in channels:
            for part in MESSAGE_COLUMNS:
                setattr(self.raws[channel], part, getattr(other.raws[channel], part)[-1:])

    def forget(self) -> None:
        """Make the samples of all messages again; those that are being made no longer count."""
        self._seen, self._read, self._adopted = 0, -1, next(self._snapshots)

    @property
    def is_complete(self) -> bool:
        """Whether the samples are those of all messages."""
        return self._read == self._count_messages()

    @property
    def largest(self) -> int:
        """The number of messages of the channel that has most."""
        return max(len(raw.stamp) for raw in self.raws.values())

    def _count_messages(self) -> int:
        return sum(len(raw.stamp) for raw in self.raws.values())

    def take_snapshot(
        self, joints: Sequence[str] | None, options: SampleOptions, passive: Sequence[str] = ()
    ) -> Snapshot | None:
        """Copy all messages if there are new ones since the last snapshot, else return None."""
        messages = self._count_messages()
        if self.closed or messages == self._seen:
            return None
        self._seen = messages
        # The lists grow while another thread makes samples of the snapshot.
        raws = {name: raw.select(range(len(raw.stamp))) for name, raw in self.raws.items()}
        return Snapshot(self, next(self._snapshots), raws, joints, options, passive)

    def adopt(self, snapshot: Snapshot, made: Made) -> None:
        """Use the samples made of a snapshot, unless those of a newer one are in use already."""
        if self.closed or snapshot.number <= self._adopted:
            return
        self._adopted, self._read = snapshot.number, snapshot.messages
        self._until = next(iter(snapshot.raws["joint_states"].stamp[-1:]), 0)
        self.trouble, self.misfit = made.trouble, made.misfit
        if made.paired is not None and made.dropped is not None:
            self.paired, self.dropped = made.paired, made.dropped
        if made.dataset is not None:
            self._adopt(made.dataset, made.start_ns)

    def _adopt(self, dataset: Dataset, start_ns: int) -> None:
        """Replace the samples; a sample at the time of an old one keeps its number."""
        old, self.start_ns = self._middles(), start_ns
        self.dataset, known = dataset, self.ids
        new = self._middles()
        reach = np.maximum(dataset.duration / 2, SAME_SAMPLE_TOLERANCE_S)
        nearest = _nearest(old, new)
        ids: list[int] = []
        for i, k in enumerate(nearest):
            same = k >= 0 and abs(old[k] - new[i]) <= reach[i] and known[k] not in ids[-1:]
            ids.append(int(known[k]) if same else next(self._numbers))
        self.ids = np.array(ids, np.int64)

    def _middles(self) -> NDArray[np.float64]:
        """Return the absolute time [s] of the middle of each sample."""
        if self.dataset is None:
            return np.zeros(0)
        return np.asarray(self.dataset.time + self.start_ns * 1e-9)

    def collected_mask(self, auto: bool) -> Bools:
        """Return the mask of the samples in the collection."""
        return (auto | np.isin(self.ids, self.taken)) & ~np.isin(self.ids, self.removed)

    def current(self, options: SampleOptions) -> int:
        """Return the number of the present dwell, or of one that has just ended.

        Raise DatasetError with the reason if there is none.
        """
        if self.dataset is None or not self._until or not len(self.ids):
            raise DatasetError(self.trouble or "no messages received yet")
        now = (self._until - self.start_ns) * 1e-9
        end = self.dataset.time[-1] + self.dataset.duration[-1] / 2
        if now - end <= options.min_dwell + options.trim_end:
            return int(self.ids[-1])
        recent = [d for d in self.dataset.dropped if now - d.time < 2 * options.min_dwell]
        why = f": {recent[-1].reason} ({recent[-1].detail})" if recent else ""
        raise DatasetError(
            f"no dwell to take: the last one ended {now - end:.1f} s ago{why}. Let the robot rest "
            f"for {options.min_dwell} s or more"
        )

    def reasons(self) -> list[Dropped]:
        """List what was received and is not used, ordered by time."""
        if self.dataset is None:
            return []
        times = dict(zip(self.ids.tolist(), self.dataset.time.tolist(), strict=True))
        hand = [
            Dropped(times[i], "removed by hand", f"sample {i}") for i in self.removed if i in times
        ]
        return sorted((*self.dataset.dropped, *hand), key=lambda d: d.time)

    def close(self) -> None:
        """Keep the samples and forget the messages."""
        self.closed = True
        self.raws = {name: raw.select(()) for name, raw in self.raws.items()}


def find_poses(raws: Mapping[str, Raw]) -> Raw:
    """Return the messages of the measuring device: full poses if there are any, else positions."""
    poses = [raws[name] for name in list_channels("poses")]
    return next((raw for raw in poses if raw.stamp), poses[0])


def _nearest(known: NDArray[np.float64], time: NDArray[np.float64]) -> list[int]:
    """Return the index of the known time nearest to each time, or -1 if none is known."""
    if not len(known):
        return [-1] * len(time)
    after = np.searchsorted(known, time).clip(0, len(known) - 1)
    before = (after - 1).clip(0)
    closer = np.abs(known[before] - time) <= np.abs(known[after] - time)
    return np.where(closer, before, after).tolist()
