"""What the residuals of a robot are made of: the likeliest causes, proven on the true problem.

The sum over all sets of causes is linear. A cause that the true problem refutes (a size that no
robot has, a sign that physics forbids) leaves the sum, and where the causes move the geometry, the
sum is made again about the geometry found with them, unless the fit leaves what the sum predicts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from parallel_cal.causes.effects import (
    compute_effect_columns,
    extend,
    find_new_parameters,
)
from parallel_cal.causes.settings import weigh_settings
from parallel_cal.causes.unknown_laws import name_law
from parallel_cal.diagnosis.catalogue import candidate
from parallel_cal.diagnosis.causes import Causes, Doubt, as_effects, find_swaps
from parallel_cal.diagnosis.search import Chosen, Search, Trial
from parallel_cal.diagnosis.thresholds import CREDIBLE
from parallel_cal.identification.observations import conditions
from parallel_cal.identification.prior import Prior
from parallel_cal.model.shelf import load_effect
from parallel_cal.posterior.blocks import DRIFT, EFFECT, FIELD, LAW
from parallel_cal.posterior.evidence import Choice
from parallel_cal.posterior.scene import Scene
from parallel_cal.posterior.search import Posterior, WeighedSetting

MAX_LINEARISATIONS = 2
MIN_SHOWN = 0.01  # probability of a setting that is listed


@dataclass(frozen=True)
class Explanation:
    """The likeliest causes of the residuals of a model.

    Attributes
    ----------
    search : Search
        The refits.
    posterior : Posterior
        All causes with their probabilities.
    described : Posterior
        The same without unknown laws of the robot: what known effects describe best.
    best : Trial
        The fit with these effects.
    refuted : Mapping
        Effects that would have been likely, with the reason why no robot has them.
    wrong_signs : tuple of str
        The reasons of those that fit only with a sign that physics forbids.
    knocked : tuple of int
        Numbers of the samples that were disturbed alone. Where there are any, the explanation ends
        with the sums: without them it is another.
    first : tuple of str
        The effects without which only a geometry that no robot has describes the samples; the sums
        are about the model with them.
    absurd : Mapping
        Effects that would have been possible in the place of one that was found, with the reason
        why no robot has them.
    doubt : Doubt or None
        The sets of effects that the sum leaves possible; None if samples were disturbed.
    """

    search: Search = field(repr=False)
    posterior: Posterior = field(repr=False)
    described: Posterior = field(repr=False)
    best: Trial = field(repr=False)
    refuted: Mapping[str, str]
    wrong_signs: tuple[str, ...] = ()
    first: tuple[str, ...] = ()
    knocked: tuple[int, ...] = ()
    absurd: Mapping[str, str] = field(default_factory=dict)
    doubt: Doubt | None = field(default=None, repr=False)

    @classmethod
    def of(
        cls,
        search: Search,
        names: Sequence[str],
        set_aside: Callable[[Sequence[int]], Sequence[int]],
    ) -> Explanation:
        """Explain the residuals of the model that a search extends, by effects of these `names`,
        by what no effect describes, and by samples that were disturbed alone: the explanation ends
        with those of them that `set_aside` returns."""
        base = search.fit()
        if base.fitted.implausible:
            base = _find_first(search, base, names)
        first, names = base.chosen, [name for name in names if name not in base.names]
        refuted, wrong = dict[str, str](), list[str]()
        # What a first cause leaves may still be imitated by a geometry that no robot has.
        known = _find_known(base) if first else base.fitted.prior
        scene = _scene_about(base, base, known) if first else base.scene
        causes, seen = Causes.of(scene, names), list[frozenset[Chosen]]()
        absurd = dict[str, str]()
        near = tuple[Sequence[Choice], ...]()
        while True:
            posterior, described, more = causes.explain({*refuted, *absurd}, *near)
            near = posterior.chosen, described.chosen
            if knocked := tuple(set_aside(posterior.knocked)):
                return cls(search, posterior, described, base, refuted, knocked=knocked)
            chosen = (*first, *more)
            tried = search.fit_as_shown(*chosen, judged=False)
            if tried.result is None and more:
                name = tried.wrong_sign or _find_refuted(search, first, more)
                refuted[name] = tried.reason
                wrong += [tried.reason] if tried.wrong_sign else []
                continue
            ended = not more or frozenset(chosen) in seen or len(seen) == MAX_LINEARISATIONS
            nearer = None if ended else causes.find_nearer(search, first, tried, described)
            if nearer is None:
                found = cls(search, posterior, described, tried, refuted, tuple(wrong), base.names)
                doubt = causes.list_possible(described, found.swaps)
                if rivals := found.find_absurd_rivals(doubt):
                    absurd |= rivals
                    continue
                best = search.fit_as_shown(*chosen)
                described = replace(described, settings=_weigh_settings(causes, described))
                return replace(found, described=described, best=best, absurd=absurd, doubt=doubt)
            seen.append(frozenset(chosen))
            causes = Causes.of(_scene_about(base, nearer, known), names)

    @property
    def outdone(self) -> tuple[str, ...]:
        """Say which refuted effects would explain the error better than what was found."""
        return tuple(
            f"{name} would explain the error better, but {reason}"
            for name, reason in self.refuted.items()
            if reason not in self.wrong_signs
        )

    @cached_property
    def swaps(self) -> dict[str, list[str]]:
        """For each effect found, the effects that may be in its place, the likeliest first."""
        return find_swaps(self.described)

    def find_absurd_rivals(self, doubt: Doubt) -> dict[str, str]:
        """Rivals that contradict physics where a fit has them in the place of what was found, with
        the reasons."""
        found, own = dict[str, str](), {one.block.name for one in self.described.chosen}
        for _, causes in doubt.sets[1:]:
            effects = as_effects(causes)
            first = (one for one in self.best.chosen if one.name in self.first)
            # A single step tells whether a fit is worth its time.
            trial = self.search.fit_as_shown(*first, *effects, judged=False, once=True)
            if trial.contradicts:
                trial = self.search.fit_as_shown(*first, *effects, judged=False)
            if trial.contradicts:
                [rival] = {one.name for one in effects} - own
                found[rival] = trial.reason
        return found

    @property
    def robot_or_device(self) -> tuple[str, ...]:
        """Effects of the robot that lasting errors of the device may be instead."""
        return tuple(
            name
            for name, others in self.swaps.items()
            if self.described.kinds[name] == EFFECT
            and not load_effect(name).of_device
            and any(_is_lasting_error_of_device(other) for other in others)
        )

    @cached_property
    def like_drift(self) -> tuple[str, ...]:
        """Effects of time or temperature that would describe the residual in the place of noise
        that drifts, which describes it better."""
        sets = {frozenset(members): p for members, p in self.described.sets}
        chosen = frozenset(one.block.name for one in self.described.chosen)
        found = {name for name in chosen if _depends_on(self.described, name, {"time"})}
        if not any(self.described.kinds[name] == DRIFT for name in chosen):
            return ()
        for drift in (name for name in chosen if self.described.kinds[name] == DRIFT):
            rest = chosen - {drift}
            found |= {
                name
                for name in self.described.kinds
                if _depends_on(self.described, name, {"time", "temperature"})
                and sets.get(rest | {name}, 0.0) > sets.get(rest, 0.0)
            }
        return tuple(sorted(found))

    @property
    def settings(self) -> dict[str, WeighedSetting]:
        """The numbers of each effect found of which they were scanned."""
        found = dict[str, WeighedSetting]()
        for one in self.best.chosen:
            peaks = self.described.settings.get(one.name)
            if peaks and one.name not in self.first:
                keys = sorted({key for peak in peaks for key in peak.values} | {*one.settings})
                own = np.array([[peak.values.get(key, 0.0) for key in keys] for peak in peaks])
                away = np.abs(own - [one.settings.get(key, 0.0) for key in keys]).sum(axis=1)
                found[one.name] = replace(peaks[int(away.argmin())], values=one.settings)
        return found

    @property
    def imitating(self) -> set[str]:
        """Names of the effects found that the likeliest set does not contain: they imitate an
        unknown law that it has."""
        likely = {one.block.name for one in self.posterior.chosen}
        return set(self.best.names) - likely - set(self.first)

    @cached_property
    def probable(self) -> set[str]:
        """Names of the effects that are worth a fit of their own."""
        sums = (self.posterior, self.described)
        return {n for each in sums for n, p in each.probability.items() if p > 1 - CREDIBLE}

    def probability_of(self, name: str) -> float | None:
        """How probable it is that the robot has an effect; None if the sum is not about it."""
        return 1.0 if name in self.first else self.posterior.probability.get(name)

    @property
    def laws(self) -> dict[str, float]:
        """What no effect describes and the likeliest set contains, with its probability: laws of
        the robot, with their joint, and fields of errors of the device."""
        joints = self.best.fitted.model.joints
        return {
            name_law(one.block.name, one.setting, joints): self.posterior.probability[
                one.block.name
            ]
            for one in self.posterior.chosen
            if one.block.kind in (LAW, FIELD)
        }

    def missing(self, names: Sequence[str]) -> list[dict[str, Any]]:
        """For each of these effects, what it may be, how probable it is that the robot has one of
        them, and each of them, and the probabilities of the numbers that were scanned."""
        found = []
        for name in names:
            effects = [name, *self.swaps.get(name, [])]
            each = {one: self.probability_of(one) or 0.0 for one in effects}
            together = 1.0 if name in self.first else self.posterior.of_any(effects)
            cause = {"effects": effects, "probability": together, "each": each}
            settings = {
                one: [asdict(each) for each in weighed]
                for one in effects
                if (weighed := self.described.settings.get(one))
            }
            found.append({**cause, "settings": settings})
        return found


def _weigh_settings(causes: Causes, found: Posterior) -> dict[str, list[WeighedSetting]]:
    """The likely settings of each effect that a sum found, with their probabilities."""
    settings = {}
    for one in found.chosen:
        if one.block.kind == EFFECT and one.is_scanned:
            rest = [other for other in found.chosen if other is not one]
            beside = causes.sum.evidence(rest, found.nu)
            weighed = weigh_settings(causes.scene, beside, one)
            settings[one.block.name] = [each for each in weighed if each.probability > MIN_SHOWN]
    return settings


def _is_lasting_error_of_device(name: str) -> bool:
    effect = load_effect(name)
    return effect.of_device and not effect.needs


def _depends_on(posterior: Posterior, name: str, conditions: set[str]) -> bool:
    return posterior.kinds[name] == EFFECT and not conditions.isdisjoint(load_effect(name).needs)


def _find_known(base: Trial) -> Prior:
    """The knowledge of the robot before these samples: its drawing, or the prior of the fit."""
    return base.fitted.prior or Prior.of_drawing(base.fitted.model.table)


def _scene_about(base: Trial, best: Trial, within: Prior | None) -> Scene:
    """The scene of the model without further effects, with the geometry found with them.

    Its residual is that of the fit with them, extrapolated to none of them: a sum about it is exact
    at this fit, and what the curvature of a large effect leaves calls for no further cause.
    """
    fitted, result = base.fitted, best.fitted.model
    found = result.table.mapping(result.values)
    before = fitted.model.table.mapping(fitted.model.values)
    # A joint whose number differs now keeps its wave of before.
    renewed = {one.name for one in best.chosen if fitted.model.has_effect(one.name)}
    values = np.array(
        [
            value if name.partition(".")[0] in renewed else found.get(name, value)
            for name, value in before.items()
        ]
    )
    about = replace(fitted.model, values=values)
    scene = Scene.of(about, fitted.dataset, fitted.observations, fitted.free, base.shared, within)
    effects = [one for one in best.chosen if one not in base.chosen]
    if within is not None or not effects or result.mechanism is not about.mechanism:
        return scene
    residual = best.scene.closure_residual
    if scene.turn is not None:
        residual = np.einsum("nk,nrk->nr", residual, scene.turn)
    residual = residual.reshape(-1)
    for one in effects:
        plain = extend(about, one.name)
        a = conditions(plain, fitted.dataset)
        new = find_new_parameters(about, plain.with_settings(one.name, one.settings))
        away = np.array([found[name] for name in np.array(plain.table.names)[new]])
        away = (away - plain.table.nominal[new]) / plain.table.tolerance[new]
        residual = residual - compute_effect_columns(scene, plain, one.settings, a, True) @ away
    return replace(scene, residual=scene.project_off_geometry(residual))


def _find_first(search: Search, base: Trial, names: Sequence[str]) -> Trial:
    """The fit with that likely cause with which a plausible geometry describes the samples best, or
    with all of them if none is enough alone; the given one if there is none.

    The sum is about what is known of the robot, such as its drawing with the tolerances: about a
    geometry that no robot has, other effects imitate what is missing.
    """
    fitted, known = base.fitted, _find_known(base)
    drawn = Scene.of(fitted.start, fitted.dataset, fitted.observations, fitted.free, within=known)
    posterior, _, chosen = Causes.of(drawn, names).explain()
    likely = {one.name: one for one in chosen}
    for name, p in posterior.probability.items():
        if p > 1 - CREDIBLE and posterior.kinds[name] == EFFECT and name not in likely:
            likely[name] = Chosen.of(candidate(drawn, name))
    sets = [(one,) for one in likely.values()]
    for tried in (sets, [chosen] if len(chosen) > 1 else []):
        trials = (search.fit_as_shown(*one, judged=False) for one in tried)
        plausible = [one for one in trials if one.result is not None]
        if plausible:
            return min(plausible, key=lambda one: one.fitted.chi2_with_prior)
    return base


def _find_refuted(search: Search, first: tuple[Chosen, ...], more: tuple[Chosen, ...]) -> str:
    """The effect without which the others can be fitted; the last one if there is none."""
    for one in reversed(more):
        others = (c for c in more if c is not one)
        if search.fit_as_shown(*first, *others, judged=False).result is not None:
            return one.name
    return more[-1].name
