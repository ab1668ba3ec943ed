"""Live collection of samples: what arrives, what it comes to, what a person keeps of it.

ROS-free. A replayed recording gives the samples that `load_dataset` makes of its bag, because the
messages take the same way: cleaning, dwells, conditions, replicates.
"""

from __future__ import annotations

import dataclasses
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
from parallel_cal.nodes.gate import Gate, StampedMessage
from parallel_cal.nodes.inbox import Inbox
from parallel_cal.nodes.journal import Entry, Part
from parallel_cal.recordings.channels import CHANNELS, list_channels, stamp_of
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.joining import fingerprint, join_datasets
from parallel_cal.recordings.loading import load_dataset, order_joints
from parallel_cal.recordings.options import SampleOptions
from parallel_cal.recordings.recording import Dropped

# Joint states in an inbox, a quarter of an hour at 100 Hz; then samples stay and messages go:
# memory has a bound.
MAX_JOINT_STATES = 100_000
SETTLING_TIME_NS = 1_000_000_000  # ns after which a stream is where the joints are, jump or not
MIN_DROPS_TO_WARN = 20  # messages or dwells dropped for one reason that are worth a warning


@dataclass(frozen=True)
class Collection:
    """The samples in use with their numbers and stamps (ns; since 0 for those of a file)."""

    dataset: Dataset
    ids: NDArray[np.int64]
    stamps: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.ids)


class Collector:
    """Buffers messages by channel and makes samples of them when asked."""

    def __init__(
        self,
        joints: Sequence[str] | None = None,
        options: SampleOptions | None = None,
        topics: Mapping[str, str] | None = None,
        auto: bool = True,
    ):
        self.joints, self.options, self.auto = joints, options or SampleOptions(), auto
        self.received: Counter[str] = Counter()
        self._topics, self._numbers = dict(topics or {}), count(1)
        self._past_paired = self._past_dropped = self._past_lost = self._past_strays = 0
        self._restart()

    def configure(self, joints: Sequence[str] | None, options: SampleOptions, auto: bool) -> None:
        """Change joints or options; samples still made of messages are made anew."""
        self.auto = auto
        if (joints, options) != (self.joints, self.options):
            self.joints, self.options = joints, options
            for inbox in self._inboxes:
                inbox.forget()

    def _restart(self) -> None:
        self._inboxes = [Inbox(self._topics, self._numbers)]
        self._at = dict.fromkeys(CHANNELS, self._inboxes[0])
        self._words: list[tuple[str, int, Any]] = []
        self._gates: dict[tuple[str, tuple[str, ...]], Gate] = {}
        self._related: dict[tuple[str, tuple[str, ...]], ClockAlignment] = {}
        self._clock, self._moved = JointClock(), 0

    # ------------------------------------------------------------------ messages in

    def receive(self, channel: str, message: Any, log_ns: int, sequence: int = 0) -> None:
        """Buffer one message of a channel; `log_ns`, when it was received, serves where its header
        has no stamp. Words have no header at all: they go with the next joint state."""
        self.received[channel] += 1
        kind, stamp = CHANNELS[channel].kind, stamp_of(message)
        if kind == "words":
            self._words.append((channel, log_ns, message))
        elif kind == "condition":  # a number every minute, or once: no stream to stray from
            self._buffer(channel, message, log_ns, stamp)
        else:
            stream = self._stream(channel, message)
            gate = self._gates.setdefault(stream, Gate(channel))
            self._pass_on(stream, gate.take(stamp, log_ns, sequence, message))

    def _pass_on(self, stream: tuple[str, tuple[str, ...]], said: Sequence[StampedMessage]) -> None:
        """Buffer what a gate lets through, by the clock of the joints."""
        channel = stream[0]
        if channel == "joint_states":
            for one in said:
                self._clock.add(one.stamp, one.log)
        else:
            related = self._related.setdefault(stream, ClockAlignment(channel, self._clock))
            said = related.take(said)
        for one in said:
            self._buffer(channel, one.message, one.log, one.stamp)

    def _stream(self, channel: str, message: Any) -> tuple[str, tuple[str, ...]]:
        """Each has a publisher of its own: other joints, and each sensor's readings, may be."""
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
        """Messages that were sent and never came."""
        return self._past_lost + sum(gate.lost for gate in self._gates.values())

    @property
    def strays(self) -> int:
        """Messages that came and fit no stream."""
        return self._past_strays + sum(watch.strays for watch in self._watches)

    @property
    def _watches(self) -> list[Gate | ClockAlignment]:
        return [*self._gates.values(), *self._related.values()]

    def warnings(self) -> list[str]:
        """Whatever makes the samples suspicious: a sentence each."""
        made = [inbox.dataset for inbox in self._inboxes if inbox.dataset is not None]
        said = [warning for dataset in made for warning in dataset.warnings]
        dropped = Counter[str]()
        for dataset in made:
            for item in dataset.dropped:
                dropped[item.reason] += item.count
        said += [
            KeyedWarning(f"{n} dropped: {why}", "dropped", why)
            for why, n in dropped.items()
            if n >= MIN_DROPS_TO_WARN
        ]
        said += [inbox.misfit for inbox in self._inboxes if inbox.misfit]
        said += [watch.trouble for watch in self._watches if watch.trouble]
        return list(dict.fromkeys(said))

    @property
    def frame(self) -> str:
        """The frame of the poses, empty while there are none."""
        made = [inbox.dataset for inbox in self._inboxes if inbox.dataset is not None]
        return made[-1].frame if made else ""

    def _buffer(self, channel: str, message: Any, log_ns: int, stamp: int) -> None:
        joints = self._at["joint_states"]
        if self._at[channel] is not joints and log_ns - self._moved > SETTLING_TIME_NS:
            self._at[channel] = joints
        if self._at[channel].jumps_back(channel, stamp):
            self._at[channel] = self._inbox_after(self._at[channel])
            if channel == "joint_states":
                self._moved = log_ns
        if channel == "joint_states":
            for name, log, word in self._words:
                self._at[channel].add(name, 0, log, word)
            self._words.clear()
        self._at[channel].add(channel, stamp, log_ns, message)

    def _inbox_after(self, inbox: Inbox) -> Inbox:
        """Every stream changes to a new clock at its own time, but all to the same inbox."""
        if inbox is self._inboxes[-1]:
            self._inboxes.append(Inbox(self._topics, self._numbers))
        return self._inboxes[self._inboxes.index(inbox) + 1]

    def refresh(self, now_ns: int | None = None) -> bool:
        """Make samples of what came in; True if anything did. `now_ns` where more may come."""
        for stream, gate in self._gates.items():
            self._pass_on(stream, gate.flush(now_ns))
        changed = [s.refresh(self.joints, self.options) for s in self._inboxes]
        live = self._at["joint_states"]
        if len(live.raws["joint_states"].stamp) > MAX_JOINT_STATES:
            self._begin_inbox(live)
        poses = [c for c in list_channels("poses") if self.received[c]]
        heard = poses[:1] + [c for c in list_channels("readings") if self.received[c]]
        in_use = [self._at[channel] for channel in ("joint_states", *heard)]
        first = min(self._inboxes.index(s) for s in in_use)
        for inbox in self._inboxes[:first]:
            inbox.close()
        return any(changed)

    def _begin_inbox(self, live: Inbox) -> None:
        """A new inbox in the middle of a motion, so that no dwell is cut; with the last
        conditions and constraint."""
        if len(live.raws["joint_states"].stamp) < 2 * MAX_JOINT_STATES:
            with suppress(DatasetError):  # it moves
                live.current(self.options)
                return
        new = Inbox(self._topics, self._numbers)
        new.inherit(live, list_channels("condition", "words"))
        self._inboxes.append(new)
        self._at = dict.fromkeys(CHANNELS, new)

    # ------------------------------------------------------------------ samples out

    def collection(self) -> Collection:
        """The samples in use; DatasetError says why there is none."""
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
            raise DatasetError(self._why_empty())
        together = parts[0]
        if len(parts) > 1:
            together = join_datasets(parts, starts, self.options.replicate_tolerance)
        dataset = dataclasses.replace(
            together,
            sha256=together.sha256 or fingerprint(together),
            dropped=tuple(self.dropped()),
        )
        return Collection(dataset, np.concatenate(ids), np.concatenate(stamps))

    def _why_empty(self) -> str:
        if self.trouble and self.received:
            return self.trouble
        heard = ", ".join(f"{n} on {c}" for c, n in self.received.items()) or "none"
        choice = "" if self.auto else "; auto_collect is off, call take_sample to take a sample"
        return f"no samples yet; messages received: {heard}{choice}"

    def __len__(self) -> int:
        return sum(int(inbox.collected_mask(self.auto).sum()) for inbox in self._inboxes)

    @property
    def trouble(self) -> str:
        """Why the messages received last came to no samples, else empty."""
        return self._at["joint_states"].trouble

    @property
    def paired(self) -> int:
        return self._past_paired + sum(s.paired for s in self._inboxes)

    @property
    def dropped_poses(self) -> int:
        return self._past_dropped + sum(s.dropped for s in self._inboxes)

    def dropped(self) -> list[Dropped]:
        """Everything that was received and is not used, with the reason."""
        return [d for inbox in self._inboxes for d in inbox.reasons()]

    # ------------------------------------------------------------------ what a person wants

    def take(self) -> int:
        """Take the dwell going on; its number. DatasetError says why there is none."""
        self.refresh()
        inbox = self._at["joint_states"]
        number = inbox.current(self.options)
        inbox.removed = [i for i in inbox.removed if i != number]
        if number not in inbox.taken:
            inbox.taken.append(number)
        return number

    def remove(self, number: int) -> None:
        """Leave a sample out; DatasetError for a number that is not in the collection."""
        for inbox in self._inboxes:
            if number in inbox.ids[inbox.collected_mask(self.auto)]:
                inbox.removed.append(number)
                return
        raise DatasetError(f"no sample {number} in the collection; list_samples shows them")

    def clear(self) -> int:
        """Forget all samples and messages; how many samples there were."""
        samples, paired, dropped = len(self), self.paired, self.dropped_poses
        self._past_paired, self._past_dropped = paired, dropped
        self._past_lost, self._past_strays = self.lost, self.strays
        self._restart()
        return samples

    def save(self, path: str | Path) -> int:
        """Write the samples to a file, all or nothing; how many."""
        collection = self.collection()
        try:
            collection.dataset.to_json(path)
        except OSError as error:
            raise DatasetError(f"{path}: cannot be written: {error.strerror}") from None
        return len(collection)

    def entries(self) -> dict[int, Entry]:
        """Every sample in use, as a journal takes it."""
        return {
            int(inbox.ids[i]): Entry(inbox.dataset, int(i), inbox.start_ns)
            for inbox in self._inboxes
            if inbox.dataset is not None
            for i in np.flatnonzero(inbox.collected_mask(self.auto))
        }

    def resume(self, parts: Sequence[Part]) -> int:
        """Begin with the samples of a journal, under their numbers; how many. DatasetError, and
        no sample, where they are of other joints."""
        ordered = [order_joints(part.dataset, self.joints) for part in parts]
        ids = [number for part in parts for number in part.ids]
        self._numbers = count(max(ids, default=0) + 1)
        self._restart()
        for k, (part, dataset) in enumerate(zip(parts, ordered, strict=True)):
            self._inboxes.insert(k, Inbox.from_dataset(dataset, iter(part.ids), part.start_ns))
        return len(ids)

    def load(self, path: str | Path) -> int:
        """Replace the collection by the samples of a file or a bag; on failure keep it."""
        dataset = load_dataset(path, joints=self.joints)
        self.clear()
        self._inboxes.insert(0, Inbox.from_dataset(dataset, self._numbers))
        return len(dataset)
