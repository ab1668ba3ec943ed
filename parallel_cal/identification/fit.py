"""Identify the parameters of a model from samples, with their uncertainty and validation error."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from parallel_cal.base.arguments import check_arguments
from parallel_cal.base.documents import to_json_value
from parallel_cal.base.errors import FitError, ModelError
from parallel_cal.base.notebook import ShownInNotebook
from parallel_cal.base.options import with_changes
from parallel_cal.base.progress import Progress, ignore_progress
from parallel_cal.base.threads import single_threaded
from parallel_cal.identification.added_effects import add_effects, limit_patterns
from parallel_cal.identification.base_motion import BaseMotion, compute_base_motion
from parallel_cal.identification.budget import (
    GEOMETRY,
    Budget,
    Iso9283,
    budgets,
    iso_9283,
    list_parts,
    list_sides,
)
from parallel_cal.identification.checks import (
    ImplausibleGeometryError,
    check_joint_errors,
    check_plausible,
    chosen_parameters,
    explain_too_few_poses,
)
from parallel_cal.identification.estimators import check_convergent_method, estimator
from parallel_cal.identification.fit_warnings import (
    DownWeightedSample,
    chi2_band,
    find_down_weighted_samples,
    finite_or_none,
    leaves_only_noise,
    list_held_coordinate_warnings,
    list_noise_warnings,
    list_parameter_warnings,
    list_sample_warnings,
    list_setting_warnings,
    on_priors,
)
from parallel_cal.identification.given_model import Folds, GivenModel
from parallel_cal.identification.held_out_uncertainty import compute_held_out_sigmas
from parallel_cal.identification.identified import Identification, Identified
from parallel_cal.identification.methods.implicit import Estimate
from parallel_cal.identification.noise_figures import list_noise, noise_in_use
from parallel_cal.identification.noise_floor import (
    NoiseFloor,
    find_noise_floor,
    noise_floor,
)
from parallel_cal.identification.observability import directions_in_words
from parallel_cal.identification.observations import Observations, blocks, observe
from parallel_cal.identification.options import FitKeywords, FitOptions
from parallel_cal.identification.outliers import (
    Outliers,
    may_hide_in_noise,
    search_outliers,
)
from parallel_cal.identification.prediction_errors import (
    Errors,
    Summary,
    compute_rms_sigmas,
    errors,
    improvement,
)
from parallel_cal.identification.predictions import predict_positions
from parallel_cal.identification.prior import Knowledge, Prior
from parallel_cal.identification.recheck import Recheck, drift_prior, weigh_changes
from parallel_cal.identification.refit import add_consider_covariance
from parallel_cal.identification.registration import (
    DevicePoses,
    Registration,
    add_registration_warning,
    is_identified,
    is_registrable,
    place_frames,
    prepared_for_fit,
    registered_by,
    shows_pose,
)
from parallel_cal.identification.set_up import place_set_up
from parallel_cal.identification.thresholds import ENOUGH_SAMPLES
from parallel_cal.identification.unusual import UnusualSize, describe_by_effect
from parallel_cal.identification.update import ESTIMATED_NOISE, recall_noise, update_prior
from parallel_cal.model.model import Model
from parallel_cal.model.region import IdentifiedRegion
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.joining import fingerprint
from parallel_cal.recordings.lagged import add_lagged_conditions

if TYPE_CHECKING:
    from typing_extensions import Unpack

Judged = Callable[[np.ndarray, np.ndarray], Errors | None]


@dataclass(frozen=True)
class FitResult(ShownInNotebook):
    """The result of a fit, with its inputs.

    Attributes
    ----------
    model : Model
        The identified model.
    start : Model
        The model at which the optimisation started. It differs from the model that you passed to
        `fit` only if the fit also identifies the frame of a measuring device.
    options : FitOptions
    estimate : Estimate
        The estimated parameters and their covariance. All samples were used.
    free : ndarray of bool (n_parameters,)
        The mask of the parameters that were identified.
    after : Errors
        The errors of `model` at all samples (in-sample).
    held_out : Errors
        The errors of the cross-validation: at each pose, the errors of a fit that did not use this
        pose.
    observations : Observations
        The samples as the fit used them.
    dataset : Dataset
    warnings : tuple of str
    given : GivenModel
        The model that you passed to `fit`, registered if necessary, and its errors at the samples.
    registration : Registration, optional
        The estimated frame of the measuring device; None if none was needed.
    base_motion : BaseMotion, optional
        How far the identified geometry moves the base {B} and the platform {P} as a whole against
        those of the nominal robot; None without a registration.
    drift : Recheck, optional
        Of an update: whether the robot has drifted since its last calibration, and which part; None
        if nothing tells it.
    unusual : dict of str to UnusualSize
        Parameters of effects that are larger than usual for the machine's class, by name.
    implausible : str
        Why no such robot has the identified geometry, which imitates what the model lacks; empty if
        it is plausible.
    outliers : Outliers, optional
        Samples that contradict all others; None if there are none.
    """

    model: Model
    start: Model
    options: FitOptions
    estimate: Estimate
    free: np.ndarray
    after: Errors
    held_out: Errors
    observations: Observations
    dataset: Dataset
    warnings: tuple[str, ...]
    given: GivenModel
    registration: Registration | None = None
    base_motion: BaseMotion | None = None
    unusual: Mapping[str, UnusualSize] = field(default_factory=dict)
    drift: Recheck | None = None
    implausible: str = ""
    outliers: Outliers | None = None

    @property
    def prior(self) -> Prior | None:
        """The stated knowledge of the parameters before these samples; None if tolerances alone
        were known."""
        return self.options.prior if isinstance(self.options.prior, Prior) else None

    @property
    def chi2_with_prior(self) -> float:
        """chi2 of the samples, and of the parameters about the mean of a stated prior."""
        if self.prior is None:
            return self.estimate.chi2
        known = Knowledge.of(self.prior, self.model.table, self.free)
        return self.estimate.chi2 + known.cost(self.model.values)

    @property
    def plausible_model(self) -> Model:
        """The model; FitError if no such robot has its geometry."""
        if self.implausible:
            raise FitError(self.implausible)
        return self.model

    def __repr__(self) -> str:
        return (
            f"FitResult({self.model.mechanism.name}, {self.samples} samples, "
            f"{self.estimate.spectrum.rank} of {int(self.free.sum())} free parameters identified, "
            f"chi2/dof {self.estimate.chi2_per_dof:.3g})"
        )

    @property
    def refitted_parameters(self) -> tuple[str, ...]:
        """Names of the parameters that were identified, if the option `refit` limited the fit to
        some parameters; otherwise empty."""
        names = np.array(self.model.table.names)[self.free] if self.options.refit else ()
        return tuple(str(name) for name in names)

    @property
    def before(self) -> Errors:
        """Errors of the given model, registered only, as `compare` shows them."""
        return self.given.errors

    @property
    def samples(self) -> int:
        """Number of samples."""
        return len(self.observations)

    @cached_property
    def region(self) -> IdentifiedRegion:
        """The region of the samples: beyond it neither model nor validation error is proven."""
        seen = self.observations
        if len(seen) > ENOUGH_SAMPLES:
            seen = seen.select(np.linspace(0, len(seen) - 1, ENOUGH_SAMPLES).astype(int))
        joints = self.observations.x[:, : len(self.model.joints)]
        position = predict_positions(self.model, seen)
        return IdentifiedRegion.of_samples(self.model, joints, position, self.observations.a)

    @cached_property
    def simulated_noise(self) -> NoiseFloor:
        """The noise floor, and how much it varies between repetitions of the measurements."""
        seen = self.after
        if self.outliers is not None:  # an outlier is no revisit of its pose
            seen = seen.only_at(~np.isin(self.dataset.numbers, self.outliers.numbers))
        return find_noise_floor(self.model, self.observations, seen, self.dataset)

    @property
    def noise_floor(self) -> Summary:
        """Errors that a perfect model of this robot would show with the same measurement noise."""
        return self.simulated_noise.summary

    def rms_sigmas(self, found: Errors) -> dict[str, float]:
        """Standard deviations of the rms errors at the samples of this fit, for each kind of
        error (position, orientation, ...).

        Those of `held_out` are about the rms error of this calibration at poses like the measured
        ones; all others follow from the scatter between poses alone.
        """
        sigmas = compute_rms_sigmas(found, blocks(self.dataset))
        return sigmas | self._held_out_sigmas if found is self.held_out else sigmas

    @cached_property
    @single_threaded()
    def _held_out_sigmas(self) -> dict[str, float]:
        if not self.held_out.judged.any():
            return {}
        return compute_held_out_sigmas(
            self.model,
            self.estimate,
            self.free,
            self.observations,
            self.held_out,
            _folds(self.dataset, self.options),
            blocks(self.dataset),
        )

    @cached_property
    @single_threaded()
    def held_out_before(self) -> Errors:
        """Errors of the model before the fit, at the poses of `held_out`; NaN at all other samples.

        No held-out pose influences its own error here:

        1. The frame of a device is estimated from the other poses.
        2. If the given model was fitted to these samples before, its parameters are identified
           again without the held-out poses. If it was fitted to some of the recordings, only these
           are used for it.
        """
        if self.given.known_held_out is not None:
            found = self.given.known_held_out
        elif self.given.fits_of_these_samples:
            found = self._refitted_without_held_out()
        elif self.given.known_samples.any():
            found = self._refitted_from_known_samples()
        else:
            folds = _folds(self.dataset, self.options)
            found = self.given.errors_at_held_out(folds, places_set_up=self.options.update)
        return found.only_at(self.held_out.judged)

    def _refitted_without_held_out(self) -> Errors:
        """Validation errors of a given model that was fitted to these samples before.

        Those of its parameters that this fit identifies are identified again in the same folds, by
        the method and the loss of its last fit; the others keep their values on both sides. NaN if
        they cannot be identified.
        """
        start, last = self.given.model, self.given.fits_of_these_samples[-1]
        own, here = _names(start, ~np.asarray(start.fixed)), _names(self.model, self.free)
        how = _method_of(last)
        same = all(getattr(self.options, key) == value for key, value in how.items())
        if same and here <= own and start.table.names == self.model.table.names:
            return self.held_out
        if not own & here:
            return self.before
        narrowed = replace(
            self.options, **how, free=(), fix=sorted(own - here), refit=(), insist=True
        )
        try:
            return fit_unjudged(start, self.dataset, narrowed).judge().held_out
        except FitError:
            return self.before.blank()

    @property
    def judged_errors(self) -> Errors:
        """Errors at held-out poses; those at all samples if no pose was held out."""
        return self.held_out if self.held_out.judged.any() else self.after

    @cached_property
    @single_threaded()
    def unchanged_errors(self) -> Errors:
        """Errors of the given model without a fit of its parameters, at the samples of `held_out`.

        The frame of a device is estimated from the other poses.
        """
        folds = _folds(self.dataset, self.options)
        return self.given.errors_at_held_out(folds).only_at(self.held_out.judged)

    @cached_property
    @single_threaded()
    def nominal_errors(self) -> Errors:
        """Errors of the nominal model, registered only, at the samples of `judged_errors`."""
        return self._errors_of_nominal(np.any([*list_parts(self.model).values()], axis=0))

    @cached_property
    @single_threaded()
    def errors_without(self) -> dict[str, Errors | None]:
        """Errors of the model if its geometry, or one of its effects at a time, is taken away, at
        the samples of `judged_errors`; None where the rest cannot be identified.

        Without an effect, all other parameters are identified again. Without its geometry, the
        model keeps its effects.
        """
        found: dict[str, Errors | None] = {}
        parts = list_parts(self.model)
        for name, own in parts.items():
            if name == GEOMETRY:
                # Without effects, this is the nominal model.
                alone = len(parts) == 1
                found[name] = self.nominal_errors if alone else self._errors_of_nominal(own)
                continue
            try:
                smaller = self.start.without_effect(name)
                narrowed = limit_patterns(self.options, smaller, self.start)
                other = fit_unjudged(
                    smaller, self.dataset, narrowed, given=self.given, noise=self.observations
                ).judge()
                found[name] = other.judged_errors
            except (FitError, ModelError):
                found[name] = None
        return found

    def _errors_of_nominal(self, part: np.ndarray) -> Errors:
        """Errors of the model with nominal values of some parameters (mask), registered only."""
        values = np.where(part, self.model.table.nominal, self.model.values)
        model = self.model.with_values(values)
        held_out = self.held_out.judged.any()
        # Frames that a fit found belong to its geometry: the nominal one gets its own. It is
        # registered as it was before that fit.
        there = DevicePoses.of(model, self.observations)
        registers = (
            self.given.is_registered
            or is_identified(self.model)
            or shows_pose(self.model)
            or is_registrable(model, there)
        )
        placed = place_frames(model, self.observations, there) if registers else None
        given = GivenModel(
            model, placed or model, self.dataset, self.options.joint_sigma, self.options.insist
        )
        if not held_out:
            return given.errors
        folds = _folds(self.dataset, self.options)
        return given.errors_at_held_out(folds).only_at(self.held_out.judged)

    def _refitted_from_known_samples(self) -> Errors:
        """Validation errors of a given model that was fitted to some of these recordings before.

        In each fold its parameters are identified again from those of their samples that are not
        held out. Where the device stands is no property of the robot: it is estimated from all
        samples that are not held out. NaN if they cannot be identified.
        """
        start, known = self.given.model, self.given.known_samples
        last = self.given.earlier_fits[-1]
        how = replace(
            self.options, **_method_of(last), free=(), fix=(), refit=(), insist=True, hold_out=0
        )
        parts = self.before.blank().parts()
        for train, test in _folds(self.dataset, self.options):
            kept = self.dataset.select(train[known[train]])
            try:
                again = fit_unjudged(start, kept, how).judge().model
            except FitError:
                continue
            placed = registered_by(again, self.given.observations.select(train)) or again
            unseen = errors(placed, self.given.observations.select(test))
            for name, array in unseen.parts().items():
                parts[name][test] = array
        return Errors(**parts)

    @cached_property
    def budgets(self) -> tuple[Budget, ...]:
        """The part of the nominal model's error that the geometry, and each effect, removes."""
        return budgets(
            self.model,
            self.dataset,
            self.observations,
            self.judged_errors,
            self.nominal_errors,
            self.errors_without,
            self.simulated_noise,
            bool(self.held_out.judged.any()),
        )

    @cached_property
    def iso_9283(self) -> tuple[Iso9283, ...]:
        """Pose accuracy and repeatability with the identified model."""
        return iso_9283(
            self.judged_errors,
            self.observations.group,
            list_sides(self.dataset),
            held_out=bool(self.held_out.judged.any()),
            sides_from_order=self.dataset.sides_from_order,
        )

    @property
    def down_weighted(self) -> tuple[DownWeightedSample, ...]:
        """Samples that a robust loss gave less than half their weight."""
        return find_down_weighted_samples(self.estimate, self.dataset)

    def history_entry(self) -> dict[str, Any]:
        """What the history of a model keeps of its fit; SI, None for unknown values."""
        held_before, held_after = self.held_out_before.summary, self.held_out.summary
        noise = vars(noise_in_use(self.model, self.observations, estimated=True))
        estimated = {part: sigma for part, sigma in noise.items() if sigma}
        return {
            "method": self.options.method,
            "samples": self.samples,
            "dataset": {
                "source": self.dataset.source,
                "sha256": self.dataset.sha256,
                **({"recordings": list(several)} if (several := self.dataset.recordings) else {}),
            },
            "region": self.region.document(),
            "before": self.before.summary.document(),
            "after": self.after.summary.document(),
            "held_out": {"before": held_before.document(), "after": held_after.document()},
            "chi2_per_dof": finite_or_none(self.estimate.chi2_per_dof),
            **({ESTIMATED_NOISE: estimated} if estimated else {}),
        }

    def document(self) -> dict[str, Any]:
        """The JSON document of `parallel-cal fit`; SI, None for unknown values."""
        before, after = self.before.summary, self.after.summary
        held_before, held_after = self.held_out_before.summary, self.held_out.summary
        assumed = self.observations.noise_assumed  # then no band of chi2 is known
        weak_or_none = "weak" if self.estimate.spectrum.held else "none"
        last = "last calibration" if self.options.update else "all"
        return self.history_entry() | {
            "parameters": to_json_value(self.parameters()),
            "as_given": self.given.errors_as_given.summary.document(),
            "improvement": improvement(before, after),
            "improvement_held_out": improvement(held_before, held_after),
            "chi2_band": [None, None] if assumed else list(chi2_band(self.estimate.dof)),
            "dof": self.estimate.dof,
            "rank": self.estimate.spectrum.rank,
            "free": int(self.free.sum()),
            "unidentifiable": directions_in_words(
                self.estimate.spectrum.unidentifiable, self.model.table
            ),
            "weak": directions_in_words(self.estimate.spectrum.weak, self.model.table),
            "priors": last if self.options.prior else weak_or_none,
            "budget": to_json_value(self.budgets),
            "iso_9283": to_json_value(self.iso_9283),
            "noise_floor": self.noise_floor.document(),
            "revisits": self.simulated_noise.revisits,
            "noise_from": self.observations.noise_from,
            "noise": to_json_value(list_noise(self.model, self.observations)),
            "loss": self.options.loss,
            "refit": list(self.refitted_parameters),
            "down_weighted": to_json_value(self.down_weighted),
            "iterations": self.estimate.iterations,
            "registration": to_json_value(self.registration),
            "base_motion": to_json_value(self.base_motion),
            "unusual": to_json_value(list(self.unusual.values())),
            "implausible": self.implausible,
            "drift": None if self.drift is None else to_json_value(self.drift.document()),
            "warnings": list(self.warnings),
        }

    def parameters(self) -> dict[str, ParameterEstimate]:
        """Every parameter by name."""
        return summarise_parameters(self.model, self.estimate.sigma, ~self.free)

    def correlations(self) -> np.ndarray:
        """Correlation matrix (n_free, n_free) of the free parameters."""
        covariance = self.estimate.covariance[np.ix_(self.free, self.free)]
        sigma = np.sqrt(np.diag(covariance))
        return covariance / np.outer(sigma, sigma)


@dataclass(frozen=True)
class ParameterEstimate:
    """An identified parameter, SI; `sigma` is None if unknown.

    `moved_tolerances` is the distance from nominal in usual tolerances, also if the fit raised the
    tolerance because the size is unusual.
    """

    value: float
    sigma: float | None
    nominal: float
    unit: str
    fixed: bool
    moved_tolerances: float


def summarise_parameters(
    model: Model, sigma: np.ndarray, fixed: np.ndarray
) -> dict[str, ParameterEstimate]:
    """Every parameter of a model by name."""
    usual_tolerance = model.usual_tolerance
    return {
        p.name: ParameterEstimate(
            value=float(model.values[i]),
            sigma=finite_or_none(sigma[i]),
            nominal=p.nominal,
            unit=p.unit,
            fixed=bool(fixed[i]),
            moved_tolerances=float((model.values[i] - p.nominal) / usual_tolerance[i]),
        )
        for i, p in enumerate(model.table)
    }


@check_arguments(FitError)
@single_threaded()
def fit(
    model: Model,
    dataset: Dataset,
    options: FitOptions | None = None,
    progress: Progress | None = None,
    *,
    effects: Sequence[str] = (),
    **changes: Unpack[FitKeywords],
) -> FitResult:
    """Identify the free parameters of a model from measurements, and take the result as it is.

    Arguments, result and errors are those of `parallel_cal.diagnosis.fitting.fit`, which also
    refuses a result that does not describe the samples, and names the columns or conventions that
    do. Callers that compare many fits need neither.
    """
    options = with_changes(options, FitOptions, changes, FitError)
    if not dataset.sha256:  # so that another fit of these samples knows that the first used them
        dataset = replace(dataset, sha256=fingerprint(dataset))
    ready = Prepared.of(model, dataset, options, effects)
    start, dataset, options, registration = (
        ready.start,
        ready.dataset,
        ready.options,
        ready.registration,
    )
    unjudged = fit_unjudged(start, dataset, options, progress, ready.given)
    result = replace(unjudged.judge(progress), drift=ready.drift)
    # An outlier may hide where the geometry follows it.
    seen, known = result.observations, None if result.implausible else result.estimate
    if may_hide_in_noise(seen, dataset):
        known = None
        seen = ready.given.observe(start, dataset, options.joint_sigma, options.insist)
    outliers = search_outliers(start, dataset, seen, options, known)
    if outliers is not None:
        warnings = (*result.warnings, outliers.description)
        result = replace(result, warnings=warnings, outliers=outliers)
    if registration is None:
        return result
    motion = compute_base_motion(result.model, result.observations)
    warnings = (*result.warnings, *([motion.description] if motion else []))
    return replace(result, registration=registration, base_motion=motion, warnings=warnings)


@dataclass(frozen=True)
class Prepared:
    """A model and samples that are ready for a fit, which begins at `start`, with the device and
    the set-up in their places; of an update, the `options` have the knowledge of today as their
    prior, and `drift` is whether the robot has drifted."""

    given: GivenModel
    start: Model
    dataset: Dataset
    options: FitOptions
    registration: Registration | None
    drift: Recheck | None

    @classmethod
    def of(
        cls, model: Model, dataset: Dataset, options: FitOptions, effects: Sequence[str] = ()
    ) -> Prepared:
        """Place device and set-up, and weigh the drift of an update; raises FitError."""
        if options.update:
            model = recall_noise(model)
        model = place_set_up(model, dataset, options)
        given = GivenModel.of(model, dataset, options.joint_sigma, options.insist)
        start = add_effects(given.start, effects, given.dataset)
        dataset = add_lagged_conditions(start.conditions, given.dataset)
        start, registration = prepared_for_fit(start, given.registration, dataset, options)
        dataset = add_registration_warning(dataset, registration)
        if options.update and not isinstance(options.prior, Prior) and given.known_samples.any():
            raise FitError(
                f"{dataset.source}: the given model was fitted to these samples, so that an update "
                "(--update) would count them twice: give the model from before them, or fit "
                "without --update"
            )
        drift, options, dataset = weigh_drift(start, dataset, options, registration is not None)
        if drift is not None and drift.places_device:
            # With the device where it stood, the robot, and effects, would imitate its move.
            seen = observe(given.start, dataset, options.joint_sigma, options.insist)
            start = add_effects(registered_by(given.start, seen) or given.start, effects, dataset)
        return cls(given, start, dataset, options, registration, drift)


def weigh_drift(
    start: Model, dataset: Dataset, options: FitOptions, placed: bool
) -> tuple[Recheck | None, FitOptions, Dataset]:
    """Return of an update whether the robot drifted, the options with the prior that follows, and
    the samples with what to say: the data decide how much each part may have drifted. Nothing tells
    it if nobody stated the noise, or if the samples `placed` the device; then the usual drift is
    the prior. Without an update, and with a prior that is known, nothing is weighed."""
    if not options.update or isinstance(options.prior, Prior):
        return None, options, dataset
    seen = observe(start, dataset, options.joint_sigma, options.insist)
    if seen.noise_assumed:
        why = "nobody stated the noise: state it in the model file, or with --joint-sigma"
    elif placed:
        why = (
            "these samples placed the measuring device, and so explain what changed in the whole "
            "robot alike: measure with the device where it stood at the calibration"
        )
    else:
        found = weigh_changes(start, seen)
        told = replace(dataset, warnings=(*dataset.warnings, *found.warnings))
        return found, replace(options, prior=drift_prior(start, found)), told
    said = f"whether the robot has drifted is not known, because {why}"
    told = replace(dataset, warnings=(*dataset.warnings, said))
    return None, replace(options, prior=update_prior(start)), told


@dataclass(frozen=True)
class UnjudgedFit:
    """A fit without its validation errors, and what computes them: several fits."""

    result: FitResult
    fit_fold: Judged = field(repr=False)

    def judge(self, progress: Progress | None = None) -> FitResult:
        """Compute the validation errors; FitError if a fit without held-out poses fails."""
        result = self.result
        folds = _folds(result.dataset, result.options)
        report = progress or ignore_progress
        # At every pose, of a fit that held it out; NaN if that is not possible.
        parts = result.after.blank().parts()
        for k, (train, test) in enumerate(folds):
            report("fitting without held-out poses", 0.2 + 0.8 * k / len(folds))
            if (unseen := self.fit_fold(train, test)) is not None:
                for name, array in unseen.parts().items():
                    parts[name][test] = array
        return replace(result, held_out=Errors(**parts))


def fit_unjudged(
    model: Model,
    dataset: Dataset,
    options: FitOptions,
    progress: Progress | None = None,
    given: GivenModel | None = None,
    noise: Observations | None = None,
    near: FitResult | None = None,
) -> UnjudgedFit:
    """Fit a model that describes where its device stands; leave the validation errors for later.

    `given` is the model to compare with, by default the model itself. `noise` are the same samples
    with noise that another fit estimated, if this fit must use the same weights. From one that is
    `near`, to the same samples, a single step is made.
    """
    given = given or GivenModel(model, model, dataset, options.joint_sigma, options.insist)
    mask, is_partial = chosen_parameters(model, options)
    estimate_with = estimator(options.method, options.prior, options.loss)
    begin = model.values
    if near is not None and (options.method, options.loss) == ("implicit", "linear"):
        known = near.model.table.mapping(near.model.values)
        begin = np.array([known.get(n, v) for n, v in zip(model.table.names, begin, strict=True)])
        estimate_with = partial(estimate_with, once=True)
    identify = Identification(model, mask, estimate_with, options.prior)
    if is_partial:
        check_convergent_method(options.method, "a partial re-calibration")
    observations = _observe(model, dataset, options, given, noise)
    if words := explain_too_few_poses(model, observations, mask, options.prior):
        raise FitError(words)
    (progress or ignore_progress)("identifying", 0.0)
    found = identify.with_noise(observations, begin, noise_is_known=noise is not None)
    if is_partial:
        found = replace(
            found,
            estimate=add_consider_covariance(found.model, found.observations, mask, found.estimate),
        )
    fitted, unusual, implausible, insisted = _check(found, options)
    after = errors(fitted, found.observations)
    check_joint_errors(fitted, after)
    result = FitResult(
        model=replace(fitted, fixed=model.fixed if is_partial else ~mask),
        start=model,
        options=options,
        estimate=replace(found.estimate, system=None),  # of the size of the data
        free=mask,
        after=after,
        held_out=after.blank(),
        observations=found.observations,
        dataset=dataset,
        warnings=(
            *dataset.warnings,
            *_list_forced(found.observations, given),
            *describe_by_effect(unusual.values()).values(),
            *([implausible] if implausible else []),
            *insisted,
            *_list_warnings(found, fitted, after),
            *list_sample_warnings(found.estimate, dataset, options.loss),
        ),
        given=given,
        unusual=unusual,
        implausible=implausible,
    )
    return UnjudgedFit(result, partial(_judge_fold, identify, found, options))


def _observe(
    model: Model,
    dataset: Dataset,
    options: FitOptions,
    given: GivenModel,
    noise: Observations | None,
) -> Observations:
    """The samples of a fit, with the noise of another one if it is given."""
    if noise is None:
        return given.observe(model, dataset, options.joint_sigma, options.insist)
    observations = observe(model, dataset, options.joint_sigma, options.insist, noise.doubts)
    return observations.with_noise_of(noise)


def _check(
    found: Identified, options: FitOptions
) -> tuple[Model, Mapping[str, UnusualSize], str, Sequence[str]]:
    """What `check_plausible` returns of a fitted model, which keeps the noise that was stated."""
    scaled = found.scaled
    # A scale that all lengths share, such as mm for m, leaves only noise, too.
    leaves_noise = scaled is None and leaves_only_noise(
        found.usual, found.estimate, found.observations
    )
    fitted, unusual, implausible, insisted = check_plausible(
        found.fitted, found.estimate, found.free, options.insist, options.usual_only, leaves_noise
    )
    if scaled is not None and implausible:
        raise ImplausibleGeometryError(f"{scaled}. {implausible}")
    fitted = replace(fitted, noise=fitted.noise.as_stated.with_joints(options.joint_sigma))
    return fitted, unusual, implausible, insisted


def _list_warnings(found: Identified, fitted: Model, after: Errors) -> list[str]:
    """What is doubtful in the parameters that were identified, and in the noise."""
    estimate, observations = found.estimate, found.observations
    return [
        *([] if found.scaled is None else [str(found.scaled)]),
        *list_setting_warnings(fitted),
        *list_parameter_warnings(fitted, estimate, found.free),
        *on_priors(fitted, estimate),
        *list_noise_warnings(fitted, estimate, observations, found.inseparable),
        *list_held_coordinate_warnings(
            fitted, after.summary, lambda: noise_floor(fitted, observations)
        ),
    ]


def _list_forced(observations: Observations, given: GivenModel) -> list[str]:
    """What was doubted and accepted because the user insisted."""
    return [
        f"{doubts}: accepted because of --force (in Python: insist)"
        for doubts in (observations.doubts, given.doubted_columns)
        if doubts
    ]


def _judge_fold(
    identify: Identification,
    found: Identified,
    options: FitOptions,
    train: np.ndarray,
    test: np.ndarray,
) -> Errors | None:
    """Errors at poses that the fit did not use; None if the others are too few."""
    model, estimate, kept = found.model, found.estimate, found.observations.select(train)
    if explain_too_few_poses(model, kept, found.free, options.prior):
        return None
    # Start at the fit to all poses: the solution is near, unless only held-out poses determine
    # a direction. The implicit method has linearised the closure there; a plugin may not.
    system = estimate.system if options.method == "implicit" else None
    begin = system and system.select(train)
    known = {"begin": begin} if begin else {}
    fold = identify.estimate_with(model.with_values(estimate.values), kept, found.free, **known)
    if fold.spectrum.rank < estimate.spectrum.rank:
        fold = identify.estimate_with(model, kept, found.free)
    return errors(model.with_values(fold.values), found.observations.select(test))


def _folds(dataset: Dataset, options: FitOptions) -> Folds:
    return dataset.folds(options.hold_out, options.seed) if options.hold_out > 0 else []


def _method_of(step: Mapping[str, Any]) -> dict[str, Any]:
    """The method and the loss of a step in a model's history."""
    return {"method": step.get("method", "implicit"), "loss": step.get("loss", "linear")}


def _names(model: Model, mask: np.ndarray) -> set[str]:
    return {name for name, chosen in zip(model.table.names, mask, strict=True) if chosen}
