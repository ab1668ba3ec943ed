"""The interface of a campaign to the robot and its measuring device; pause and abort."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from threading import Condition
from typing import Protocol

import numpy as np

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.campaign.trajectory import Trajectory
from parallel_cal.recordings.dataset import Dataset

POLL_INTERVAL_S = 0.05  # s between two checks for a pause or an abort


class CellError(ParallelCalError):
    """The robot or the device failed; the robot is stopped."""


class UnansweredError(CellError):
    """The controller has not answered a motion, which may be lost."""


class UnseenError(CellError):
    """The robot rests at its target, but the device sees too little: the target is skipped."""


class PauseRequested(Exception):
    """A pause was requested."""


class AbortRequested(Exception):
    """An abort was requested."""


@dataclass(frozen=True)
class Sample:
    """One sample of a campaign.

    Parameters
    ----------
    dataset : Dataset
        A dataset with one sample. Its time counts from `start_ns`.
    start_ns : int
        Start of the recording, ns since 1970. Default 0.
    """

    dataset: Dataset
    start_ns: int = 0


@dataclass(frozen=True)
class Question:
    """A request to a person to change a condition from its `present` value to `value`."""

    condition: str
    value: float
    present: float
    unit: str

    def __str__(self) -> str:
        return f"change {self.condition} from {self.present:.3g} to {self.value:.3g} {self.unit}"


class Cell(Protocol):
    """A robot with its controller, and a device that measures its poses.

    A class with these methods is a cell: it needs no base class. A method that takes long calls
    `go_on` at least every 50 ms; `go_on` raises if the campaign is paused or aborted.

    Raises
    ------
    CellError
        By every method, on a fault.

    Examples
    --------
    >>> import numpy as np
    >>> class Simulated:
    ...     def joints(self):
    ...         return np.zeros(3)
    ...
    ...     def move(self, trajectory, go_on): ...
    ...     def stop(self): ...
    ...     def sample(self, go_on): ...
    ...     def ask(self, words, conditions, go_on): ...
    """

    def joints(self) -> np.ndarray:
        """Return the present joint readings (nq,)."""

    def move(self, trajectory: Trajectory, go_on: Callable[[], None]) -> None:
        """Execute a trajectory and wait until the robot rests at its end."""

    def stop(self) -> None:
        """Stop at once."""

    def sample(self, go_on: Callable[[], None]) -> Sample:
        """Take a sample at the present pose."""

    def ask(self, words: str, conditions: Mapping[str, float], go_on: Callable[[], None]) -> None:
        """Ask a person to set conditions, and wait until that is done."""


class Control:
    """Pause, resume or abort a campaign from any thread."""

    def __init__(self, ended: Callable[[], bool] = lambda: False):
        """`ended` tells whether the campaign was aborted elsewhere."""
        self._changed, self._ended = Condition(), ended
        self._paused = self._aborted = False

    @property
    def aborted(self) -> bool:
        return self._aborted or self._ended()

    @property
    def should_continue(self) -> bool:
        """Whether the present work shall continue."""
        return not (self._paused or self.aborted)

    def pause(self) -> None:
        self._set(paused=True)

    def resume(self) -> None:
        self._set(paused=False)

    def abort(self) -> None:
        self._set(paused=False, aborted=True)

    def _set(self, paused: bool, aborted: bool = False) -> None:
        with self._changed:
            self._paused, self._aborted = paused, self._aborted or aborted
            self._changed.notify_all()

    def check_interrupted(self) -> None:
        """Raise PauseRequested or AbortRequested if one was requested."""
        if self.aborted:
            raise AbortRequested
        if self._paused:
            raise PauseRequested

    def wait(self) -> None:
        """Wait until resumed; raise AbortRequested if aborted."""
        with self._changed:
            while self._paused and not self.aborted:
                self._changed.wait(POLL_INTERVAL_S)
        self.check_interrupted()
