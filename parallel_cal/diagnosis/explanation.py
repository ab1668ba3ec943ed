"""What the residuals of a robot are made of: the likeliest causes, proven on the true problem.

The sum over all sets of causes is linear. A cause that the true problem refutes (a size that no
robot has, a sign that physics forbids) leaves the sum, and where the causes move the geometry, the
sum is made again about the geometry found with them, unless the fit leaves what the sum predicts.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from types import MappingProxyType
from typing import Any

import numpy as np

from parallel_cal.causes.effects import (
    compute_effect_columns,
    find_new_parameters,
    list_effect_blocks,
    refine_setting,
    widen,
)
from parallel_cal.causes.knocks import are_few, list_knock_blocks
from parallel_cal.causes.unknown_laws import list_unknown_blocks
from parallel_cal.diagnosis.catalogue import candidate
from parallel_cal.diagnosis.field import Field
from parallel_cal.diagnosis.noise import PureError
from parallel_cal.diagnosis.search import Chosen, Search, Trial
from parallel_cal.diagnosis.thresholds import CREDIBLE
from parallel_cal.identification.observations import conditions
from parallel_cal.identification.thresholds import MIN_DOF
from parallel_cal.model.shelf import load_effect
from parallel_cal.posterior.blocks import DRIFT, EFFECT, FIELD, KNOCK, LAW, Block, Stack
from parallel_cal.posterior.evidence import STATED, UNKNOWN, Choice
from parallel_cal.posterior.scene import Scene
from parallel_cal.posterior.search import Posterior, Sum

MAX_LINEARISATIONS = 2
# Of chi2, between a fit and what the linear problem predicts: in 20 sessions at most 1.5 where a
# sum about the new geometry gave the same causes, and 6 and 130 where effects were mistaken.
MAX_LINEAR_ERROR = 2.0


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
        scene = _scene_about(base, base, within_tolerances=True) if first else base.scene
        causes, known = Causes.of(scene, names), list[frozenset[Chosen]]()
        absurd = dict[str, str]()
        posterior: Posterior | None = None
        while True:
            near = posterior.chosen if posterior else ()
            posterior, described, more = causes.explain({*refuted, *absurd}, near)
            if knocked := tuple(set_aside(posterior.knocked)):
                return cls(search, posterior, described, base, refuted, knocked=knocked)
            chosen = (*first, *more)
            tried = search.fit_as_shown(*chosen, judged=False)
            if tried.result is None and more:
                name = tried.wrong_sign or _find_refuted(search, first, more)
                refuted[name] = tried.reason
                wrong += [tried.reason] if tried.wrong_sign else []
                continue
            ended = not more or frozenset(chosen) in known or len(known) == MAX_LINEARISATIONS
            nearer = None if ended else causes.find_nearer(search, first, tried, described)
            if nearer is None:
                found = cls(search, posterior, described, tried, refuted, tuple(wrong), base.names)
                doubt = causes.list_possible(described, found.swaps)
                if rivals := found.find_absurd_rivals(doubt):
                    absurd |= rivals
                    continue
                best = search.fit_as_shown(*chosen)
                return replace(found, best=best, absurd=absurd, doubt=doubt)
            known.append(frozenset(chosen))
            causes = Causes.of(_scene_about(base, nearer, bool(first)), names)

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
            effects = _as_effects(causes)
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
        the robot, and fields of errors of the device."""
        names = [one.block.name for one in self.posterior.chosen if one.block.kind in (LAW, FIELD)]
        return {name: self.posterior.probability[name] for name in names}

    def missing(self, names: Sequence[str]) -> list[dict[str, Any]]:
        """For each of these effects, what it may be, and how probable it is that the robot has one
        of them, and each of them."""
        found = []
        for name in names:
            effects = [name, *self.swaps.get(name, [])]
            each = {one: self.probability_of(one) or 0.0 for one in effects}
            together = 1.0 if name in self.first else self.posterior.of_any(effects)
            found.append({"effects": effects, "probability": together, "each": each})
        return found


@dataclass(frozen=True)
class Doubt:
    """The set of causes that was found, and those with a rival in the place of one of them, each
    with its probability, its likeliest settings and sizes.

    They are about the residuals of the `scene`, whose noise has the `variance`, in units of that
    with which the samples were weighted.
    """

    scene: Scene
    variance: float
    sets: tuple[tuple[float, tuple[Choice, ...]], ...]


@dataclass(frozen=True)
class Causes:
    """All that may cause what one scene shows, in units of a `variance` of the noise; `nu` is as in
    `Sum`."""

    scene: Scene
    blocks: Sequence[Block]
    nu: float
    variance: float

    @classmethod
    def of(
        cls,
        scene: Scene,
        names: Sequence[str],
        settings: Mapping[str, Mapping[str, float]] = MappingProxyType({}),
        kinds: Collection[str] = (LAW, FIELD, DRIFT, KNOCK),
    ) -> Causes:
        """All causes, of which the effects are these `names`; `settings` holds those of an effect
        that are known. Causes that no effect describes are of these `kinds`."""
        variance, nu = _find_noise(scene)
        scene, larger = widen(scene.in_units_of(variance), names)
        effects = list_effect_blocks(scene, names, settings)
        unknown = list_unknown_blocks(scene, kinds)
        knocks = list_knock_blocks(scene) if KNOCK in kinds else []
        return cls(scene, [*larger, *effects, *unknown, *knocks], nu, variance)

    @cached_property
    def sum(self) -> Sum:
        return Sum(self.scene, Stack.of_alike(self.blocks), self.nu)

    def find_nearer(
        self, search: Search, first: Sequence[Chosen], tried: Trial, described: Posterior
    ) -> Trial | None:
        """The fit about whose geometry the sum must be made again: the one that was `tried`, if it
        leaves another chi2 than the linear problem predicts; else the one without the effect that
        gains least, if it leaves so little that this effect is not likelier than none. A large
        effect moves the geometry, and another one imitates what the linear problem is wrong by.
        None if there is no such fit."""
        more = [one for one in tried.chosen if one not in first]
        predicted = self._predict_chi2(described, more)
        reached = tried.fitted.estimate.chi2 / self.variance
        if abs(reached - predicted) >= MAX_LINEAR_ERROR:
            return tried
        if len(more) < 2:
            return None
        rests = [[one for one in more if one is not left] for left in more]
        without = {self._predict_chi2(described, rest): rest for rest in rests}
        least = min(without)
        rest = search.fit_as_shown(*first, *without[least], judged=False)
        if rest.result is None:
            return None
        kept = {one.name for one in without[least]}
        less = [
            one for one in described.chosen if one.block.kind != EFFECT or one.block.name in kept
        ]
        likeliest = self.sum.evidence(described.chosen, described.nu)
        promised = likeliest.log_p - self.sum.evidence(less, described.nu).log_p
        lost = (least - predicted) - (rest.fitted.estimate.chi2 / self.variance - reached)
        return rest if lost / (2 * likeliest.noise_variance) > promised else None

    def _predict_chi2(self, described: Posterior, effects: Collection[Chosen]) -> float:
        """The chi2 that the linear problem predicts of a fit with these effects."""
        names = {one.name for one in effects}
        columns = [one.block.at(one.setting) for one in described.chosen if one.block.name in names]
        r, C = self.scene.residual, np.hstack(columns)
        left = r - C @ np.linalg.lstsq(C, r, rcond=None)[0]
        return float(left @ left)

    def explain(
        self, refuted: Collection[str] = (), near: Sequence[Choice] = ()
    ) -> tuple[Posterior, Posterior, tuple[Chosen, ...]]:
        """Sum over all sets of causes, and over those without unknown laws of the robot, beginning
        with what was found `near` this problem; return the effects that describe the residual
        best, too.

        Where an unknown law of the robot is likely, known effects imitate it at best. They are
        chosen as if there were no such law, since the error may fall with them; their probability
        tells what they are. One whose settings were scanned follows anything, and one of the device
        takes an error of the robot away from it: they must be likely beside the law. Beside noise
        that drifts, an effect of time is not told from it.
        """
        possible = replace(self.sum, left_out=frozenset(refuted))
        there = {block.name: block for block in possible.blocks}
        names = [one.block.name for one in near if one.block.name in there]
        start = possible.choose([there[name] for name in names])
        posterior, possible = self._search_with_knocks(possible, start)
        described = posterior
        likely = {one.block.name for one in posterior.chosen}
        if any(posterior.kinds[name] == LAW for name in likely):
            laws = {block.name for block in possible.blocks if block.kind == LAW}
            without = replace(possible, left_out=laws | {*refuted})
            described = self._search(without, posterior.chosen)
        drifts = any(one.block.kind == DRIFT for one in described.chosen)

        def is_named(one: Choice) -> bool:
            block = one.block
            if block.kind != EFFECT:
                return False
            effect = load_effect(block.name)
            if drifts and "time" in effect.needs:
                return False
            return block.name in likely or not (one.is_scanned or effect.of_device)

        return posterior, described, _as_effects(filter(is_named, described.chosen))

    def list_possible(self, found: Posterior, swaps: Mapping[str, Sequence[str]]) -> Doubt:
        """The sets that a sum leaves possible, with these `swaps` of what it found."""
        blocks = {block.name: block for block in self.sum.blocks}
        sets = [(found.sets[0][1], found.chosen)]
        for name, others in swaps.items():
            rest = tuple(one for one in found.chosen if one.block.name != name)
            beside = self.sum.evidence(rest, found.nu)
            for other in others:
                scanned = beside.rank(blocks[other].alone)[0].best
                best = refine_setting(self.scene, beside, scanned)
                sets.append((found.rivals[name][other], (*rest, best)))
        likeliest = self.sum.evidence(found.chosen, found.nu)
        return Doubt(self.scene, self.variance * likeliest.noise_variance, tuple(sets))

    def find_knocked_samples(self) -> tuple[int, ...]:
        """Find the samples that were disturbed alone, whatever else is missing."""
        return self._search_with_knocks(self.sum)[0].knocked

    def _search(self, possible: Sum, start: Sequence[Choice] = ()) -> Posterior:
        """Sum over the sets of some causes, from a set that may be near."""
        names = {block.name for block in possible.blocks}
        refined = replace(possible, refine=partial(refine_setting, self.scene))
        return refined.search(tuple(one for one in start if one.block.name in names))

    def _search_with_knocks(
        self, possible: Sum, start: Sequence[Choice] = ()
    ) -> tuple[Posterior, Sum]:
        """Sum over the sets of these causes, and of further samples that may have been disturbed;
        return all of these causes, too."""
        found = self._search(possible, start)
        while are_few(found.knocked, self.scene.dataset) and (
            more := self._find_hidden_knocks(possible, found)
        ):
            possible = replace(possible, stacks=[*possible.stacks, *more])
            found = self._search(possible, found.chosen)
        return found, possible

    def _find_hidden_knocks(self, possible: Sum, found: Posterior) -> list[Stack]:
        """Further samples that may have been disturbed, if one of them makes what was found
        likelier: what is known now may have hidden it."""
        known = {block.name for block in possible.blocks}
        more = [one for one in list_knock_blocks(self.scene, found.chosen) if one.name not in known]
        now, stacks = possible.evidence(found.chosen, found.nu), Stack.of_alike(more)
        ranked = (one for stack in stacks for one in now.rank(stack))
        return stacks if any(one.log_p > now.log_p for one in ranked) else []


def _as_effects(causes: Iterable[Choice]) -> tuple[Chosen, ...]:
    """The effects among chosen causes, as a search fits them: what a larger mechanism has must be
    there before effects act on it."""
    chosen = (
        Chosen(one.block.name, tuple(sorted(one.block.settings[one.setting].items())))
        for one in causes
        if one.block.kind == EFFECT
    )
    return tuple(sorted(chosen, key=lambda one: not load_effect(one.name).widens))


def find_swaps(described: Posterior) -> dict[str, list[str]]:
    """For each effect that a sum found, the effects that may be in its place, the likeliest first:
    with it they are the fewest that have CREDIBLE of the probability."""
    found: dict[str, list[str]] = {}
    for name, rivals in described.rivals.items():
        if described.kinds[name] != EFFECT:
            continue
        effects = {
            other: p
            for other, p in rivals.items()
            if described.kinds[other] == EFFECT and name not in load_effect(other).generalizes
        }
        reached, named = described.sets[0][1], found.setdefault(name, [])
        total = reached + sum(effects.values())
        for other in sorted(effects, key=effects.__getitem__, reverse=True):
            if reached >= CREDIBLE * total:
                break
            named.append(other)
            reached += effects[other]
    return {name: others for name, others in found.items() if others}


def _find_noise(scene: Scene) -> tuple[float, float]:
    """The variance of the noise that is known best, in the units of a scene, and how many degrees
    of freedom are known of it apart from the residual: stated, or hardly any.

    Visits of one pose measure the noise, but they are samples of the residual, too. Let R be their
    sum of squares about their means, with m degrees of freedom, and L the rest of a residual with d
    of them. Given R, the evidence of L is that of a t distribution with m degrees of freedom, R/m
    its variance:

        log p(L | R) = -(m + d - m)/2 log(1 + L / R) + ... = -d/2 log(R + L) + ...

    which is the evidence of the whole residual if nothing else is known of the noise (nu -> 0).
    With nu = m it would be -(m + d)/2 log(2 R + L): the visits would count twice.

    Visits may differ by more than the stated noise because the robot moves; they cannot differ by
    less.
    """
    seen, stated = PureError.of(scene, Field.of(scene)), not scene.observations.noise_assumed
    v, measured = seen.variance, seen.dof >= MIN_DOF
    if v is not None and measured and (not stated or (seen.contradicts_stated_noise and v < 1)):
        return max(v, 1e-12), UNKNOWN
    if stated:
        return 1.0, STATED
    return max(scene.chi2_per_dof, 1e-12), UNKNOWN


def _is_lasting_error_of_device(name: str) -> bool:
    effect = load_effect(name)
    return effect.of_device and not effect.needs


def _depends_on(posterior: Posterior, name: str, conditions: set[str]) -> bool:
    return posterior.kinds[name] == EFFECT and not conditions.isdisjoint(load_effect(name).needs)


def _scene_about(base: Trial, best: Trial, within_tolerances: bool) -> Scene:
    """The scene of the model without further effects, with the geometry found with them.

    Its residual is that of the fit with them, extrapolated to none of them: a sum about it is exact
    at this fit, and what the curvature of a large effect leaves calls for no further cause.
    """
    fitted, result = base.fitted, best.fitted.model
    found = result.table.mapping(result.values)
    before = fitted.model.table.mapping(fitted.model.values)
    values = np.array([found.get(name, value) for name, value in before.items()])
    about = replace(fitted.model, values=values)
    scene = Scene.of(
        about, fitted.dataset, fitted.observations, fitted.free, base.shared, within_tolerances
    )
    effects = [one for one in best.chosen if one not in base.chosen]
    if within_tolerances or not effects or result.mechanism is not about.mechanism:
        return scene
    residual = best.scene.closure_residual
    if scene.turn is not None:
        residual = np.einsum("nk,nrk->nr", residual, scene.turn)
    residual = residual.reshape(-1)
    for one in effects:
        plain = about.with_effect(one.name)
        a = conditions(plain, fitted.dataset)
        new = find_new_parameters(about, plain.with_settings(one.name, one.settings))
        away = np.array([found[name] for name in np.array(plain.table.names)[new]])
        away = (away - plain.table.nominal[new]) / plain.table.tolerance[new]
        residual = residual - compute_effect_columns(scene, plain, one.settings, a, True) @ away
    return replace(scene, residual=scene.project_off_geometry(residual))


def _find_first(search: Search, base: Trial, names: Sequence[str]) -> Trial:
    """The fit with that likely cause with which a plausible geometry describes the samples best, or
    with all of them if none is enough alone; the given one if there is none.

    The sum is about the drawing, with the tolerances of the geometry: about a geometry that no
    robot has, other effects imitate what is missing.
    """
    fitted = base.fitted
    drawn = Scene.of(
        fitted.start, fitted.dataset, fitted.observations, fitted.free, within_tolerances=True
    )
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
            return min(plausible, key=lambda one: one.fitted.estimate.chi2)
    return base


def _find_refuted(search: Search, first: tuple[Chosen, ...], more: tuple[Chosen, ...]) -> str:
    """The effect without which the others can be fitted; the last one if there is none."""
    for one in reversed(more):
        others = (c for c in more if c is not one)
        if search.fit_as_shown(*first, *others, judged=False).result is not None:
            return one.name
    return more[-1].name
