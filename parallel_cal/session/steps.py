"""Steps of a calibration, with their acceptance and their entry in the model's history."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
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
from parallel_cal.diagnosis.catalogue import Candidate, candidate, list_effects_to_test
from parallel_cal.diagnosis.device import find_doubtful_effects, is_needed
from parallel_cal.diagnosis.entries import are_confused, is_clearly_better
from parallel_cal.diagnosis.patterns import explain_exclusion, set_knocked_samples_aside
from parallel_cal.diagnosis.scene import Scene
from parallel_cal.diagnosis.search import Trial, is_as_good, is_superfluous
from parallel_cal.diagnosis.stations import exclude_device
from parallel_cal.diagnosis.verdict import robot_or_device
from parallel_cal.identification.acceptance import IN_SAMPLE, Acceptance, acceptance
from parallel_cal.identification.added_effects import limit_patterns
from parallel_cal.identification.checks import ImplausibleGeometryError
from parallel_cal.identification.fit import FitResult, fit, fit_unjudged
from parallel_cal.identification.fit_warnings import list_setting_warnings
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.options import FitKeywords, FitOptions
from parallel_cal.identification.platform_shift import (
    PlatformShift,
    compute_platform_shift,
    explain_unseparated_device,
    find_large_device_effects,
)
from parallel_cal.identification.prediction_errors import Summary
from parallel_cal.identification.stations import without_stations
from parallel_cal.identification.thresholds import MAX_NEGLIGIBLE_ERROR_RISE
from parallel_cal.model.effect import parse_effects
from parallel_cal.model.model import Model
from parallel_cal.model.shelf import load_effect
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.lagged import add_lagged_conditions

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
        """Warnings of the fit, and the objection to the new model if it was forced."""
        against = self.acceptance.against
        if not against:
            return self.result.warnings
        return (*(words for words in self.result.warnings if words not in against), against)

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

    FitError if the validation error does not fall, or as `fit` raises it.
    """
    effects = options.pop("effects", ())
    how, progress = _collect_options(options)
    result = fitting.fit(model, dataset, how, progress, effects=effects)
    if result.given.fits_of_these_samples:
        result = replace(result, warnings=(*result.warnings, IN_SAMPLE))
    added = "+".join(n for text in effects for n, _ in parse_effects(text))
    judged = acceptance(result)
    may_help = judged.judged and not (how.prior or result.given.fits_of_these_samples)
    found = _check_proven(judged, force, PRIORS if may_help else "")
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
    asked, larger = parse_effects(effect), model
    for name, _ in asked:  # report a wrong name before a search
        larger = larger.with_effect(name)
    dataset = add_lagged_conditions(larger.conditions, dataset)
    how, progress = _collect_options(options)

    def fit_both(aside: Sequence[int]) -> _Addition:
        limited = limit_patterns(how, model, larger)
        kept = dataset.excluding(aside, f"because it is {explain_exclusion(dataset, aside)}")
        base = fit(model, kept, limited, progress)
        scene = _see(base)
        # Start where the base started, so that the device's frame is the one registered there.
        more, extended = list[Candidate](), base.start
        for name, settings in asked:
            one = candidate(scene, name)  # with the settings that fit the residuals best
            more.append(replace(one, settings=settings or one.settings))
            extended = extended.with_effect(name, more[-1].settings)
        result = fit(extended, base.dataset, how, progress)
        result = _with_given_model_of(result, base)
        return _Addition(kept, scene, more, base, result, tuple(aside))

    try:
        both = fit_both(knocked or ())
    except ImplausibleGeometryError as error:
        if knocked is not None or not error.outliers:
            raise
        both = fit_both(error.outliers)
    if knocked is None and not both.knocked and how.loss == "linear":
        fits = [*both.scenes()]
        if not both.judge().against:  # samples that the effect explains, such as a few under load
            fits = fits[1:]
        without = set_knocked_samples_aside(fits, fit_both, lambda others: others.result.model)
        both = without[1] if without else both
    found = both.judge()
    if found.against and (doubtful := list_setting_warnings(both.result.model)):
        found = replace(found, against="; ".join([*doubtful, found.against]))
    if found.against and both.knocked:
        numbers = ", ".join(map(str, both.knocked))
        found = replace(found, against=f"{found.against} (judged without sample {numbers})")
    found = _check_proven(found, force)
    return _step("add", both.result, found, both.base, both.names, both.knocked)


def _see(found: FitResult) -> Scene:
    """The residuals of a fit, on which candidates are scored."""
    return Scene.of(found.model, found.dataset, found.observations, found.free)


@dataclass(frozen=True)
class _Addition:
    """Effects that may be added, as candidates in a scene, with the fits without and with them;
    `recorded` are the samples in the frames in which each recording has them, and `knocked` those
    that both fits leave out."""

    recorded: Dataset
    scene: Scene
    effects: list[Candidate]
    base: FitResult
    result: FitResult
    knocked: tuple[int, ...]

    @property
    def names(self) -> str:
        return "+".join(one.name for one in self.effects)

    def scenes(self) -> Iterator[tuple[Scene, FitResult]]:
        """The residuals of both fits, and the fits."""
        yield self.scene, self.base
        yield _see(self.result), self.result

    def judge(self) -> Acceptance:
        """Judge whether the effects may be added, with the reason against them if not."""
        scene, base, result = self.scene, self.base, self.result
        found = acceptance(result, base, f" with '{self.names}'")
        if found.against:
            return found
        if is_superfluous(with_noise_of(base, result.observations).estimate, result.estimate):
            return replace(found, against=f"the improvement by '{self.names}' may be chance")
        if exclude_device(scene, self.recorded, self.effects, result.model):
            return found
        doubt = explain_unseparated_device(base, result)
        if doubt := doubt or _explain_doubt(scene, self.effects, base, result):
            return replace(found, against=doubt, device_may_err=True)
        return found


def with_noise_of(found: FitResult, noise: Observations) -> FitResult:
    """Repeat a fit with the noise that another fit of the same samples estimated.

    Only with equal weights can the residuals of two fits be compared. If all noise is stated, the
    fit is returned as it is.
    """
    if not noise.unknown:
        return found
    options = replace(found.options, hold_out=0)
    return fit_unjudged(found.start, found.dataset, options, noise=noise).judge()


def _with_given_model_of(result: FitResult, rival: FitResult) -> FitResult:
    """Let a fit be compared with the model that its rival started from."""
    given = replace(rival.given, known_held_out=rival.held_out_before)
    return replace(result, given=given, registration=rival.registration)


def _explain_doubt(scene: Scene, added: list[Candidate], base: FitResult, result: FitResult) -> str:
    """Explain why effects that lower the error may be wrong; empty if nothing suggests it.

    The device may cause one of them, or an effect of the device explains the error clearly better,
    or as well in place of one of them.
    """
    fitted = result.model
    device_effects = [n for n in list_effects_to_test(scene.model) if load_effect(n).of_device]
    device = [candidate(scene, name) for name in device_effects]
    if doubtful := find_doubtful_effects(scene, added, device, fitted):
        return robot_or_device(doubtful[0])
    large = find_large_device_effects(fitted)
    for one in added:
        # An error of the device of usual size is none that the robot would learn.
        if one.effect.of_device and one.name not in large:
            continue
        better = [c for c in device if c.scene is one.scene and is_clearly_better(c, one)]
        others = [c for c in added if c is not one]  # they may hide what this one explains
        if better and not is_needed([one], [*others, *better], scene, fitted):
            outdone_by = " and ".join(c.name for c in better)
            return (
                f"{outdone_by} explains the error clearly better than '{one.name}' (see diagnose)"
            )
    for one in added:
        alike = [c for c in device if not c.effect.needs and are_confused(one, c)]
        if not one.effect.of_device and any(
            _fits_as_well(one, rival, added, base, result) for rival in alike
        ):
            return robot_or_device(one.name)
    return ""


def _fits_as_well(
    one: Candidate, rival: Candidate, added: list[Candidate], base: FitResult, result: FitResult
) -> bool:
    """Whether a rival fits as well in place of one of the added effects. It may be larger than
    usual if this effect is."""
    swapped = base.start
    try:
        for each in added:
            chosen = rival if each is one else each
            swapped = swapped.with_effect(chosen.name, chosen.settings)
        other = fit_unjudged(
            swapped, base.dataset, result.options, given=base.given, noise=result.observations
        ).judge()
    except (FitError, ModelError):
        return False
    own, its = ({size.effect for size in r.unusual.values()} for r in (result, other))
    if rival.name in its and one.name not in own:
        return False
    return is_as_good(Trial((), result), Trial((), other))


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
    limited = limit_patterns(how, smaller, model)
    result = _with_given_model_of(
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
    }
    entry |= {key: value for key, value in unusual.items() if value}
    if found.against:
        entry["forced"] = found.against
    entry |= {key: judged[key] for key in ("before", "after", "held_out", "chi2_per_dof")}
    # Stations belong to these recordings, not to the robot.
    robot = without_stations(result.model)
    model = replace(robot, history=(*robot.history, entry))
    return Step(name, model, result, found, rival, knocked)
