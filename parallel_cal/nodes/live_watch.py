"""Make samples of the joint states at rest, and follow the robot through them. This module does not
use ROS."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.samples import READING
from parallel_cal.watch.state import continue_watch, write_state
from parallel_cal.watch.watch import Watch

STATE_SUFFIX = ".live_watch.json"  # of the file beside the model
REST_S = 0.5  # s without motion after which a robot is at rest
MAX_REST_S = 5.0  # s of one rest that are averaged


class Rests:
    """Averages the readings of a robot each time that it rests at a new place.

    Examples
    --------
    >>> rests = Rests(threshold=1e-3)
    >>> [rests.add(t, np.array([q])) for t, q in ((0.0, 0.1), (0.6, 0.3), (1.2, 0.3001))]
    [None, None, None]
    >>> began, readings = rests.add(1.5, np.array([0.4]))  # it moves on
    >>> began, readings.round(5).tolist()
    (0.6, [0.30005])
    """

    def __init__(self, threshold: float):
        self.threshold = threshold
        self._begin: tuple[float, np.ndarray] | None = None
        self._readings: list[np.ndarray] = []
        self._last: np.ndarray | None = None  # the place of the last rest
        self._end = 0.0

    def add(self, time: float, readings: np.ndarray) -> tuple[float, np.ndarray] | None:
        """Take readings (n,) at a time, s; of a rest that has ended, return when it began and the
        mean of its readings."""
        if self._begin is not None:
            began, place = self._begin
            resting = bool(np.all(np.abs(readings - place) <= self.threshold))
            if resting and 0 <= time - began <= MAX_REST_S:
                self._readings.append(readings)
                self._end = time
                return None
        found = None
        if self._begin is not None and self._end - self._begin[0] >= REST_S:
            mean = np.mean(self._readings, axis=0)
            if self._last is None or np.any(np.abs(mean - self._last) > self.threshold):
                self._last, found = mean, (self._begin[0], mean)
        self._begin, self._readings, self._end = (time, readings), [readings], time
        return found


class LiveWatch:
    """Collects the rests of an interval as one recording, and adds it to the watch of a model.

    Parameters
    ----------
    model : Model
    path : Path
        The state file.
    interval : float
        Time that one recording covers, s. Without a rest for longer than this, it starts anew.
    samples : int
        The least number of rests of a recording.
    threshold : float
        Motion that ends a rest, rad or m.
    false_alarm_days : float
        Mean time between false alarms, days.
    """

    def __init__(
        self,
        model: Model,
        path: Path,
        interval: float,
        samples: int,
        threshold: float,
        false_alarm_days: float,
    ):
        self.model, self.path = model, path
        self.interval, self.samples = interval, samples
        self.watch, self.anew = continue_watch(path, model, false_alarm_days)
        self._rests = Rests(threshold)
        own = [sensor for sensor in model.sensors if sensor.reads_always]
        self.channels = tuple(channel for sensor in own for channel in sensor.channels)
        self._rows: list[tuple[float, np.ndarray, dict[str, float]]] = []

    def __len__(self) -> int:
        return len(self._rows)

    def collect(
        self, time: float, readings: Mapping[str, float], conditions: Mapping[str, float]
    ) -> Dataset | None:
        """Take a joint state; return the samples of an interval that is complete.

        Parameters
        ----------
        time : float
            s
        readings : mapping of str to float
            Readings of the joints and of passive joints by name, rad or m. It may lack encoders.
        conditions : mapping of str to float
            Conditions by name.
        """
        names = (*self.model.joints, *self.channels)
        row = np.array([readings.get(name, np.nan) for name in names])
        known = np.isfinite(row)
        if not known[: len(self.model.joints)].all():
            return None
        rest = self._rests.add(time, np.where(known, row, 0.0))
        if rest is None:
            return None
        began, mean = rest
        if self._rows and not 0 <= began - self._rows[-1][0] <= self.interval:
            self._rows = []  # the robot was away: what came before is not of one recording
        self._rows.append((began, np.where(known, mean, np.nan), dict(conditions)))
        if len(self._rows) < self.samples or began - self._rows[0][0] < self.interval:
            return None
        rows, self._rows = self._rows, []
        return self._make_dataset(rows)

    def add(self, dataset: Dataset) -> Watch:
        """Follow the robot through these samples, and write the state."""
        name = f"{len(dataset)} rests"
        self.watch = self.watch.add(dataset, float(dataset.time[0]), name=name)
        write_state(self.watch, self.path)
        return self.watch

    def _make_dataset(self, rows: list[tuple[float, np.ndarray, dict[str, float]]]) -> Dataset:
        n = len(self.model.joints)
        read = np.array([row[1] for row in rows])
        shared = set.intersection(*(set(row[2]) for row in rows))
        conditions = {name: np.array([row[2][name] for row in rows]) for name in sorted(shared)}
        conditions["time"] = np.array([row[0] for row in rows])
        for k, channel in enumerate(self.channels):
            conditions[READING + channel] = read[:, n + k]
        return Dataset.from_arrays(
            self.model.joints,
            read[:, :n],
            np.zeros((len(rows), 3)),
            measured=np.zeros(6, bool),
            conditions=conditions,
            source="joint_states",
        )
