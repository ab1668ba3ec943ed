"""Decide, sample by sample, whether a robot has drifted since its calibration, and which part."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from parallel_cal.base.confidence import format_percent
from parallel_cal.base.errors import FitError
from parallel_cal.base.threads import single_threaded
from parallel_cal.identification.drift_test import (
    SCALES,
    TARGET,
    TARGET_EFFECT,
    Change,
    Columns,
    DriftTest,
    Look,
    Moved,
)
from parallel_cal.identification.expected_drift import ExpectedDrift, expect_drift
from parallel_cal.identification.observations import Observations, observe
from parallel_cal.identification.prior import Prior
from parallel_cal.identification.update import SHOWN_SIGMAS, recall_noise, update_prior
from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset

CERTAINTY = 0.95
MIN_UNUSUAL_SCALE = 3.0
MAX_LOOKS = 100  # numbers of samples after which the probabilities are computed
DRIFTED, DEVICE_MOVED, UNCHANGED = "drifted", "device_moved", "unchanged"
CHANGED, UNDECIDED = "changed", "undecided"
DEVICE_SENSOR = "the sensor device_frame"


class PossibleChange(NamedTuple):
    """What may have changed: its name, and that in words, the probability that it is this, if
    something has changed, and by how much each part has then changed, the most significant first.
    """

    name: str
    title: str
    probability: float
    moved: tuple[Moved, ...]

    @property
    def shown(self) -> tuple[Moved, ...]:
        """The parts that have changed by more than their uncertainty allows."""
        return tuple(one for one in self.moved if abs(one.value) > SHOWN_SIGMAS * one.sigma)

    def document(self) -> dict[str, Any]:
        moved = [one._asdict() for one in self.shown]
        return {"change": self.name, "probability": self.probability, "moved": moved}


@dataclass(frozen=True)
class Recheck:
    """Whether a robot has drifted since its calibration, as each further sample showed it.

    Attributes
    ----------
    looks : tuple of Look
        The probabilities after growing numbers of samples.
    changes : tuple of Change
        What may have changed (H): the zero of a joint, the temperature, a single parameter, all
        zeros with the temperature, all parts; the measuring device, its target; one of these two
        and one of the others.
    certainty : float
        The probability at which it is decided.
    expected : ExpectedDrift, optional
        What all samples let expect of the parameters, of an update and of further samples.
    possible : tuple of PossibleChange
        The fewest changes that have the certainty together, the likeliest first.
    """

    looks: tuple[Look, ...]
    changes: tuple[Change, ...]
    certainty: float = CERTAINTY
    expected: ExpectedDrift | None = None
    possible: tuple[PossibleChange, ...] = ()

    def _outcomes(self, look: Look) -> dict[str, float]:
        by_change = look.by_change
        of_robot = np.array([one.is_of_robot for one in self.changes])
        return {
            DRIFTED: float(by_change[of_robot].sum()),
            DEVICE_MOVED: float(by_change[~of_robot].sum()),
            UNCHANGED: look.unchanged,
        }

    def _decide(self, look: Look) -> str:
        if 1 - look.unchanged < self.certainty:
            is_excluded = look.rival[1] <= math.log(1 / self.certainty - 1)
            return UNCHANGED if is_excluded else UNDECIDED
        drifted = self._outcomes(look)[DRIFTED]
        if drifted >= self.certainty:
            return DRIFTED
        is_shown = self._sum_devices(look) >= self.certainty and drifted <= 0.5
        return DEVICE_MOVED if is_shown else CHANGED

    def _sum_devices(self, look: Look) -> float:
        """The probability that the device or its target moved."""
        return float(look.by_change[[bool(one.device) for one in self.changes]].sum())

    @cached_property
    def outcomes(self) -> dict[str, float]:
        """The probabilities that the robot has drifted (the device may have moved, too), that only
        the measuring device moved, and that nothing has changed."""
        return self._outcomes(self.looks[-1])

    @cached_property
    def decision(self) -> tuple[int, str]:
        """The number of samples after which it was first decided, and how; if it is not, all
        samples and the verdict. One may stop there: the errors are those that `certainty` says."""
        decided = ((one.samples, self._decide(one)) for one in self.looks)
        found = (one for one in decided if one[1] not in (CHANGED, UNDECIDED))
        return next(found, (self.looks[-1].samples, self.verdict))

    @property
    def verdict(self) -> str:
        """By all samples: `drifted`; `device_moved`; `changed` if it is one of these, but not
        decided which; `unchanged`; `undecided`."""
        return self._decide(self.looks[-1])

    @property
    def is_decided(self) -> bool:
        """Whether all samples decide what has changed, or that nothing has."""
        return self.verdict not in (CHANGED, UNDECIDED)

    @property
    def needs_no_update(self) -> bool:
        """Whether it is decided that nothing has changed, or that the device moved, and no drift of
        the robot shows beside that."""
        return self.verdict in (UNCHANGED, DEVICE_MOVED)

    @property
    def places_device(self) -> bool:
        """Whether a fit has to place the measuring device: it is likelier that it moved than that
        it stands, and it is not surely its target."""
        return self._sum_devices(self.looks[-1]) > 0.5 and self._moved_device != TARGET

    @cached_property
    def _by_device(self) -> dict[str, float]:
        """The probability that the device moved, and that its target did, alone or with a drift of
        the robot; the likeliest first."""
        by_change, found = self.looks[-1].by_change.tolist(), dict[str, float]()
        for one, share in zip(self.changes, by_change, strict=True):
            if one.device:
                found[one.device] = found.get(one.device, 0.0) + share
        return dict(sorted(found.items(), key=lambda item: -item[1]))

    @property
    def _has_moved(self) -> bool:
        """Whether it is decided that the device or its target moved."""
        return self._sum_devices(self.looks[-1]) >= self.certainty

    @cached_property
    def parts(self) -> dict[str, float]:
        """The probability of each change, if something has changed; the likeliest first."""
        share = self.looks[-1].by_change
        share = share / max(share.sum(), 1e-300)
        found = zip((one.name for one in self.changes), share.tolist(), strict=True)
        return dict(sorted(found, key=lambda item: -item[1]))

    @property
    def scale(self) -> float:
        """The likeliest size of a drift of the robot, in usual drifts."""
        alone = np.array([one.is_of_robot and not one.is_of_both for one in self.changes])
        return float(SCALES[np.argmax(self.looks[-1].changed[alone].sum(axis=(0, 1)))])

    @property
    def _titles(self) -> dict[str, str]:
        """The changes in words, by their names."""
        return {one.name: one.title for one in self.changes}

    @property
    def progress(self) -> str:
        """How far the decision is, in a few words."""
        words = f"that something has changed: {1 - self.outcomes[UNCHANGED]:.1%}"
        if self.verdict == UNDECIDED:
            rival = self.looks[-1].rival[0]
            words += f", least excluded: {self._titles.get(rival, rival)}"
        return words

    @property
    def likely(self) -> tuple[PossibleChange, ...]:
        """The possible changes; none if nothing has changed, or if it is not decided."""
        return () if self.verdict in (UNCHANGED, UNDECIDED) else self.possible

    @property
    def shown(self) -> tuple[Moved, ...]:
        """The parts of the likeliest change that have changed by more than their uncertainty
        allows; none if nothing has changed, or if it is not decided."""
        return self.likely[0].shown if self.likely else ()

    @property
    def is_shown(self) -> bool:
        """Whether it is likelier that the robot has drifted than that nothing has changed."""
        return self.outcomes[DRIFTED] > self.outcomes[UNCHANGED]

    @property
    def forbids_update(self) -> bool:
        """Whether no update is needed; or the device moved while a drift is not decided, or its
        target did, which a fit does not place."""
        if self._has_moved:
            return self.verdict != DRIFTED or not self.places_device
        return self.needs_no_update

    @property
    def cure(self) -> str:
        """What to do if the model is not updated."""
        if self.verdict == DRIFTED and self.forbids_update:
            return (
                f"put the {self._moved_device} back, or let the samples place it: parallel-cal add "
                f"MODEL {TARGET_EFFECT} RECORDING -o BETTER.yaml"
            )
        if self.verdict == DEVICE_MOVED:
            return f"keep MODEL, and put the {self._moved_device} back"
        if self.verdict == UNDECIDED:
            return "measure more of the planned poses; until then, keep MODEL"
        return "keep MODEL"

    @property
    def warnings(self) -> tuple[str, ...]:
        """What has changed, and what to do."""
        if self.verdict == UNCHANGED:
            return ("the samples show no drift since the last calibration",)
        if self.verdict == UNDECIDED:
            return (
                "the samples do not decide whether the robot has drifted since the last "
                f"calibration ({self.progress}): measure more of the planned poses, and fit them "
                "together with these",
            )
        of_robot = {one.name for one in self.changes if one.is_of_robot}
        name, share = next(one for one in self.parts.items() if one[0] in of_robot)
        likeliest = f"likeliest: {self._titles[name]}, {format_percent(share)}"
        if self._has_moved:
            may = "drifted, too" if self.verdict == DRIFTED else "may have drifted, too"
            drifted = f"the robot {may} ({format_percent(self.outcomes[DRIFTED])}; {likeliest})"
            return (
                f"the {self._moved_device} moved since the last calibration, and {drifted}: "
                f"{self._cure_of_device}",
            )
        size = f"about {self.scale:.2g} times as far as usual ({likeliest})"
        words = f"since the last calibration the robot drifted {size}"
        if self.verdict == CHANGED:
            robot = format_percent(self.outcomes[DRIFTED])
            device = format_percent(self._sum_devices(self.looks[-1]))
            words = (
                f"the robot drifted ({robot}), {size}, or the measuring device moved ({device}), "
                "or both: the samples do not tell. Measure a fixed target as at the "
                "calibration: if it is where it was, the device stands, and the robot drifted. "
                f"{self._describe_further_samples()}"
            )
        elif self.scale >= MIN_UNUSUAL_SCALE:
            words += (
                ": check what happened to it; with so large a drift, more samples or a complete "
                "calibration are worthwhile"
            )
        return (words,)

    @property
    def _moved_device(self) -> str:
        """What of the measuring device moved."""
        likeliest, share = next(iter(self._by_device.items()))
        known = share >= self.certainty * sum(self._by_device.values())
        return likeliest if known else "measuring device or its target"

    @property
    def _cure_of_device(self) -> str:
        part = f"the effect {TARGET_EFFECT}" if self._moved_device == TARGET else DEVICE_SENSOR
        return f"put it back, or add {part} to the model, so that a fit places it"

    def _describe_further_samples(self) -> str:
        """Say whether more samples would tell a drift of the robot from a moved device."""
        more = self.expected.more_samples if self.expected else None
        if more is None:
            return (
                "More poses like these hardly tell: a moved device imitates the drift to within "
                "the uncertainty of the last calibration"
            )
        return f"About {more} more poses like these would tell, too, in half of the cases"

    def document(self) -> dict[str, Any]:
        """The JSON document: probabilities, SI."""
        expected = self.expected
        return {
            "verdict": self.verdict,
            "certainty": self.certainty,
            "decision": dict(zip(("samples", "verdict"), self.decision, strict=True)),
            "probability": self.outcomes,
            "least_excluded": {
                "part": self.looks[-1].rival[0],
                "probability": 1 / (1 + math.exp(-self.looks[-1].rival[1])),
            },
            "scale": self.scale,
            "parts": self.parts,
            "moved": [one._asdict() for one in self.shown],
            "likely": [one.document() for one in self.likely],
            "growth": expected and expected.growth,
            "error_if_kept": expected and expected.kept,
            "more_samples": expected and expected.more_samples,
            "looks": [{"samples": one.samples, **self._outcomes(one)} for one in self.looks],
        }


@single_threaded()
def recheck(
    model: Model,
    dataset: Dataset,
    joint_sigma: float | None = None,
    insist: bool = False,
    certainty: float = CERTAINTY,
) -> Recheck:
    """Decide whether a robot has drifted since its calibration.

    Parameters
    ----------
    model : Model
        The calibrated model, with the covariance of its fit.
    dataset : Dataset
        The samples of today, in the order in which they were measured.
    joint_sigma : float, optional
        Standard deviation of joint readings, rad or m. Default: that of the recording or the model.
    insist : bool
        Whether to accept joint readings that no such robot shows. Default False.
    certainty : float
        The probability at which it is decided, above 0.5 and below 1. A robot that has not drifted
        is said to have changed with at most (1 - certainty) / certainty, however often one looks; a
        change that counts is missed as rarely.

    Returns
    -------
    Recheck

    Raises
    ------
    FitError
        If the model was never fitted, or nobody stated the noise: its evidence has no size then.
    """
    check_certainty(certainty)
    model = recall_noise(model)
    observations = observe(model, dataset, joint_sigma, insist)
    if observations.noise_assumed:
        raise FitError(
            f"{dataset.source}: nobody stated the noise of the samples, so nothing says how large "
            "a drift they would show: state it in the model file, or with --joint-sigma"
        )
    return weigh_changes(model, observations, certainty)


def weigh_changes(
    model: Model, observations: Observations, certainty: float = CERTAINTY
) -> Recheck:
    """Decide by observations with stated noise, as `recheck` does by samples."""
    columns = Columns.of(model, observations)
    test = DriftTest.of(model, columns)
    n, looks = len(observations), []
    A, b = np.zeros_like(test.C0), np.zeros(len(test.C0))
    ends = np.unique(np.linspace(0, n, min(n, MAX_LOOKS) + 1).round().astype(int))
    for begin, end in pairwise(ends.tolist()):
        A, b = (old + new for old, new in zip((A, b), columns.sum(begin, end), strict=True))
        looks.append(test.look(end, A, b))
    information, pull = A / test.variance, b / test.variance
    expected = expect_drift(model, test, looks[-1], information, pull, certainty)
    share, cases = looks[-1].by_change, list(test.list_cases(looks[-1]))
    order = np.argsort(-share, kind="stable").tolist()
    count = int(np.searchsorted(np.cumsum(share[order]), certainty * share.sum())) + 1
    possible = tuple(
        PossibleChange(
            test.changes[k].name,
            test.changes[k].title,
            float(share[k] / max(share.sum(), 1e-300)),
            test.estimate([one for one in cases if one.change == k], A, b),
        )
        for k in order[:count]
    )
    return Recheck(tuple(looks), test.changes, certainty, expected, possible)


def check_certainty(certainty: float) -> None:
    """Raise FitError unless a certainty is above 0.5 and below 1."""
    if not 0.5 < certainty < 1:
        raise FitError(f"certainty {certainty:g}: expected a probability above 0.5 and below 1")


def drift_prior(model: Model, found: Recheck) -> Prior:
    """Return the knowledge of today: the last calibration, widened by the drift that the samples
    let expect, unless they decide that the robot is as it was. Raises FitError for a model without
    a covariance."""
    last = update_prior(model, 0.0)
    if found.expected is None or found.needs_no_update:
        return last
    return Prior(last.names, last.mean, last.covariance + found.expected.covariance)
