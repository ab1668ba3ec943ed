"""Keep the offset between a stream's stamps and the joint states' stamps when a clock is set.

The order of reception is compared, not its times: a message's stamp lies between the stamps of the
joint states that were received before and after it, whether they come in real time, from a
recording that is played ten times as fast, or after a gap. This module does not use ROS. Times are
in ns.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

from parallel_cal.base.keyed_warning import KeyedWarning
from parallel_cal.recordings.gate import (
    MAX_STAMP_JUMP_NS,
    MIN_AGREEING_MESSAGES,
    PUBLISHER_TIMEOUT_NS,
    StampedMessage,
)

MAX_JOINT_STATES = 50_000  # joint states whose times are remembered
N_RECENT_OFFSETS = 50  # messages that relate two clocks


class OffsetRange(NamedTuple):
    """Limits of a stamp minus the joint states' stamp at the same moment."""

    low: int
    high: int

    @property
    def middle(self) -> int:
        return (self.low + self.high) // 2

    @property
    def is_narrow(self) -> bool:
        """Whether it tells the offset; it does not in a gap of the joint states."""
        return abs(self.high - self.low) <= MAX_STAMP_JUMP_NS

    def allows(self, offset: int) -> bool:
        return self.low - MAX_STAMP_JUMP_NS <= offset <= self.high + MAX_STAMP_JUMP_NS


class JointClock:
    """The stamps of the joint states and the times at which they were received."""

    def __init__(self) -> None:
        self._logs: list[int] = []
        self._stamps: list[int] = []
        self.leaps = 0  # jumps of more than a second from one stamp to the next

    def add(self, stamp: int, log: int) -> None:
        """Add a joint state that has a stamp and was received at the time `log`."""
        if not stamp:
            return
        if len(self._logs) > 2 * MAX_JOINT_STATES:
            del self._logs[:MAX_JOINT_STATES], self._stamps[:MAX_JOINT_STATES]
        if self._logs and log < self._logs[-1]:  # the receiving computer's clock was set back
            self._logs, self._stamps = [], []
        self.leaps += bool(self._stamps and abs(stamp - self._stamps[-1]) > MAX_STAMP_JUMP_NS)
        self._logs.append(log)
        self._stamps.append(stamp)

    def neighbours(self, log: int) -> tuple[int | None, int | None]:
        """Return the stamps of the joint states received last before `log` and first after it."""
        i = bisect_right(self._logs, log)
        before = self._stamps[i - 1] if i else None
        return before, self._stamps[i] if i < len(self._stamps) else None


class ClockAlignment:
    """Correct the stamps of one stream after its clock or the joints' clock was set.

    After a jump of the stamps, a message is held back until a joint state follows it. If its offset
    to the joint states' stamps then differs by more than a second from the offset before, it stays
    held back. If several such messages agree, one of the clocks was set, and all later stamps are
    corrected by the difference. If they do not agree, those that continue in the next message that
    fits were only late; the others are dropped and counted in `strays`.
    """

    def __init__(self, name: str, joints: JointClock):
        self._name, self._joints = name, joints
        self._offsets: deque[int] = deque(maxlen=N_RECENT_OFFSETS)
        self._unrelated: deque[StampedMessage] = deque(maxlen=N_RECENT_OFFSETS)
        self._held: list[StampedMessage] = []
        self._misfits = 0  # of the held messages, those that were judged: the first ones
        self._last: StampedMessage | None = None
        self._moved = self._leaps = 0
        self._in_doubt = False  # a clock may have been set since the last narrow offset
        self.strays = 0
        self.trouble = ""

    def take(self, received: Sequence[StampedMessage]) -> list[StampedMessage]:
        """Take messages in; return those that can be used now, with corrected stamps."""
        self._learn_offsets()
        released, waiting = list[StampedMessage](), [*self._held[self._misfits :], *received]
        del self._held[self._misfits :]
        for i, message in enumerate(waiting):
            fits = self._fits(message)
            if fits is None:  # nor can those after it be judged
                self._held += waiting[i:]
                break
            if not fits:
                self._held.append(message)
                self._misfits += 1
                continue
            held = self._take_held()
            steps = (b.stamp - a.stamp for a, b in pairwise([*held, message]))
            if all(abs(step) <= MAX_STAMP_JUMP_NS for step in steps):  # they were only late
                released += map(self._release, held)
            else:
                self._drop(held)
            released.append(self._release(message))
        if self._misfits > MAX_JOINT_STATES:
            self._drop(self._held[:N_RECENT_OFFSETS])
            del self._held[:N_RECENT_OFFSETS]
            self._misfits -= N_RECENT_OFFSETS
        return released + self._release_agreeing()

    def _take_held(self) -> list[StampedMessage]:
        held, self._held, self._misfits = self._held, [], 0
        return held

    def _drop(self, messages: Sequence[StampedMessage]) -> None:
        if not messages:
            return
        self.strays += len(messages)
        words = (
            f"{self._name}: {self.strays} messages dropped: their offset to the joint states' "
            "stamps changed by more than a second"
        )
        self.trouble = KeyedWarning(words, "stamps off the joints'", self._name)

    def _release(self, message: StampedMessage) -> StampedMessage:
        self._last = message if message.stamp else self._last
        corrected = replace(message, stamp=message.stamp and message.stamp - self._moved)
        self._unrelated.append(corrected)
        return corrected

    def _learn_offsets(self) -> None:
        """Learn the offsets of the released messages that a joint state has followed, unless the
        joints' clock may have been set meanwhile."""
        if self._leaps != self._joints.leaps:
            self._leaps, self._in_doubt = self._joints.leaps, True
            self._unrelated.clear()
        while self._unrelated:
            before, after = self._joints.neighbours(self._unrelated[0].log)
            if before is not None and after is None:
                return
            message = self._unrelated.popleft()
            offset = _offset_range(message.stamp, before, after)
            if offset is not None and offset.is_narrow:
                self._offsets.append(offset.middle)

    @property
    def _offset_before(self) -> int:
        """The offset while the clocks agreed: messages arrive late, but never early."""
        return max(self._offsets)

    def _fits(self, message: StampedMessage) -> bool | None:
        """Whether a message may pass; None until a joint state has followed it."""
        last = self._last
        before, after = self._joints.neighbours(message.log)
        if last is None or not self._offsets or not message.stamp or before is None:
            return True
        self._in_doubt |= abs(message.stamp - last.stamp) > MAX_STAMP_JUMP_NS
        if not self._in_doubt:
            return True
        offset = _offset_range(message.stamp - self._moved, before, after)
        if offset is None or not offset.allows(self._offset_before):
            return None if offset is None else False
        self._in_doubt = not offset.is_narrow
        return True

    def _release_agreeing(self) -> list[StampedMessage]:
        """Release the last misfits if enough of them agree for long enough: one of the clocks was
        set. Correct later stamps by the change of the offset, and drop the misfits before them."""
        found, first = list[int](), self._misfits
        while first:
            message = self._held[first - 1]
            neighbours = self._joints.neighbours(message.log)
            offset = _offset_range(message.stamp - self._moved, *neighbours)
            if offset is not None and offset.is_narrow:
                if found and abs(offset.middle - found[0]) > MAX_STAMP_JUMP_NS:
                    break
                found.append(offset.middle)
            first -= 1
        agreeing = self._held[first : self._misfits]
        if (
            len(found) < MIN_AGREEING_MESSAGES
            or agreeing[-1].log - agreeing[0].log < PUBLISHER_TIMEOUT_NS
        ):
            return []
        by = max(found) - self._offset_before
        held = self._take_held()
        self._drop(held[:first])
        self._moved += by
        self._in_doubt = False
        words = (
            f"{self._name}: its clock or the joints' clock was set by {by * 1e-9:+.3f} s; its "
            f"stamps are corrected by {-self._moved * 1e-9:+.3f} s"
        )
        self.trouble = KeyedWarning(words, "clock set", self._name)
        return [self._release(message) for message in held[first:]]


def _offset_range(stamp: int, before: int | None, after: int | None) -> OffsetRange | None:
    """Return the limits of a stamp's offset; None while a joint state or the stamp is missing."""
    if not stamp or before is None or after is None:
        return None
    return OffsetRange(*sorted((stamp - before, stamp - after)))
