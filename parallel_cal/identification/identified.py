"""Identify the free parameters of a model, and the noise where nobody stated it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.identification.common_scale import CommonScale
from parallel_cal.identification.estimators import Estimator
from parallel_cal.identification.image_poses import measure_image_noise
from parallel_cal.identification.methods.implicit import Estimate
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.prior import Prior
from parallel_cal.identification.thresholds import (
    CONTRADICTED_SIGMAS,
    LOOSENING,
    MAX_NOISE_ROUNDS,
    MAX_REPETITIONS,
)
from parallel_cal.identification.variance_components import estimate_noise
from parallel_cal.model.model import Model


@dataclass(frozen=True)
class Identified:
    """What was identified: an estimate, the samples with the noise that weighted them, and the
    model, with larger tolerances than the `usual` one has where the data contradict these.
    `inseparable` are the groups of sensors whose noise the samples do not tell apart."""

    usual: Model
    model: Model
    free: np.ndarray
    estimate: Estimate
    observations: Observations
    inseparable: tuple[tuple[str, ...], ...]

    @property
    def fitted(self) -> Model:
        """The usual model with the identified values."""
        return self.usual.with_values(self.estimate.values, self.estimate.covariance)

    @cached_property
    def scaled(self) -> CommonScale | None:
        """The factor by which all lengths differ from those of the drawing, if there is one."""
        return CommonScale.find(self.fitted, self.observations, self.free)


@dataclass(frozen=True)
class Identification:
    """How the `free` parameters of a model are identified."""

    usual: Model
    free: np.ndarray
    estimate_with: Estimator = field(repr=False)
    prior: bool | Prior | None

    def with_noise(
        self, observations: Observations, begin: np.ndarray, noise_is_known: bool
    ) -> Identified:
        """Identify the parameters, starting at `begin`; where no noise is stated, the samples tell
        it, and the parameters are identified again with it, until both stay."""
        model, estimate = self(observations, begin)
        measured = measure_image_noise(model.with_values(estimate.values), observations)
        if measured is not observations:
            observations = measured
            model, estimate = self(observations, estimate.values)
        inseparable: tuple[tuple[str, ...], ...] = ()
        if observations.unknown and not noise_is_known:
            guessed, last = observations, None
            for _ in range(MAX_NOISE_ROUNDS):
                one = estimate_noise(
                    model, guessed, self.free, estimate, self.prior is not False, last
                )
                if last is not None and not one.differs_from(last):
                    break
                last, observations, inseparable = one, one.observations, one.inseparable
                model, estimate = self(observations, estimate.values)
        if observations.noise_assumed:
            estimate = scale_covariance(estimate)
        return Identified(self.usual, model, self.free, estimate, observations, inseparable)

    def __call__(self, observations: Observations, start: np.ndarray) -> tuple[Model, Estimate]:
        """Identify the free parameters, starting at `start`; the model gets larger tolerances where
        the data contradict those of effects."""
        model = self.usual
        estimate = self.estimate_with(model.with_values(start), observations, self.free)
        for _ in range(MAX_REPETITIONS if self.prior is None else 0):
            loosened = _loosen_contradicted_tolerances(model, estimate, self.free)
            if loosened is None:
                break
            try:
                begin = loosened.with_values(estimate.values)
                freer = self.estimate_with(begin, observations, self.free)
            except FitError:
                break  # without the usual size the data determine no solution
            if freer.chi2 > estimate.chi2:
                break
            model, estimate = loosened, freer
        return model, estimate


def _loosen_contradicted_tolerances(
    model: Model, estimate: Estimate, free: np.ndarray
) -> Model | None:
    """The model with larger tolerances of effects whose usual size the data contradict; None if
    they contradict none.

    Where the data tell little, the usual size of an effect acts as a prior. It must not hold an
    effect that the data move by several of its standard deviations.
    """
    table, found = model.table, dict[str, float]()
    away = np.abs(estimate.values - table.nominal) / table.prior_sigma
    for effect in model.effects if estimate.spectrum.held else ():
        own = [i for i, p in enumerate(table) if free[i] and p.name.startswith(f"{effect.name}.")]
        if np.max(away[own], initial=0.0) > CONTRADICTED_SIGMAS:
            found |= {table[i].name: LOOSENING * table[i].tolerance for i in own}
    return replace(model, tolerances={**model.tolerances, **found}) if found else None


def scale_covariance(estimate: Estimate) -> Estimate:
    """The estimate with covariance * chi2/dof: sigmas from the residuals, because only the
    proportions of the noise are known."""
    if estimate.dof <= 0:
        return estimate
    return replace(estimate, covariance=estimate.covariance * estimate.chi2_per_dof)
