"""Collect samples from live messages, and let the user take, exclude, load and save them.

This module does not use ROS. A replayed recording yields the samples that `load_dataset` reads from
its bag, because both pass the same steps: cleaning, dwells, conditions, replicates.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.keyed_warning import KeyedWarning
from parallel_cal.nodes.clock_alignment import ClockAlignment, JointClock
from parallel_cal.nodes.inbox import Inbox, Made, Snapshot
from parallel_cal.nodes.journal import SUFFIX, Entry, Part, read_journal
from parallel_cal.recordings.channels import CHANNELS, list_channels
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.gate import Gate, StampedMessage
from parallel_cal.recordings.joining import fingerprint, join_datasets
from parallel_cal.recordings.loading import load_dataset, order_joints
from parallel_cal.recordings.options import SampleOptions
from parallel_cal.recordings.pose_messages import stamp_of
from parallel_cal.recordings.recording import Dropped

# Messages of one channel in an inbox: a quarter of an hour of joint states at 100 Hz. A new inbox
# begins then, and the old one keeps its samples but not its messages, which limits the memory.
MAX_MESSAGES = 100_000
SETTLING_TIME_NS = 1_000_000_000  # ns after a clock jump until all streams use the joints' inbox
MIN_DROPS_TO_WARN = 20  # messages or dwells dropped for one reason before a warning


@dataclass(frozen=True)
class Collection:
    """The samples in use, their numbers and their stamps [ns] (from 0 if they come from a file)."""

    dataset: Dataset
    ids: NDArray[np.int64]
    stamps: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.ids)


class Collector:
    """Buffers messages by channel and makes samples of them at each `refresh`."""

    def __init__(
        self,
        joints: Sequence[str] | None = None,
        options: SampleOptions | None = None,
        topics: Mapping[str, str] | None = None,
        auto: bool = True,
        passive: Sequence[str] = (),
    ):
        self.joints, self.options, self.auto = joints, options or SampleOptions(), auto
        self.passive = passive
        self.received: Counter[str] = Counter()
        self._topics, self._numbers = dict(topics or {}), count(1)
        self._past_paired = self._past_dropped = self._past_lost = self._past_strays = 0
        self._restart()

    def configure(
        self,
        joints: Sequence[str] | None,
        options: SampleOptions,
        auto: bool,
        passive: Sequence[str] = (),
    ) -> None:
        """Change joints or options, and remake the samples whose messages are still buffered.

        `passive` are the passive joints whose readings are taken from the joint states.
        """
        self.auto = auto
        if (joints, options, passive) != (self.joints, self.options, self.passive):
            self.joints, self.options, self.passive = joints, options, passive
            for inbox in self._inboxes:
                inbox.forget()

    def _restart(self) -> None:
        self._inboxes = [Inbox(self._topics, self._numbers)]
        self._at = dict.fromkeys(CHANNELS, self._inboxes[0])
        self._words: list[tuple[str, int, Any]] = []
        self._gates: dict[tuple[str, tuple[str, ...]], Gate] = {}
        self._alignments: dict[tuple[str, tuple[str, ...]], ClockAlignment] = {}
        self._clock, self._moved = JointClock(), 0

    # ------------------------------------------------------------------ messages in

    def receive(self, channel: str, message: Any, log_ns: int, sequence: int = 0) -> None:
        """Buffer one message of a channel, received at `log_ns`.

        `log_ns` replaces a stamp that the header lacks. Words, which have no header, wait for the
        next joint state, so that they enter the same inbox.
        """
        self.received[channel] += 1
        kind = CHANNELS[channel].kind
        stamp = message.stamp if kind == "images" else stamp_of(message)
        if kind == "words":
            self._words.append((channel, log_ns, message))
        elif kind in ("condition", "images"):  # too rare to judge their stamps: one a minute
            self._buffer(channel, message, log_ns, stamp)
        else:
            stream = self._identify_stream(channel, message)
            gate = self._gates.setdefault(stream, Gate(channel))
            if kind == "joints" and not _is_complete(message, self.joints):
                stamp = 0  # whoever sends no reading tells no time either
            self._pass_on(stream, gate.take(stamp, log_ns, sequence, message))

    def _pass_on(
        self, stream: tuple[str, tuple[str, ...]], released: Sequence[StampedMessage]
    ) -> None:
        """Buffer the messages that a gate released, with stamps aligned to the joints' clock."""
        channel = stream[0]
        if channel == "joint_states":
            for message in released:
                self._clock.add(message.stamp, message.log)
        else:
            alignment = self._alignments.setdefault(stream, ClockAlignment(channel, self._clock))
            released = alignment.take(released)
        for message in released:
            publisher = f" (publisher {message.source.number})" if message.source else ""
            self._buffer(channel, message.message, message.log, message.stamp, publisher)

    def _identify_stream(self, channel: str, message: Any) -> tuple[str, tuple[str, ...]]:
        """Name the stream of a message: one channel may have a publisher per group of joints or per
        sensor, each with its own gate."""
        part: tuple[str, ...] = ()
        if channel == "joint_states":
            names = tuple(message.name)
            part = tuple(self.joints or ()) if set(self.joints or ()) <= set(names) else names
            part = part or names
        elif CHANNELS[channel].kind == "readings":
            part = (message.header.frame_id,)
        return channel, part

    @property
    def lost(self) -> int:
        """Count the messages that were published and not received."""
        return self._past_lost + sum(gate.lost for gate in self._gates.values())

    @property
    def strays(self) -> int:
        """Count the messages that were dropped because their stamps fit no stream."""
        return self._past_strays + sum(watch.strays for watch in self._watches)

    @property
    def _watches(self) -> list[Gate | ClockAlignment]:
        return [*self._gates.values(), *self._alignments.values()]

    def warnings(self) -> list[str]:
        """List what makes the samples suspicious, one sentence each."""
        made = [inbox.dataset for inbox in self._inboxes if inbox.dataset is not None]
        warnings = [warning for dataset in made for warning in dataset.warnings]
        dropped = Counter[str]()
        for dataset in made:
            for item in dataset.dropped:
                dropped[item.reason] += item.count
        warnings += [
            KeyedWarning(f"{n} dropped: {why}", "dropped", why)
            for why, n in dropped.items()
            if n >= MIN_DROPS_TO_WARN
        ]
        warnings += [inbox.misfit for inbox in self._inboxes if inbox.misfit]
        warnings += [watch.trouble for watch in self._watches if watch.trouble]
        return list(dict.fromkeys(warnings))

    @property
    def frame(self) -> str:
        """The frame of the poses, empty if there are no samples."""
        made = [inbox.dataset for inbox in self._inboxes if inbox.dataset is not None]
        return made[-1].frame if made else ""

    def _buffer(
        self, channel: str, message: Any, log_ns: int, stamp: int, publisher: str = ""
    ) -> None:
        joints = self._at["joint_states"]
        if self._at[channel] is not joints and log_ns - self._moved > SETTLING_TIME_NS:
            self._at[channel] = joints
        if self._at[channel].jumps_back(channel, stamp):
            # Each stream changes to the new clock at its own time, but all to the same inbox.
            if self._at[channel] is self._inboxes[-1]:
                self._inboxes.append(Inbox(self._topics, self._numbers))
            self._at[channel] = self._inboxes[self._inboxes.index(self._at[channel]) + 1]
            if channel == "joint_states":
                self._moved = log_ns
        if channel == "joint_states":
            for name, log, word in self._words:
                self._at[channel].add(name, 0, log, word)
            self._words.clear()
        self._at[channel].add(channel, stamp, log_ns, message, publisher)

    def refresh(self, now_ns: int | None = None) -> bool:
        """Make samples of the messages received; return whether there were new ones.

        Pass the present time as `now_ns` while more messages may come.
        """
        snapshots = self.take_snapshots(now_ns)
        return self.adopt([(snapshot, snapshot.make_samples()) for snapshot in snapshots])

    def take_snapshots(self, now_ns: int | None = None) -> list[Snapshot]:
        """Copy the messages of each inbox that has new ones: the fast first part of `refresh`.

        Another thread may make samples of them, which takes seconds, for `adopt`.
        """
        for stream, gate in self._gates.items():
            self._pass_on(stream, gate.flush(now_ns))
        taken = (
            inbox.take_snapshot(self.joints, self.options, self.passive) for inbox in self._inboxes
        )
        return [snapshot for snapshot in taken if snapshot is not None]

    def adopt(self, made: Sequence[tuple[Snapshot, Made]]) -> bool:
        """Use the samples made of snapshots; return whether there are any."""
        for snapshot, samples in made:
            snapshot.inbox.adopt(snapshot, samples)
        live = self._at["joint_states"]
        if live.largest > MAX_MESSAGES:
            self._begin_inbox(live)
        poses = [c for c in list_channels("poses") if self.received[c]]
        measured = poses[:1] + [c for c in list_channels("readings", "images") if self.received[c]]
        in_use = [self._at[channel] for channel in ("joint_states", *measured)]
        first = min(self._inboxes.index(inbox) for inbox in in_use)
        for inbox in self._inboxes[:first]:  # no stream adds to these any more
            if inbox.is_complete:
                inbox.close()
            if inbox.closed and inbox.dataset is None and not inbox.misfit:
                self._past_paired += inbox.paired
                self._past_dropped += inbox.dropped
                self._inboxes.remove(inbox)
        return bool(made)

    def _begin_inbox(self, live: Inbox) -> None:
        """Begin a new inbox during a motion, so that no dwell is cut.

        The new inbox starts with the last conditions and words. A robot that never moves gets a new
        inbox after twice MAX_MESSAGES.
        """
        if live.largest < 2 * MAX_MESSAGES:
            with suppress(DatasetError):  # raised if the robot moves
                live.current(self.options)
                return
        new = Inbox(self._topics, self._numbers)
        new.inherit(live, list_channels("condition", "words"))
        self._inboxes.append(new)
        self._at = dict.fromkeys(CHANNELS, new)

    # ------------------------------------------------------------------ samples out

    def collection(self) -> Collection:
        """Return the samples in use; raise DatasetError with the reason if there are none."""
        parts, starts, ids, stamps = [], [], [], []
        for inbox in self._inboxes:
            mask = inbox.collected_mask(self.auto)
            if inbox.dataset is not None and mask.any():
                part = inbox.dataset if mask.all() else inbox.dataset.select(mask)
                parts.append(part)
                starts.append(inbox.start_ns)
                ids.append(inbox.ids[mask])
                stamps.append((part.time * 1e9).astype(np.int64) + inbox.start_ns)
        if not parts:
            if self.trouble and self.received:
                raise DatasetError(self.trouble)
            counts = ", ".join(f"{n} on {c}" for c, n in self.received.items()) or "none"
            advice = "" if self.auto else "; auto_collect is off, call take_sample to take a sample"
            raise DatasetError(f"no samples yet; messages received: {counts}{advice}")
        together = parts[0]
        if len(parts) > 1:
            together = join_datasets(parts, starts, self.options.replicate_tolerance)
        dataset = dataclasses.replace(
            together,
            sha256=together.sha256 or fingerprint(together),
            dropped=tuple(self.dropped()),
        )
        return Collection(dataset, np.concatenate(ids), np.concatenate(stamps))

    def __len__(self) -> int:
        return sum(int(inbox.collected_mask(self.auto).sum()) for inbox in self._inboxes)

    @property
    def trouble(self) -> str:
        """Why the messages received last gave no samples, or empty."""
        return self._at["joint_states"].trouble

    @property
    def paired(self) -> int:
        return self._past_paired + sum(s.paired for s in self._inboxes)

    @property
    def dropped_poses(self) -> int:
        return self._past_dropped + sum(s.dropped for s in self._inboxes)

    def dropped(self) -> list[Dropped]:
        """List everything that was received and is not used, with the reason."""
        return [d for inbox in self._inboxes for d in inbox.reasons()]

    # ------------------------------------------------------------------ requests of the user

    def take(self) -> int:
        """Take the present dwell, as of the last refresh, into the collection; return its number.

        Raise DatasetError with the reason if there is no dwell.
        """
        inbox = self._at["joint_states"]
        number = inbox.current(self.options)
        inbox.removed = [i for i in inbox.removed if i != number]
        if number not in inbox.taken:
            inbox.taken.append(number)
        return number

    def remove(self, number: int) -> None:
        """Exclude a sample; raise DatasetError if its number is not in the collection."""
        for inbox in self._inboxes:
            if number in inbox.ids[inbox.collected_mask(self.auto)]:
                inbox.removed.append(number)
                return
        raise DatasetError(f"no sample {number} in the collection; list_samples shows them")

    def clear(self) -> int:
        """Forget all samples and messages; return how many samples there were."""
        samples, paired, dropped = len(self), self.paired, self.dropped_poses
        self._past_paired, self._past_dropped = paired, dropped
        self._past_lost, self._past_strays = self.lost, self.strays
        self._restart()
        return samples

    def save(self, path: str | Path) -> int:
        """Write the samples to a file, all or nothing; return how many."""
        collection = self.collection()
        try:
            collection.dataset.to_json(path)
        except OSError as error:
            raise DatasetError(f"{path}: cannot be written: {error.strerror}") from None
        return len(collection)

    def entries(self) -> dict[int, Entry]:
        """Return every sample in use by its number, as the journal stores it."""
        return {
            int(inbox.ids[i]): Entry(inbox.dataset, int(i), inbox.start_ns)
            for inbox in self._inboxes
            if inbox.dataset is not None
            for i in np.flatnonzero(inbox.collected_mask(self.auto))
        }

    def resume(self, parts: Sequence[Part]) -> int:
        """Begin with the samples of a journal under their old numbers; return how many.

        Raise DatasetError, and change nothing, if they belong to other joints.
        """
        ordered = [order_joints(part.dataset, self.joints) for part in parts]
        ids = [number for part in parts for number in part.ids]
        self._numbers = count(max(ids, default=0) + 1)
        self._restart()
        for k, (part, dataset) in enumerate(zip(parts, ordered, strict=True)):
            self._inboxes.insert(k, Inbox.from_dataset(dataset, iter(part.ids), part.start_ns))
        return len(ids)

    def load(self, path: str | Path) -> int:
        """Replace the collection by the samples of a file, a bag or a journal; return how many.

        If they cannot be read, the collection stays unchanged.
        """
        if Path(path).suffix == SUFFIX:
            parts = [(order_joints(p.dataset, self.joints), p.start_ns) for p in read_journal(path)]
        else:
            parts = [(load_dataset(path, joints=self.joints, passive=self.passive), 0)]
        self.clear()
        for k, (dataset, start_ns) in enumerate(parts):
            self._inboxes.insert(k, Inbox.from_dataset(dataset, self._numbers, start_ns))
        return sum(len(dataset) for dataset, _ in parts)


def _is_complete(message: Any, joints: Sequence[str] | None) -> bool:
    """Whether a joint state has a finite position of each joint that is wanted."""
    if len(message.position) != len(message.name):
        return False
    positions = zip(message.name, message.position, strict=True)
    return all(math.isfinite(value) for name, value in positions if not joints or name in joints)
