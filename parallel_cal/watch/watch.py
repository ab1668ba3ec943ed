"""Follow a robot through its recordings, and name what has changed since its calibration."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from parallel_cal.base.confidence import SIGNIFICANCE_LEVEL
from parallel_cal.base.errors import DatasetError, FitError
from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.watch.changes import (
    DRIFT,
    MONTH,
    NOISE,
    Series,
    Weights,
    null_fits,
    predict_parameters,
    smallest_steps,
    weigh,
)
from parallel_cal.watch.visit import SIZES, WARMTH, WEAR, Visit, visit_of

DAY = 86400.0  # s
FALSE_ALARM_DAYS = 30.0  # mean time between false alarms, by default
MAX_VISITS = 500  # recordings that are kept one by one: the oldest ones become one
LEVEL = 0.95  # of the interval of the time of a change
TEMPERATURE = "temperature"  # the part that expansions name


@dataclass(frozen=True)
class Suspect:
    """One parameter that may have changed.

    Attributes
    ----------
    parameter, part, unit : str
        `part` is the joint, rod or line of the parameter.
    kind : str
        `step`, `drift`, `temperature` or `scatter`.
    probability : float
        Given that something has changed.
    value, sigma : float
        Change in SI units; of a drift, per day. Of a scatter, its standard deviation.
    """

    parameter: str
    part: str
    unit: str
    kind: str
    probability: float
    value: float
    sigma: float


@dataclass(frozen=True)
class Sight:
    """The smallest step of a parameter (SI) that raises an alarm at the next recording, if this one
    is like the last; infinite if no step of up to ten tolerances does."""

    parameter: str
    unit: str
    step: float


@dataclass(frozen=True)
class Misfit:
    """The rms of the residuals, in units of what noise and calibration let expect, and the
    probability of a larger one by chance."""

    ratio: float
    p_value: float


@dataclass(frozen=True)
class Point:
    """The statistic R (s) after a recording at `time` (s since 1970)."""

    recording: str
    time: float
    statistic: float
    samples: int


@dataclass(frozen=True)
class Watch:
    """The recordings of one robot since its calibration, in order of time.

    Attributes
    ----------
    model : Model
        The calibrated model.
    false_alarm_days : float
        Mean time between false alarms, days.
    visits : tuple of Visit
        The evidence of each recording.
    trend : tuple of Point
        The statistic after each recording.
    """

    model: Model
    false_alarm_days: float = FALSE_ALARM_DAYS
    visits: tuple[Visit, ...] = ()
    trend: tuple[Point, ...] = ()
    _weights: list[Weights] = field(default_factory=list, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not 0 < self.false_alarm_days < np.inf:
            raise FitError(
                f"false alarms every {self.false_alarm_days} days: expected a number above 0"
            )

    def add(
        self, dataset: Dataset, time: float, joint_sigma: float | None = None, name: str = ""
    ) -> Watch:
        """Take one more recording.

        Parameters
        ----------
        dataset : Dataset
            Samples of ordinary motion. Poses need not be measured.
        time : float
            When it was recorded, s since 1970.
        joint_sigma : float, optional
            Standard deviation of joint readings, rad or m. Default: that of recording or model.
        name : str, optional
            Name of the recording. Default: its source.

        Returns
        -------
        Watch

        Raises
        ------
        DatasetError
            If the recording is older than the last one.
        FitError
            If it tells nothing: forward kinematics uses all its readings.
        """
        name = name or dataset.source
        if self.visits and time <= self.visits[-1].time:
            earlier = (self.visits[-1].time - time) / DAY
            when = f"{earlier:.3g} days before" if earlier else "at the same time as"
            raise DatasetError(
                f"{name} was recorded {when} {self.visits[-1].name}, which was taken before: give "
                "the recordings in order of time"
            )
        visit = visit_of(
            self.model,
            dataset,
            time,
            joint_sigma=joint_sigma,
            expected=predict_parameters(self.series) if self.visits else None,
            noise=self.visits[-1].noise if self.visits else None,
        )
        visits = (*self.visits, replace(visit, name=name))
        if len(visits) > MAX_VISITS:
            visits = (visits[0].merge(visits[1]), *visits[2:])
        weights = weigh(Series.of(visits, self.model))
        point = Point(name, time, float(np.exp(min(weights.log_statistic, 700.0))), len(dataset))
        return replace(self, visits=visits, trend=(*self.trend, point), _weights=[weights])

    def without_last(self) -> Watch:
        """The watch before its last recording; DatasetError if it has none."""
        if not self.visits:
            raise DatasetError("the watch has no recording that could be taken back")
        return replace(self, visits=self.visits[:-1], trend=self.trend[:-1], _weights=[])

    @cached_property
    def series(self) -> Series:
        return Series.of(self.visits, self.model)

    @cached_property
    def weights(self) -> Weights:
        return self._weights[0] if self._weights else weigh(self.series)

    @property
    def alarm(self) -> Point | None:
        """The first recording at which the statistic exceeded the mean time between false
        alarms."""
        limit = self.false_alarm_days * DAY
        return next((point for point in self.trend if point.statistic >= limit), None)

    @cached_property
    def suspects(self) -> tuple[Suspect, ...]:
        """What may have changed, the most probable first."""
        names, table = (*self.series.names, NOISE), self._table
        found = []
        for kind, of in self.weights.kinds.items():
            share = of.share.sum(axis=(0, 2))
            for k in np.flatnonzero(share > 1e-6):
                own = of.share[:, k] / share[k]
                value = float(np.sum(own * of.value[:, k]))
                square = np.sum(own * (of.sigma[:, k] ** 2 + of.value[:, k] ** 2))
                sigma = float(np.sqrt(max(square - value**2, 0.0)))
                size, unit = table.get(names[k], (1.0, "1"))
                if kind == DRIFT:
                    size *= DAY / MONTH
                found.append(
                    Suspect(
                        names[k],
                        part_of(names[k]),
                        unit,
                        kind,
                        float(share[k]),
                        size * value,
                        size * sigma,
                    )
                )
        return tuple(sorted(found, key=lambda one: -one.probability))

    @property
    def _table(self) -> dict[str, tuple[float, str]]:
        """Tolerance and unit of each candidate."""
        names = set(self.series.names)
        known = {p.name: (p.prior_sigma, p.unit) for p in self.model.table}
        lacking = {name.split(".")[0] for name in names - set(known)}
        for effect in lacking:
            known |= {p.name: (p.prior_sigma, p.unit) for p in self.model.with_effect(effect).table}
        return known

    @property
    def parts(self) -> dict[str, float]:
        """Probability of each joint, rod or line, given that something has changed."""
        found: dict[str, float] = {}
        for one in self.suspects:
            found[one.part] = found.get(one.part, 0.0) + one.probability
        return dict(sorted(found.items(), key=lambda item: -item[1]))

    def since(self, part: str) -> tuple[float, float]:
        """The interval (s since 1970, 95 %) in which a part began to change."""
        names = (*self.series.names, NOISE)
        own = np.array([part_of(name) == part for name in names])
        share = sum(
            of.share[:, own[: of.share.shape[1]]].sum(axis=(1, 2))
            for of in self.weights.kinds.values()
        )
        below = np.cumsum(share) / np.sum(share)
        first = int(np.searchsorted(below, (1 - LEVEL) / 2))
        last = min(int(np.searchsorted(below, (1 + LEVEL) / 2)), len(below) - 1)
        time = self.series.time
        return float(time[max(first - 1, 0)]), float(time[last])

    def estimate(self, parameter: str) -> tuple[np.ndarray, np.ndarray]:
        """What each recording (K,) says of a parameter beside those before its change, if nothing
        else has changed: the difference and its sigma, SI; NaN where it does not tell."""
        visits, k = self.series.visits, self.series.names.index(parameter)
        begin = np.zeros(len(visits))
        for of in self.weights.kinds.values():
            begin += of.share[:, k].sum(axis=1)
        before = visits[: max(int(np.searchsorted(np.cumsum(begin) / begin.sum(), 0.5)), 1)]
        found = np.full((2, len(visits)), np.nan)
        for i, visit in enumerate(visits):
            both = replace(
                self.series, visits=(*(one for one in before if one is not visit), visit)
            )
            last = np.zeros((1, len(both.visits)))
            last[0, -1] = 1.0
            fit = max(null_fits(both), key=lambda pair: pair[1])[0]
            u, m = (one[0, k] for one in fit.score(last))
            if m > 1 / SIZES[-1] ** 2:
                found[:, i] = u / m, np.sqrt(fit.C / fit.D / m)
        value, sigma = self._table[parameter][0] * found
        return value, sigma

    @cached_property
    def misfit(self) -> Misfit | None:
        """How much larger the residuals are than the stated noise and the calibration let expect,
        before anything may have changed; None if the noise is not stated, or by chance."""
        from scipy.stats import chi2

        begin = self.since(next(iter(self.parts)))[0] if self.alarm else np.inf
        before = [one for one in self.visits if one.time <= begin]
        rows = sum(one.innovation.rows for one in before)
        if not rows or not all(one.known_noise for one in before):
            return None
        squares = sum(one.innovation.squares for one in before)
        p_value = float(chi2.sf(squares, rows))
        ratio = float(np.sqrt(squares / rows))
        return Misfit(ratio, p_value) if p_value < SIGNIFICANCE_LEVEL else None

    @cached_property
    def sights(self) -> tuple[Sight, ...]:
        """The smallest step of each parameter that the next recording would show."""
        series, limit = self.series, self.false_alarm_days * DAY
        last = series.visits[-1]
        last = replace(last, evidence=replace(last.evidence, pull=0 * last.evidence.pull))
        step = float(series.elapsed[-1]) or DAY
        return tuple(
            Sight(name, self._table[name][1], self._table[name][0] * size)
            for name, size in zip(
                series.names, smallest_steps(series, last, step / limit), strict=True
            )
        )


def part_of(name: str) -> str:
    """The joint, rod or line that a parameter belongs to."""
    effect, _, rest = name.partition(".")
    if effect in WARMTH:
        return TEMPERATURE
    return (rest if effect in WEAR else name).rpartition(".")[0] or name
