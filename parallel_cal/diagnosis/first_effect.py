"""Find the effect without which the geometry cannot be identified, such as a target that slipped.

Where a large effect is missing, the geometry would have to imitate it with values that no such
robot has, and no fit of the geometry alone succeeds.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass

import numpy as np

from parallel_cal.base.errors import FitError, ModelError
from parallel_cal.base.progress import Progress, ignore_progress
from parallel_cal.causes.effects import (
    collect_recorded_values,
    find_missing_conditions,
    list_effects_to_test,
)
from parallel_cal.diagnosis.search import Chosen
from parallel_cal.identification.acceptance import FOREIGN_SHARE
from parallel_cal.identification.checks import (
    ImplausibleGeometryError,
    UnexplainedMotionError,
)
from parallel_cal.identification.column_doubts import doubt_columns
from parallel_cal.identification.estimate import NoSolutionError
from parallel_cal.identification.fit import fit
from parallel_cal.identification.fit_warnings import format_distinctly
from parallel_cal.identification.observations import observe
from parallel_cal.identification.options import FitOptions
from parallel_cal.identification.registration import DevicePoses
from parallel_cal.model.model import Model
from parallel_cal.model.shelf import load_effect
from parallel_cal.recordings.dataset import Dataset

# How much larger chi2 must be with every other effect: two effects that explain the samples nearly
# as well leave it open which one the robot has.
MIN_CHI2_RATIO = 2.0
# A fit below this chi2/dof leaves little but noise. No effect can halve that, and a difference of
# chi2 then speaks for itself: this one is five standard deviations of one parameter.
MAX_NOISE_CHI2_PER_DOF = 1.5
MIN_CHI2_DIFFERENCE = 25.0
# Effects with more settings to scan are not tried: they are ripples, too small to mislead the
# geometry, and each setting costs a fit.
MAX_SETTINGS = 32
GAIN = "encoder_gain"


@dataclass(frozen=True)
class FirstEffect:
    """An effect with which a plausible geometry describes the samples, and what that fit leaves."""

    chosen: Chosen
    chi2: float
    chi2_per_dof: float

    @property
    def leaves_noise(self) -> bool:
        """Whether the fit leaves hardly more than noise."""
        return self.chi2_per_dof < MAX_NOISE_CHI2_PER_DOF


def rank_first_effects(
    model: Model,
    dataset: Dataset,
    effects: Iterable[str],
    options: FitOptions,
    progress: Progress | None = None,
) -> list[FirstEffect]:
    """Fit the samples with each of the `effects` alone (all of the catalogue if none is named), and
    return those that permit a fit, the least chi2 first."""
    report, found = progress or ignore_progress, list[FirstEffect]()
    names = list_effects_to_test(model, only=effects)
    for k, name in enumerate(names):
        report(f"trying {name} in the first fit", k / len(names))
        least: FirstEffect | None = None
        for settings, extended in _variants(model, dataset, name):
            try:
                estimate = fit(extended, dataset, options, hold_out=0).estimate
            except FitError:
                continue
            if least is None or estimate.chi2 < least.chi2:
                chosen = Chosen(name, tuple(sorted(settings.items())))
                least = FirstEffect(chosen, estimate.chi2, estimate.chi2_per_dof)
        if least is not None:
            found.append(least)
    return sorted(found, key=lambda one: one.chi2)


def select_equally_good(ranked: Sequence[FirstEffect]) -> list[FirstEffect]:
    """Select the first, and those that explain the samples nearly as well: they leave less than
    MIN_CHI2_RATIO times as much, or, where only noise is left, less than MIN_CHI2_DIFFERENCE more.
    """
    if not ranked:
        return []
    first = ranked[0]
    limit = MIN_CHI2_RATIO * first.chi2
    if first.leaves_noise:
        limit = min(limit, first.chi2 + MIN_CHI2_DIFFERENCE)
    return [one for one in ranked if one.chi2 < limit or one is first]


@contextmanager
def proposing_first_effect(
    model: Model,
    dataset: Dataset,
    options: FitOptions,
    effects: Iterable[str] | None = (),
    progress: Progress | None = None,
) -> Iterator[None]:
    """If no plausible geometry describes the samples, say which other columns or conventions fit
    them; if none do, add to the error which effect in the first fit permits a plausible geometry:
    it is the likeliest cause, unless few samples contradict all others. Those of `effects` are
    tried (all of the catalogue if none is named), or none if it is None."""
    try:
        yield
    except (ImplausibleGeometryError, NoSolutionError, UnexplainedMotionError) as error:
        check_columns(model, dataset, options, error)
        if effects is None or not isinstance(error, ImplausibleGeometryError) or error.outliers:
            raise
        check_motion(model, dataset, options, error)
        ranked = rank_first_effects(model, dataset, effects, options, progress)
        words = _describe_proposal(ranked, error.chi2_per_dof)
        raise ImplausibleGeometryError(f"{error}. {words}", error.chi2_per_dof) from None


def check_columns(model: Model, dataset: Dataset, options: FitOptions, error: FitError) -> None:
    """Raise FitError if other columns or conventions fit the samples."""
    observations = observe(model, dataset, options.joint_sigma, options.insist)
    there = DevicePoses.of(model, observations)
    if words := doubt_columns(model, observations, there, dataset.source, suspected=True):
        # Joints that contradict each other by a few per cent look like exchanged ones.
        most = np.inf
        with suppress(FitError, ModelError):
            gained = fit(model.with_effect(GAIN), dataset, options, hold_out=0)
            if (seen := DevicePoses.of(gained.model, gained.observations)) is not None:
                most = seen.compute_median_error(seen.now)
        words = doubt_columns(model, observations, there, dataset.source, True, most)
    if words:
        raise FitError(f"{words}. As they are, {error}") from None


def check_motion(model: Model, dataset: Dataset, options: FitOptions, error: FitError) -> None:
    """Raise FitError if most of the measured motion is not explained wherever the device stands: no
    effect is the cause."""
    there = DevicePoses.of(model, observe(model, dataset, options.joint_sigma, options.insist))
    if there is not None and (share := there.find_unexplained_share()) > FOREIGN_SHARE:
        raise FitError(
            f"{error}. Wherever the device stands, {100 * share:.0f} % of the measured motion "
            "is not explained, so no effect was tried. Check the mechanism, and the units, "
            "columns, signs and zeros of the joints and poses: two of them may be wrong, or "
            "the rows of joints and poses do not belong together"
        ) from None


def _describe_proposal(ranked: Sequence[FirstEffect], chi2_per_dof: float) -> str:
    """Say with which effects in the first fit the geometry is plausible.

    An effect is the likely cause if it explains clearly more than the implausible geometry, or as
    much where that one leaves only noise. If there is none, the best that explains more is named:
    it is a start where several effects are missing.
    """
    helpful = [
        one
        for one in ranked
        if MIN_CHI2_RATIO * one.chi2_per_dof < chi2_per_dof
        or (one.leaves_noise and one.chi2_per_dof <= chi2_per_dof)
    ]
    likely = select_equally_good(helpful)
    started = [one for one in ranked[:1] if one.chi2_per_dof < chi2_per_dof]
    if not (proposed := likely or started):
        return (
            "No effect of the catalogue in the first fit leads to a plausible geometry that "
            "explains as much"
        )
    first = proposed[0].chosen.text
    names = " or ".join(
        f"{one.chosen.text} (chi2/dof {format_distinctly([one.chi2_per_dof, chi2_per_dof])[0]})"
        for one in proposed
    )
    each = "each of them alone " if len(proposed) > 1 else ""
    more = "" if likely else ", but it explains only a part of the error: more is missing. Begin"
    return (
        f"With {names} in the first fit, {each}the geometry is plausible{more}: parallel-cal fit "
        f"MODEL RECORDING --effect {first} -o FITTED.yaml (in Python: pc.fit(model, dataset, "
        f"effects=[{first!r}]))"
    )


def _variants(
    model: Model, dataset: Dataset, name: str
) -> Iterator[tuple[Mapping[str, float], Model]]:
    """Yield an effect's settings to try, each with the model that has the effect so; none if it
    does not apply to the robot or depends on a condition that was not recorded."""
    effect = load_effect(name)
    if effect.applies(model.mechanism):
        return
    recorded = collect_recorded_values(dataset)
    try:
        if find_missing_conditions(model.with_effect(name), dataset):
            return
        scanned = [*effect.scan(model.mechanism, recorded)]
        for settings in scanned or [{}] if len(scanned) <= MAX_SETTINGS else ():
            yield settings, model.with_effect(name, settings)
    except ModelError:  # a larger mechanism that this robot cannot have
        return
