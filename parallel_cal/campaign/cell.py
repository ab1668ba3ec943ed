"""What a campaign asks of a robot with its measuring device, and how it is held or ended."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from threading import Condition
from typing import Protocol

import numpy as np

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.campaign.trajectory import Trajectory
from parallel_cal.recordings.dataset import Dataset

POLL_INTERVAL_S = 0.05  # s between two looks at whether it is still wanted


class CellError(ParallelCalError):
    """The robot or the device does not do what it was asked for; it is stopped."""


class PauseRequested(Exception):
    """Somebody wants a pause."""


class AbortRequested(Exception):
    """Somebody wants no more of it."""


@dataclass(frozen=True)
class Sample:
    """One sample, its time counted from `start_ns`."""

    dataset: Dataset
    start_ns: int = 0


@dataclass(frozen=True)
class Question:
    """A condition that a person is asked to change: its present value, and the value wanted."""

    condition: str
    value: float
    present: float
    unit: str

    def __str__(self) -> str:
        return f"change {self.condition} from {self.present:.3g} to {self.value:.3g} {self.unit}"


class Cell(Protocol):
    """A robot with its controller, and a device that measures its poses.

    What takes long calls `go_on` often, at least every 50 ms, which raises where the campaign is
    held or ended. CellError where something goes wrong.
    """

    def joints(self) -> np.ndarray:
        """Where the joints (nq,) are now."""

    def move(self, trajectory: Trajectory, go_on: Callable[[], None]) -> None:
        """Drive a trajectory, and wait until the robot rests at its end."""

    def stop(self) -> None:
        """Stop at once."""

    def sample(self, go_on: Callable[[], None]) -> Sample:
        """Measure where the robot rests."""

    def ask(self, words: str, conditions: Mapping[str, float], go_on: Callable[[], None]) -> None:
        """Have a person bring conditions about, and wait until that is done."""


class Control:
    """A campaign is held, goes on, or is ended, by whoever says so, from any thread."""

    def __init__(self, ended: Callable[[], bool] = lambda: False):
        """`ended`: whether somebody else has ended it."""
        self._changed, self._ended = Condition(), ended
        self._held = self._aborted = False

    @property
    def aborted(self) -> bool:
        return self._aborted or self._ended()

    @property
    def should_continue(self) -> bool:
        """Whether what is under way shall go on."""
        return not (self._held or self.aborted)

    def pause(self) -> None:
        self._set(held=True)

    def resume(self) -> None:
        self._set(held=False)

    def abort(self) -> None:
        self._set(held=False, aborted=True)

    def _set(self, held: bool, aborted: bool = False) -> None:
        with self._changed:
            self._held, self._aborted = held, self._aborted or aborted
            self._changed.notify_all()

    def check_interrupted(self) -> None:
        """Held or Aborted where that is wanted."""
        if self.aborted:
            raise AbortRequested
        if self._held:
            raise PauseRequested

    def wait(self) -> None:
        """Until it goes on; Aborted where it does not."""
        with self._changed:
            while self._held and not self.aborted:
                self._changed.wait(POLL_INTERVAL_S)
        self.check_interrupted()
