"""All that may cause the residuals of one scene: a linear problem, the sum over all sets of causes,
and whether the refits of the true problem bear out what it names."""

from __future__ import annotations

import gc
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from types import MappingProxyType

import numpy as np

from parallel_cal.causes.effects import list_effect_blocks, widen
from parallel_cal.causes.knocks import are_few, list_knock_blocks
from parallel_cal.causes.settings import refine_setting, renew
from parallel_cal.causes.unknown_laws import list_unknown_blocks
from parallel_cal.diagnosis.field import Field
from parallel_cal.diagnosis.noise import PureError
from parallel_cal.diagnosis.search import Chosen, Search, Trial
from parallel_cal.diagnosis.thresholds import CREDIBLE
from parallel_cal.identification.thresholds import MIN_DOF
from parallel_cal.model.shelf import load_effect
from parallel_cal.posterior.blocks import DRIFT, EFFECT, FIELD, KNOCK, LAW, Block, Stack
from parallel_cal.posterior.evidence import STATED, UNKNOWN, Choice
from parallel_cal.posterior.scene import Scene
from parallel_cal.posterior.search import Posterior, Sum

# Of chi2, between a fit and what the linear problem predicts: in 20 sessions at most 1.5 where a
# sum about the new geometry gave the same causes, and 6 and 130 where effects were mistaken.
MAX_LINEAR_ERROR = 2.0
# In so many samples, the whole catalogue is searched for what may hide a disturbed sample: a tenth
# of the noise stands out in them by 0.1 * sqrt(3 * 1000) = 5 sigmas, and hides none.
MAX_SEARCHED_SAMPLES = 1000


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
    `Sum`. Its samples are a part of `count`, or all."""

    scene: Scene
    blocks: Sequence[Block]
    nu: float
    variance: float
    count: int

    @classmethod
    def of(
        cls,
        scene: Scene,
        names: Sequence[str],
        settings: Mapping[str, Mapping[str, float]] = MappingProxyType({}),
        kinds: Collection[str] = (LAW, FIELD, DRIFT, KNOCK),
        count: int | None = None,
    ) -> Causes:
        """All causes, of which the effects are these `names`; `settings` holds those of an effect
        that are known. Causes that no effect describes are of these `kinds`. The samples are a part
        of `count`, by default all."""
        count = count or len(scene.dataset)
        variance, nu = _find_noise(scene)
        scene, larger = widen(scene.in_units_of(variance), names)
        effects = list_effect_blocks(scene, names, settings)
        unknown = list_unknown_blocks(scene, kinds)
        knocks = list_knock_blocks(scene, count) if KNOCK in kinds else []
        return cls(scene, [*larger, *effects, *unknown, *knocks], nu, variance, count)

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
        reached = tried.fitted.chi2_with_prior / self.variance
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
        lost = (least - predicted) - (rest.fitted.chi2_with_prior / self.variance - reached)
        return rest if lost / (2 * likeliest.noise_variance) > promised else None

    def _predict_chi2(self, described: Posterior, effects: Collection[Chosen]) -> float:
        """The chi2 that the linear problem predicts of a fit with these effects."""
        names = {one.name for one in effects}
        columns = [one.block.at(one.setting) for one in described.chosen if one.block.name in names]
        r, C = self.scene.residual, np.hstack(columns)
        left = r - C @ np.linalg.lstsq(C, r, rcond=None)[0]
        return float(left @ left)

    def explain(
        self,
        refuted: Collection[str] = (),
        near: Sequence[Choice] = (),
        near_without_laws: Sequence[Choice] = (),
    ) -> tuple[Posterior, Posterior, tuple[Chosen, ...]]:
        """Sum over all sets of causes, and over those without unknown laws of the robot, each
        beginning with what was found so near this problem; return the effects that describe the
        residual best, too.

        If those without laws are likelier than what was found among all, the search begins there
        again. Where an unknown law of the robot is likely, known effects imitate it at best. They
        are chosen as if there were no such law, since the error may fall with them; their
        probability tells what they are. A wave, or one whose settings were scanned, follows
        anything, and one of the device takes an error of the robot away from it: they must be
        likely beside the law. Beside noise that drifts, an effect of time is not told from it.
        """
        possible = replace(self.sum, left_out=frozenset(refuted))
        posterior, possible = self._search_with_knocks(possible, self._resume(possible, near))
        described = posterior
        if any(one.block.kind == LAW for one in posterior.chosen):
            laws = {block.name for block in possible.blocks if block.kind == LAW}
            without = replace(possible, left_out=laws | {*refuted})
            start = self._resume(without, near_without_laws) or posterior.chosen
            described = self._search(without, start)
            if possible.judge(described) > possible.judge(posterior):
                posterior, possible = self._search_with_knocks(possible, described.chosen)
        likely = {one.block.name for one in posterior.chosen}
        drifts = any(one.block.kind == DRIFT for one in described.chosen)

        def is_named(one: Choice) -> bool:
            block = one.block
            if block.kind != EFFECT:
                return False
            effect = load_effect(block.name)
            if drifts and "time" in effect.needs:
                return False
            setting = block.settings[one.setting]
            is_wave = bool(setting) and effect.period(setting) is not None
            return block.name in likely or not (one.is_scanned or is_wave or effect.of_device)

        return posterior, described, as_effects(filter(is_named, described.chosen))

    def _resume(self, possible: Sum, near: Sequence[Choice]) -> tuple[Choice, ...]:
        """What was found near this problem, as far as it is possible, with its numbers."""
        there = {block.name: block for block in possible.blocks}
        kept = [one for one in near if one.block.name in there]
        return possible.choose([renew(self.scene, there[one.block.name], one) for one in kept])

    def list_possible(self, found: Posterior, swaps: Mapping[str, Sequence[str]]) -> Doubt:
        """The sets that a sum leaves possible, with these `swaps` of what it found."""
        blocks = {block.name: block for block in self.sum.blocks}
        sets = [(found.sets[0][1], found.chosen)]
        for name, others in swaps.items():
            rest = tuple(one for one in found.chosen if one.block.name != name)
            beside = self.sum.evidence(rest, found.nu)
            for other in others:
                best = refine_setting(self.scene, beside, beside.rank_one(blocks[other]).best)
                sets.append((found.rivals[name][other], (*rest, best)))
        likeliest = self.sum.evidence(found.chosen, found.nu)
        return Doubt(self.scene, self.variance * likeliest.noise_variance, tuple(sets))

    def search(self) -> Posterior:
        """Sum over the sets of all causes, among them each sample that may have been disturbed."""
        return self._search_with_knocks(self.sum)[0]

    def find_knocked_beside(self, found: Posterior) -> set[int]:
        """Find the samples that were disturbed alone, beside causes `found` in other samples."""
        blocks, chosen = {block.name: block for block in self.blocks}, tuple[Choice, ...]()
        for one in found.chosen:
            if (block := blocks.get(one.block.name)) is not None:
                if block.kind == EFFECT:
                    one = self.sum.evidence(chosen, found.nu).rank_one(block).best
                # Unknown laws have their settings in the same order in each part of the samples.
                chosen = (*chosen, Choice(block.only(one.setting), 0, one.size))
        knocked = dict[int, Choice]()
        while are_few(knocked, self.scene.dataset):
            now = self.sum.evidence((*chosen, *knocked.values()), found.nu)
            stacks = Stack.of_alike(list_knock_blocks(self.scene, self.count, now.chosen))
            ranked = (one for stack in stacks for one in now.rank(stack))
            likely = [one.best for one in ranked if one.log_p > now.log_p]
            more = {int(one.block.settings[0]["sample"]): one for one in likely}
            if knocked.keys() >= more.keys():
                break
            knocked = more | knocked
        return {*knocked}

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
        knocks = list_knock_blocks(self.scene, self.count, found.chosen)
        more = [one for one in knocks if one.name not in known]
        now, stacks = possible.evidence(found.chosen, found.nu), Stack.of_alike(more)
        ranked = (one for stack in stacks for one in now.rank(stack))
        return stacks if any(one.log_p > now.log_p for one in ranked) else []


def find_knocked_samples(scene: Scene, names: Sequence[str]) -> tuple[int, ...]:
    """Find the samples that were disturbed alone, whatever else is missing: effects of these
    `names`, or what no effect describes.

    Of many samples, an evenly spread part shows what is missing; each other part is searched for
    such samples beside that.
    """
    if scene.dataset.mode == "continuous":  # no sample of a motion is disturbed alone
        return ()
    parts, count = scene.divide(MAX_SEARCHED_SAMPLES), len(scene.dataset)
    found = Causes.of(next(parts), names, count=count).search()
    effects = {one.name: one.settings for one in as_effects(found.chosen)}
    kinds, knocked = {one.block.kind for one in found.chosen}, {*found.knocked}
    for part in parts:
        gc.collect()  # blocks and their stacks, which are large, refer to each other
        causes = Causes.of(part, [*effects], effects, kinds, count)
        knocked |= causes.find_knocked_beside(found)
    return tuple(sorted(knocked))


def as_effects(causes: Iterable[Choice]) -> tuple[Chosen, ...]:
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
