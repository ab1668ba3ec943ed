"""Add effects to a model, and judge whether they may be added.

`add` writes what is accepted here, and `diagnose` names what is accepted here: the samples, the
frames, the folds and the noise are the same, so that `add` reaches what the diagnosis promised.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

from parallel_cal.base.confidence import format_percent
from parallel_cal.base.progress import Progress
from parallel_cal.causes.effects import list_effects_to_test
from parallel_cal.causes.knocks import are_few
from parallel_cal.diagnosis.catalogue import Candidate, candidate
from parallel_cal.diagnosis.causes import Causes, find_knocked_samples
from parallel_cal.diagnosis.device import find_doubtful_effects
from parallel_cal.diagnosis.patterns import (
    explain_exclusion,
    find_innocent_samples,
    list_samples_far_from,
)
from parallel_cal.diagnosis.stations import exclude_device
from parallel_cal.diagnosis.thresholds import MAX_DIAGNOSED_SAMPLES
from parallel_cal.diagnosis.verdict import robot_or_device
from parallel_cal.identification.acceptance import Acceptance, acceptance
from parallel_cal.identification.added_effects import limit_patterns
from parallel_cal.identification.fit import FitResult, fit, fit_unjudged
from parallel_cal.identification.fit_warnings import list_setting_warnings
from parallel_cal.identification.options import FitOptions
from parallel_cal.identification.platform_shift import (
    explain_unseparated_device,
    find_large_device_effects,
)
from parallel_cal.model.effect import parse_effects
from parallel_cal.model.model import Model
from parallel_cal.posterior.scene import Scene
from parallel_cal.posterior.search import WeighedSetting
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.lagged import add_lagged_conditions


@dataclass(frozen=True)
class Addition:
    """Effects that may be added, with the fits without and with them, and their judgement.

    Attributes
    ----------
    recorded : Dataset
        The samples in the frames in which each recording has them.
    base, result : FitResult
        The fits of these samples without and with the effects.
    scene : Scene
        The residuals of `base`.
    effects : tuple of Candidate
        The effects, scored on these residuals, with their settings.
    text : str
        The effects as `add` takes them.
    knocked : tuple of int
        Numbers of the samples that both fits exclude because they are far from all others.
    """

    recorded: Dataset = field(repr=False)
    base: FitResult
    result: FitResult
    scene: Scene
    effects: tuple[Candidate, ...]
    text: str
    knocked: tuple[int, ...] = ()

    @property
    def names(self) -> str:
        return "+".join(one.name for one in self.effects)

    @cached_property
    def acceptance(self) -> Acceptance:
        """Whether the effects may be added, with the reason against them if not."""
        found, _ = self._judgement
        if found.against and (settings := list_setting_warnings(self.result.model)):
            found = replace(found, against="; ".join([*settings, found.against]))
        if found.against and self.knocked:
            numbers = ", ".join(map(str, self.knocked))
            found = replace(found, against=f"{found.against} (judged without sample {numbers})")
        return found

    @property
    def doubtful(self) -> tuple[str, ...]:
        """Names of the effects that the other side, robot or device, may cause, if they are refused
        for that."""
        return self._judgement[1]

    @cached_property
    def _judgement(self) -> tuple[Acceptance, tuple[str, ...]]:
        base, result = self.base, self.result
        found = acceptance(result, base, f" with '{self.names}'")
        if found.against:
            return found, ()
        if self.probability < 0.5:
            words = f"the improvement by '{self.names}' is chance rather than an effect"
            against = f"{words} (probability of an effect {format_percent(self.probability)})"
            return replace(found, against=against), ()
        if exclude_device(self.scene, self.recorded, self.effects, result.model):
            return found, ()
        doubtful = tuple(find_large_device_effects(result.model))
        doubt = explain_unseparated_device(base, result)
        if not doubt:
            doubtful, doubt = self._find_doubt()
        if doubt:
            return replace(found, against=doubt, device_may_err=True), doubtful
        return found, ()

    @cached_property
    def probability(self) -> float:
        """How probable it is that the robot has at least one of these effects, if nothing but noise
        may be in their place."""
        settings = {one.name: one.settings for one in self.effects}
        return Causes.of(self.scene, list(settings), settings, ()).sum.search().of_any(settings)

    def _find_doubt(self) -> tuple[tuple[str, ...], str]:
        """Find the effects that the other side, robot or device, may cause, and explain why; no
        effect and no text if nothing suggests it."""
        part = next(self.scene.divide(MAX_DIAGNOSED_SAMPLES))
        doubtful = find_doubtful_effects(part, self.effects)
        if not doubtful:
            return (), ""
        some, every = len(part.dataset), len(self.scene.dataset)
        seen = f" (weighed with {some} of {every} samples, evenly spread over the recording)"
        return tuple(doubtful), robot_or_device(doubtful[0]) + (seen if some < every else "")


def find_addition(
    model: Model,
    effect: str,
    dataset: Dataset,
    options: FitOptions,
    progress: Progress | None = None,
    knocked: Sequence[int] | None = None,
    known: tuple[FitResult, FitResult | None] | None = None,
) -> Addition:
    """Fit a model without and with effects to the same samples.

    Parameters
    ----------
    model : Model
    effect : str
        As `add` takes it: `"NAME:parameter=value,..."`, several effects joined by `+`.
    dataset : Dataset
    options : FitOptions
    progress : callable, optional
    knocked : sequence of int, optional
        Numbers of the samples to exclude because they are far from all others. By default they are
        searched for, unless the loss is robust.
    known : tuple of FitResult, optional
        The fits of all samples without and with the effects, if they are known. The second is None
        if the noise is not stated: this fit estimates it.

    Returns
    -------
    Addition

    Raises
    ------
    FitError
        If the model, or the model with the effects, cannot be identified from the samples.
    ModelError
        If an effect is unknown or does not apply to the model.
    """
    asked, larger = parse_effects(effect), model
    for name, settings in asked:  # report a wrong name before a search
        larger = larger.with_effect(name, settings)
    dataset = add_lagged_conditions(larger.conditions, dataset)
    limited = limit_patterns(options, model, larger)

    def keep(aside: Sequence[int]) -> Dataset:
        return dataset.excluding(aside, f"because it is {explain_exclusion(dataset, aside)}")

    def fit_with(added: Sequence[Candidate], base: FitResult) -> FitResult:
        extended = base.start
        for one in added:
            extended = extended.with_effect(one.name, one.settings)
        how = replace(options, prior=base.prior or options.prior)  # of an update, that of today
        placed = base.given.place(extended, how)
        return fit_unjudged(placed, base.dataset, how, progress, base.given).judge(progress)

    def extend(
        base: FitResult, scene: Scene, aside: Sequence[int], result: FitResult | None = None
    ) -> Addition:
        added = list[Candidate]()
        for name, settings in asked:
            known = WeighedSetting(settings, 1.0, {}) if settings else None
            added.append(candidate(scene, name, known=known, apart=True))
        result = with_given_model_of(result or fit_with(added, base), base)
        return Addition(keep(aside), base, result, scene, tuple(added), effect, tuple(aside))

    def fit_both(aside: Sequence[int], trusted: frozenset[int] = frozenset()) -> Addition:
        base = fit(model, keep(aside), limited, progress)
        if base.implausible and knocked is None and base.outliers and not aside:
            # The geometry may follow a few samples that contradict all others.
            return fit_both(base.outliers.numbers)
        scene = see(base)
        if knocked is None and options.loss == "linear":
            names = list_effects_to_test(base.model, [name for name, _ in asked])
            more = {*find_knocked_samples(scene, names)} - trusted
            if more and are_few([*aside, *more], dataset):
                del scene  # it is large, and the next fits have their own
                others = fit_both(sorted([*aside, *more]), trusted)
                model_found, seen = others.result.model, base.observations
                far = list_samples_far_from(model_found, base.dataset, seen, more)
                innocent = find_innocent_samples(far, more)
                return fit_both(aside, trusted | innocent) if innocent else others
        return extend(base, scene, aside)

    if known:
        return extend(known[0], see(known[0]), (), known[1])
    return fit_both(knocked or ())


def see(found: FitResult) -> Scene:
    """The residuals of a fit, on which candidates are scored."""
    return Scene.of(found.model, found.dataset, found.observations, found.free, within=found.prior)


def with_given_model_of(result: FitResult, rival: FitResult) -> FitResult:
    """Let a fit be compared with the model that its rival started from."""
    given = replace(rival.given, known_held_out=rival.held_out_before)
    return replace(result, given=given, registration=rival.registration)
