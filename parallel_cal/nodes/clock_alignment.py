"""Keeps a stream's stamps related to the joints' as they were, whoever's clock is set anew.

What is compared was received at the same moment. Knows nothing of ROS; times in ns.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from statistics import median

from parallel_cal.base.keyed_warning import KeyedWarning
from parallel_cal.nodes.gate import (
    MAX_STAMP_JUMP_NS,
    MIN_AGREEING_MESSAGES,
    PUBLISHER_TIMEOUT_NS,
    StampedMessage,
)

MAX_JOINT_STATES = 50_000  # joint states whose times are remembered
N_RECENT_OFFSETS = 50  # messages that tell how two clocks are related


class JointClock:
    """What stamp joint states had when; `heard` in the order in which they were received."""

    def __init__(self) -> None:
        self._logs: list[int] = []
        self._stamps: list[int] = []
        self.leaps = 0  # of more than a second from one stamp to the next

    @property
    def until(self) -> int:
        """When the last joint state was received."""
        return self._logs[-1]

    def add(self, stamp: int, log: int) -> None:
        if not stamp:
            return
        if len(self._logs) > 2 * MAX_JOINT_STATES:
            del self._logs[:MAX_JOINT_STATES], self._stamps[:MAX_JOINT_STATES]
        if self._logs and log < self.until:  # the time of receiving was set back
            self._logs, self._stamps = [], []
        self.leaps += bool(self._stamps and abs(stamp - self._stamps[-1]) > MAX_STAMP_JUMP_NS)
        self._logs.append(log)
        self._stamps.append(stamp)

    def at(self, log: int) -> int | None:
        """The stamp of a joint state received then; None before the first one."""
        i = bisect_right(self._logs, log)
        if i == 0:
            return None
        before, stamp = self._logs[i - 1], self._stamps[i - 1]
        if i == len(self._logs):
            return stamp + log - before
        share = (log - before) / max(self._logs[i] - before, 1)
        return stamp + round(share * (self._stamps[i] - stamp))


class ClockAlignment:
    """One stream beside the joints: where either's stamps leap, a message is held back while it is
    more than a second nearer to the joints, or further off, than those before it.

    Where several agree on that, one of the two clocks was set: the stream's stamps are moved along
    from then on. Otherwise it was astray, and counts in `strays`. What only comes late leaps not.
    """

    def __init__(self, name: str, joints: JointClock):
        self._name, self._joints = name, joints
        self._apart: deque[int] = deque(maxlen=N_RECENT_OFFSETS)
        self._held: list[StampedMessage] = []
        self._last: StampedMessage | None = None
        self._moved = self._leaps = 0
        self.strays = 0
        self.trouble = ""

    def take(self, said: Sequence[StampedMessage]) -> list[StampedMessage]:
        """The messages that may go on now, with the stamps that count."""
        waiting, self._held, passed = (
            [*self._held, *said],
            list[StampedMessage](),
            list[StampedMessage](),
        )
        for one in waiting:
            if self._fits(one):
                self._stray(len(self._held))
                self._held = []
                passed.append(self._release(one))
            else:
                self._held.append(one)
        if self._has_agreement():
            passed += self._release_shifted()
        return passed

    def _release(self, one: StampedMessage) -> StampedMessage:
        apart = self._distance(one)
        if apart is not None:
            self._apart.append(apart)
        self._last, self._leaps = one, self._joints.leaps
        return replace(one, stamp=one.stamp and one.stamp - self._moved)

    def _distance(self, one: StampedMessage) -> int | None:
        """By how much it is stamped later than the joint state of its moment."""
        joints = self._joints.at(one.log)
        return one.stamp - self._moved - joints if one.stamp and joints is not None else None

    def _fits(self, one: StampedMessage) -> bool:
        last, apart = self._last, self._distance(one)
        if last is None or apart is None or not self._apart:
            return True
        goes_on = (
            self._leaps == self._joints.leaps and abs(one.stamp - last.stamp) <= MAX_STAMP_JUMP_NS
        )
        return goes_on or abs(apart - self._apart[-1]) <= MAX_STAMP_JUMP_NS

    def _has_agreement(self) -> bool:
        """Whether enough agree, for long enough, and joint states that came meanwhile say so."""
        held = self._held
        if len(held) < MIN_AGREEING_MESSAGES or held[-1].log - held[0].log < PUBLISHER_TIMEOUT_NS:
            return False
        apart = [a for a in map(self._distance, held) if a is not None]
        return (
            self._joints.until >= held[MIN_AGREEING_MESSAGES - 1].log
            and max(apart) - min(apart) <= MAX_STAMP_JUMP_NS
        )

    def _release_shifted(self) -> list[StampedMessage]:
        held, self._held = self._held, []
        by = round(median(a for a in map(self._distance, held) if a is not None))
        by -= round(median(self._apart))
        self._moved += by
        words = (
            f"{self._name}: its clock or the joints' clock was set by {by * 1e-9:+.3f} s; its "
            f"stamps are corrected by {-self._moved * 1e-9:+.3f} s"
        )
        self.trouble = KeyedWarning(words, "clock set", self._name)
        return [self._release(one) for one in held]

    def _stray(self, n: int) -> None:
        if n:
            self.strays += n
            words = (
                f"{self._name}: {self.strays} messages dropped: their offset to the joint states' "
                "stamps changed by more than a second"
            )
            self.trouble = KeyedWarning(words, "stamps off the joints'", self._name)
