"""Keep the offset between a stream's stamps and the joint states' stamps when a clock is set.

Stamps are compared at the same time of receiving. This module does not use ROS. Times are in ns.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from statistics import median

from parallel_cal.base.keyed_warning import KeyedWarning
from parallel_cal.recordings.gate import (
    MAX_STAMP_JUMP_NS,
    MIN_AGREEING_MESSAGES,
    PUBLISHER_TIMEOUT_NS,
    StampedMessage,
)

MAX_JOINT_STATES = 50_000  # joint states whose times are remembered
N_RECENT_OFFSETS = 50  # messages whose median offset relates two clocks


class JointClock:
    """The stamps of the joint states and the times at which they were received."""

    def __init__(self) -> None:
        self._logs: list[int] = []
        self._stamps: list[int] = []
        self.leaps = 0  # jumps of more than a second from one stamp to the next

    @property
    def until(self) -> int:
        """Time at which the last joint state was received."""
        return self._logs[-1]

    def add(self, stamp: int, log: int) -> None:
        """Add a joint state that has a stamp and was received at the time `log`."""
        if not stamp:
            return
        if len(self._logs) > 2 * MAX_JOINT_STATES:
            del self._logs[:MAX_JOINT_STATES], self._stamps[:MAX_JOINT_STATES]
        if self._logs and log < self.until:  # the receiving computer's clock was set back
            self._logs, self._stamps = [], []
        self.leaps += bool(self._stamps and abs(stamp - self._stamps[-1]) > MAX_STAMP_JUMP_NS)
        self._logs.append(log)
        self._stamps.append(stamp)

    def at(self, log: int) -> int | None:
        """Interpolate the joint states' stamp at a time of receiving; None before the first one."""
        i = bisect_right(self._logs, log)
        if i == 0:
            return None
        before, stamp = self._logs[i - 1], self._stamps[i - 1]
        if i == len(self._logs):
            return stamp + log - before
        share = (log - before) / max(self._logs[i] - before, 1)
        return stamp + round(share * (self._stamps[i] - stamp))


class ClockAlignment:
    """Correct the stamps of one stream after its clock or the joints' clock was set.

    After a jump of the stamps, a message is held back if its offset to the joint states' stamps
    differs by more than a second from the offset before. If several such messages agree, one of the
    clocks was set, and all later stamps are corrected by the difference. If they do not agree, they
    are dropped and counted in `strays`. A message that only arrives late has no jump in its stamp.
    """

    def __init__(self, name: str, joints: JointClock):
        self._name, self._joints = name, joints
        self._offsets: deque[int] = deque(maxlen=N_RECENT_OFFSETS)
        self._held: list[StampedMessage] = []
        self._last: StampedMessage | None = None
        self._moved = self._leaps = 0
        self.strays = 0
        self.trouble = ""

    def take(self, received: Sequence[StampedMessage]) -> list[StampedMessage]:
        """Take messages in; return those that can be used now, with corrected stamps."""
        waiting, self._held = [*self._held, *received], list[StampedMessage]()
        released = list[StampedMessage]()
        for message in waiting:
            if self._fits(message):
                if self._held:
                    self.strays += len(self._held)
                    self._held = []
                    words = (
                        f"{self._name}: {self.strays} messages dropped: their offset to the joint "
                        "states' stamps changed by more than a second"
                    )
                    self.trouble = KeyedWarning(words, "stamps off the joints'", self._name)
                released.append(self._release(message))
            else:
                self._held.append(message)
        if self._has_agreement():
            released += self._release_shifted()
        return released

    def _release(self, message: StampedMessage) -> StampedMessage:
        offset = self._offset(message)
        if offset is not None:
            self._offsets.append(offset)
        self._last, self._leaps = message, self._joints.leaps
        return replace(message, stamp=message.stamp and message.stamp - self._moved)

    def _offset(self, message: StampedMessage) -> int | None:
        """Return the corrected stamp minus that of a joint state received at the same time."""
        joints = self._joints.at(message.log)
        if not message.stamp or joints is None:
            return None
        return message.stamp - self._moved - joints

    def _fits(self, message: StampedMessage) -> bool:
        last, offset = self._last, self._offset(message)
        if last is None or offset is None or not self._offsets:
            return True
        jump = abs(message.stamp - last.stamp) > MAX_STAMP_JUMP_NS
        if self._leaps == self._joints.leaps and not jump:
            return True
        return abs(offset - self._offsets[-1]) <= MAX_STAMP_JUMP_NS

    def _has_agreement(self) -> bool:
        """Check that enough held messages agree for long enough.

        The joint states must reach into the same time: an offset beyond them is extrapolated.
        """
        held = self._held
        if len(held) < MIN_AGREEING_MESSAGES or held[-1].log - held[0].log < PUBLISHER_TIMEOUT_NS:
            return False
        offsets = [offset for offset in map(self._offset, held) if offset is not None]
        return (
            self._joints.until >= held[MIN_AGREEING_MESSAGES - 1].log
            and max(offsets) - min(offsets) <= MAX_STAMP_JUMP_NS
        )

    def _release_shifted(self) -> list[StampedMessage]:
        """Correct later stamps by the change of the median offset; release what was held."""
        held, self._held = self._held, []
        by = round(median(offset for offset in map(self._offset, held) if offset is not None))
        by -= round(median(self._offsets))
        self._moved += by
        words = (
            f"{self._name}: its clock or the joints' clock was set by {by * 1e-9:+.3f} s; its "
            f"stamps are corrected by {-self._moved * 1e-9:+.3f} s"
        )
        self.trouble = KeyedWarning(words, "clock set", self._name)
        return [self._release(message) for message in held]
