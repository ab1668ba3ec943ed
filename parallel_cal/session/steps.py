"""Steps of a calibration, with their acceptance and their entry in the model's history."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

from parallel_cal.base.arguments import check_arguments, require
from parallel_cal.base.documents import to_json_value
from parallel_cal.base.errors import FitError, ModelError
from parallel_cal.base.notebook import ShownInNotebook
from parallel_cal.base.options import with_changes
from parallel_cal.base.progress import Progress
from parallel_cal.base.threads import single_threaded
from parallel_cal.diagnosis import fitting
from parallel_cal.diagnosis.addition import Addition, find_addition, with_given_model_of
from parallel_cal.identification.acceptance import IN_SAMPLE, Acceptance, acceptance
from parallel_cal.identification.added_effects import limit_patterns
from parallel_cal.identification.fit import FitResult, fit
from parallel_cal.identification.given_model import last_fit_to, was_last_fitted_to
from parallel_cal.identification.options import FitKeywords, FitOptions
from parallel_cal.identification.platform_shift import (
    PlatformShift,
    compute_platform_shift,
)
from parallel_cal.identification.prediction_errors import Summary
from parallel_cal.identification.stations import without_stations
from parallel_cal.identification.thresholds import MAX_NEGLIGIBLE_ERROR_RISE
from parallel_cal.identification.update import ESTIMATED_NOISE
from parallel_cal.model.effect import parse_effects
from parallel_cal.model.model import Model
from parallel_cal.model.shelf import load_effect
from parallel_cal.recordings.dataset import Dataset

if TYPE_CHECKING:
    from typing_extensions import Unpack


class StepKeywords(FitKeywords, total=False):
    """Keyword arguments of `fit` besides model and samples."""

    options: FitOptions | None
    progress: Progress | None


PRIORS = "Repeat the fit with the tolerances of the drawing as priors (--prior). "


class FittedKeywords(StepKeywords, total=False):
    """Keyword arguments of `fitted`, which can add effects before the fit."""

    effects: Sequence[str]


@dataclass(frozen=True)
class Step(ShownInNotebook):
    """Result of a step (`fit`, `add`, `remove`).

    Attributes
    ----------
    name : str
        `fit`, `add` or `remove`.
    model : Model
        The new model. Its history contains the step.
    result : FitResult
        The fit of the new model.
    acceptance : Acceptance
        Whether the new model may replace the old one, and the reason if it may not.
    rival : FitResult, optional
        The fit with which the new model is compared: of the same samples without the added effect,
        or with the removed one. None for `fit`, which is compared with the given model.
    knocked : tuple of int
        Numbers of samples that `add` excluded because they are far from all others, as if somebody
        knocked the device.

    Examples
    --------
    >>> import parallel_cal as pc
    >>> model = pc.read_model("config/delta_mockup_nominal.yaml")
    >>> data = pc.load_dataset("bags/delta_backlash", joints=model.joints)
    >>> step = pc.add(model, "backlash", data)
    >>> step.name, step.acceptance.against, step.model.history[-1]["effect"]
    ('add', '', 'backlash')
    """

    name: str
    model: Model
    result: FitResult
    acceptance: Acceptance
    rival: FitResult | None = None
    knocked: tuple[int, ...] = ()

    def __repr__(self) -> str:
        return f"Step({self.name}, {self.result!r})"

    @property
    def errors_to_beat(self) -> Summary:
        """Validation errors that the step had to beat: of its rival, or else of the given model."""
        rival = self.rival.held_out if self.rival else self.result.held_out_before
        return rival.summary

    @property
    def sigmas_to_beat(self) -> dict[str, float]:
        """Standard deviations of the rms errors in `errors_to_beat`, by kind of error."""
        if self.rival:
            return self.rival.rms_sigmas(self.rival.held_out)
        return self.result.rms_sigmas(self.result.held_out_before)

    @cached_property
    def platform_shift(self) -> PlatformShift | None:
        """How far the step moves the platform compared with its rival; None without a rival."""
        return compute_platform_shift(self.rival, self.result) if self.rival is not None else None

    @property
    def warnings(self) -> tuple[str, ...]:
        """The objection to the new model if it was forced, and the warnings of the fit."""
        against = self.acceptance.against
        if not against:
            return self.result.warnings
        return (against, *(words for words in self.result.warnings if words not in against))

    def with_reason(self, reason: str) -> Step:
        """Return the step with the owner's reason for it in the last entry of its history."""
        *past, last = self.model.history
        return replace(self, model=replace(self.model, history=(*past, {**last, "reason": reason})))

    def without_objection(self) -> Step:
        """Return the step without an objection to its model in the last entry of its history."""
        *past, last = self.model.history
        entry = {key: value for key, value in last.items() if key != "forced"}
        return replace(self, model=replace(self.model, history=(*past, entry)))

    def document(self) -> dict[str, Any]:
        """Return the result as a dict for JSON, with the errors that the step had to beat."""
        document = self.result.document() | {"acceptance": self.acceptance.document()}
        if self.rival is not None:
            key = {"add": "held_out_without_effect", "remove": "held_out_with_effect"}[self.name]
            document[key] = self.rival.held_out.document()
            document["moves_robot"] = to_json_value(self.platform_shift)
        if self.name == "add":
            document["knocked"] = list(self.knocked)
        return document


@single_threaded()
def fitted(
    model: Model, dataset: Dataset, force: bool = False, **options: Unpack[FittedKeywords]
) -> Step:
    """Identify the free parameters, with the options of `fit`.

    FitError if the validation error does not fall, or as `fit` raises it. That an update decides
    that the robot is as it was is no error: its step has an objection, and is not to be written.
    """
    effects = options.pop("effects", ())
    how, progress = _collect_options(options)
    result = fitting.fit(model, dataset, how, progress, effects=effects)
    if result.given.fits_of_these_samples:
        result = replace(result, warnings=(*result.warnings, IN_SAMPLE))
    added = "+".join(n for text in effects for n, _ in parse_effects(text))
    judged = acceptance(result)
    last = last_fit_to(model, dataset)
    if last is not None and not (result.implausible or was_last_fitted_to(model, dataset)):
        # The given model was fitted to these samples with others excluded, so that its error at
        # them proves nothing, and that of the same fit to the present ones is the new one.
        judged = replace(judged, against="")
    has_prior = how.prior or how.update or result.given.fits_of_these_samples
    may_help = judged.judged and not (has_prior or result.implausible or result.outliers)
    needs_none = result.drift is not None and result.drift.needs_no_update
    found = _check_proven(judged, force or needs_none, PRIORS if may_help else "")
    return _step("fit", result, found, effect=added or None)


@check_arguments(ModelError)
@single_threaded()
def add(
    model: Model,
    effect: str,
    dataset: Dataset,
    force: bool = False,
    knocked: Sequence[int] | None = None,
    **options: Unpack[StepKeywords],
) -> Step:
    """Add an effect to a model and identify all free parameters again.

    Both models, with and without the effect, are fitted to the same samples and compared. The
    improvement by the geometry alone is therefore not attributed to the effect. Single samples that
    are far from all others, such as those at which somebody knocked the device, are excluded from
    both, as `diagnose` excludes them.

    Parameters
    ----------
    model : Model
    effect : str
        `"NAME"` or `"NAME:parameter=value,..."`; several effects are joined by `+`. A stated
        parameter is fixed. An unknown gear ratio, order or lead is searched for.
    dataset : Dataset
    force : bool, optional
        Return the result even if the validation error does not fall, or if the measuring device
        may be the cause of the error. To accept implausible joint readings, or values that are
        impossible together, too, pass `insist=True` (`--force` of the command does both).
    knocked : sequence of int, optional
        Numbers of the samples to exclude because they are far from all others: pass `knocked` of
        the diagnosis that named the effect. By default `add` finds them itself, unless a robust
        `loss` is used.
    **options
        Keyword arguments of `fit`: `options` (a FitOptions), `progress`, or single fields of
        FitOptions by name.

    Returns
    -------
    Step
        `step.model` is the new model, with this step in its history. `step.result` is the fit with
        the effect, `step.rival` the fit without it, for comparison.

    Raises
    ------
    FitError
        In three cases: (1) the error at held-out poses does not fall; (2) the measuring device may
        cause the error; (3) the data cannot determine the parameters. `force=True` accepts the
        first two.
    ModelError
        If the effect is unknown or does not apply to the model.

    Examples
    --------
    >>> import parallel_cal as pc
    >>> model = pc.read_model("config/delta_mockup_nominal.yaml")
    >>> data = pc.load_dataset("bags/delta_backlash", joints=model.joints)
    >>> step = pc.add(model, "backlash", data)
    >>> step.model.effects[-1].name
    'backlash'
    """
    how, progress = _collect_options(options)
    return step_of(find_addition(model, effect, dataset, how, progress, knocked), force)


def step_of(found: Addition, force: bool = False) -> Step:
    """The step that adds effects whose fits are known; UnprovenStepError as `add` raises it."""
    accepted = _check_proven(found.acceptance, force)
    return _step("add", found.result, accepted, found.base, found.names, found.knocked)


@check_arguments(ModelError)
@single_threaded()
def remove(
    model: Model,
    effect: str,
    dataset: Dataset,
    force: bool = False,
    **options: Unpack[StepKeywords],
) -> Step:
    """Remove an effect from a model and identify all free parameters again.

    Parameters
    ----------
    model : Model
    effect : str
        The name of an effect of the model.
    dataset : Dataset
    force : bool, optional
        Return the result even if the validation error rises.
    **options
        Keyword arguments of `fit`: `options` (a FitOptions), `progress`, or single fields of
        FitOptions by name.

    Returns
    -------
    Step
        `step.model` is the new model, with this step in its history. `step.result` is the fit
        without the effect, `step.rival` the fit with it, for comparison.

    Raises
    ------
    FitError
        If the error at held-out poses rises by 1 % or more, unless `force=True`.
    ModelError
        If the model has no such effect.

    Examples
    --------
    >>> import parallel_cal as pc
    >>> model = pc.read_model("config/delta_mockup_nominal.yaml")
    >>> data = pc.load_dataset("bags/delta_backlash", joints=model.joints)
    >>> with_backlash = pc.add(model, "backlash", data).model
    >>> pc.remove(with_backlash, "backlash", data)
    Traceback (most recent call last):
    ...
    parallel_cal.session.steps.UnprovenStepError: ...
    >>> pc.remove(with_backlash, "backlash", data, force=True).model.effects
    ()
    """
    smaller = model.without_effect(effect)  # report a wrong name before a fit
    how, progress = _collect_options(options)
    with_it = fit(model, dataset, how, progress)
    limited = replace(limit_patterns(how, smaller, model), prior=with_it.prior or how.prior)
    result = with_given_model_of(
        fit(with_it.start.without_effect(effect), with_it.dataset, limited, progress), with_it
    )
    found = acceptance(result, with_it, f" without '{effect}'", MAX_NEGLIGIBLE_ERROR_RISE)
    return _step("remove", result, _check_proven(found, force), with_it, effect)


def _collect_options(options: StepKeywords) -> tuple[FitOptions, Progress | None]:
    """Return the options of a fit as one object, and the progress function."""
    changes = dict(options)
    given, progress = changes.pop("options", None), changes.pop("progress", None)
    require("options", given, "FitOptions | None", FitError)
    return with_changes(given, FitOptions, changes, FitError), progress  # type: ignore[arg-type,return-value]


class UnprovenStepError(FitError):
    """A step was refused because of `against`, and the caller did not force it."""

    def __init__(self, against: str, cure: str = "") -> None:
        super().__init__(f"{against}; nothing was written. {cure}Use --force to write it anyway")
        self.against = against


def _check_proven(found: Acceptance, force: bool, cure: str = "") -> Acceptance:
    """Return `found`; UnprovenStepError if it has an objection and the caller does not force."""
    if found.against and not force:
        raise UnprovenStepError(found.against, cure)
    return found


def _step(
    name: str,
    result: FitResult,
    found: Acceptance,
    rival: FitResult | None = None,
    effect: str | None = None,
    knocked: tuple[int, ...] = (),
) -> Step:
    """Make the step and add it to its model's history, without a date so that it is repeatable."""
    entry: dict[str, Any] = {"step": name}
    if effect is not None:
        entry["effect"] = effect
        if any(load_effect(one).found_in_data for one in effect.split("+")):
            entry["cause"] = "unknown: found in data"
    judged = result.history_entry()
    entry |= {key: judged[key] for key in ("method", "samples", "dataset", "region")}
    # What differs from least squares of all free parameters on all samples.
    unusual = {
        "loss": result.options.loss if result.options.loss != "linear" else None,
        "refit": list(result.refitted_parameters),
        "excluded": sorted(result.dataset.excluded),
        "knocked": list(knocked),
        "down_weighted": [doubted.sample for doubted in result.down_weighted],
        "registered": result.registration.description if result.registration else None,
        ESTIMATED_NOISE: judged.get(ESTIMATED_NOISE),  # of which the next update must know
    }
    entry |= {key: value for key, value in unusual.items() if value}
    if found.against:
        entry["forced"] = found.against
    entry |= {key: judged[key] for key in ("before", "after", "held_out", "chi2_per_dof")}
    # Stations belong to these recordings, not to the robot.
    robot = without_stations(result.model)
    model = replace(robot, history=(*robot.history, entry))
    return Step(name, model, result, found, rival, knocked)
