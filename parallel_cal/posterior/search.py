"""Search the likeliest sets of causes, and state how probable each cause is."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from parallel_cal.posterior.blocks import EFFECT, KNOCK, LOG_ODDS, Block, Stack
from parallel_cal.posterior.evidence import STATED, UNKNOWN, Choice, Evidence, Ranked
from parallel_cal.posterior.scene import Scene

MAX_CAUSES = 6  # beside knocked samples
MAX_ROUNDS = 4
NO_RIVAL = 7.0  # of the logarithm: a set that is less likely by more need not be known well
MAX_FIRST = 4  # effects that are tried as one of two in the place of one

Refine = Callable[[Evidence, Choice], Choice]


@dataclass(frozen=True)
class WeighedSetting:
    """The `values` of the numbers of an effect at one peak of the posterior, with the probability
    that they are those of the robot, and the standard deviations of those that were refined."""

    values: Mapping[str, float]
    probability: float
    sigma: Mapping[str, float]


@dataclass(frozen=True)
class Posterior:
    """The likeliest set of causes, and what else is possible.

    `probability` of each cause by name, `sets` the likeliest sets with theirs; `settings` the
    likely numbers of each effect of which they were scanned, if they were weighed.
    """

    chosen: tuple[Choice, ...]
    nu: float
    sets: tuple[tuple[tuple[str, ...], float], ...]
    probability: Mapping[str, float]
    kinds: Mapping[str, str]
    settings: Mapping[str, list[WeighedSetting]] = field(default_factory=dict)

    def of_any(self, names: Collection[str]) -> float:
        """Probability that the robot has at least one of these causes."""
        found = sum(p for members, p in self.sets if not set(names).isdisjoint(members))
        return min(1.0, float(found))  # a sum of rounded numbers may exceed 1

    @property
    def knocked(self) -> tuple[int, ...]:
        """Numbers of the samples that were disturbed alone."""
        found = [one.block for one in self.chosen if one.block.kind == KNOCK]
        return tuple(sorted(int(block.settings[0]["sample"]) for block in found))

    @cached_property
    def rivals(self) -> dict[str, dict[str, float]]:
        """For each chosen cause, what may be in its place, with the probability of this set."""
        names = [one.block.name for one in self.chosen]
        found: dict[str, dict[str, float]] = {name: {} for name in names}
        for members, p in self.sets:
            gone, new = set(names) - set(members), set(members) - set(names)
            if len(gone) == 1 and len(new) == 1:
                found[gone.pop()][new.pop()] = p
        return found


@dataclass(frozen=True)
class Sum:
    """All sets of causes about one residual. `nu` are the degrees of freedom of what is known of
    the noise; where it is stated, the sum doubts it, too. Causes that are `left_out` by name are
    not there; sums over the same `stacks` share what they compute."""

    scene: Scene
    stacks: Sequence[Stack]
    nu: float
    refine: Refine | None = field(default=None, repr=False)
    left_out: Collection[str] = ()

    @cached_property
    def _squares(self) -> float:
        return float(self.scene.residual @ self.scene.residual)

    @cached_property
    def blocks(self) -> list[Block]:
        every = (block for stack in self.stacks for block in stack.blocks)
        return [block for block in every if block.name not in self.left_out]

    def evidence(self, chosen: Sequence[Choice], nu: float) -> Evidence:
        return Evidence(self._squares, self.scene.dof, nu, tuple(chosen))

    @property
    def stated(self) -> bool:
        return self.nu == STATED

    def _doubt(self, nu: float) -> float:
        """Log prior of noise that is not as stated."""
        return float(LOG_ODDS) if self.stated and nu == UNKNOWN else 0.0

    def rank(self, evidence: Evidence, taken: Collection[str] = ()) -> list[Ranked]:
        """Every other cause beside the chosen ones, the likeliest first."""
        out = {*taken, *self.left_out}
        stacks = (stack for stack in self.stacks if any(b.name not in out for b in stack.blocks))
        ranked = (one for stack in stacks for one in evidence.rank(stack))
        left = [one for one in ranked if one.best.block.name not in out]
        least = max((one.log_p for one in left), default=0.0) - NO_RIVAL
        return sorted(
            (evidence.let_joints_differ(one, least) for one in left), key=lambda one: -one.log_p
        )

    def search(self, chosen: tuple[Choice, ...] = ()) -> Posterior:
        """Add, exchange, split and remove causes until nothing is likelier, from a set that may be
        near; sum over the sets nearby."""
        nu = self.nu
        for k, one in enumerate(chosen):
            rest = self.evidence(chosen[:k] + chosen[k + 1 :], nu)
            chosen = (*chosen[:k], self._refined(rest, one), *chosen[k + 1 :])
        # Beside a cause that is not there yet, another one would only take its place.
        chosen, polished = self._prune(chosen, nu), not chosen
        while True:
            if self.stated:
                nu = max((STATED, UNKNOWN), key=lambda v: self.total(chosen, v))
            now = self.evidence(chosen, nu)
            has_room = sum(one.block.kind != KNOCK for one in chosen) < MAX_CAUSES
            more = self._grow(now, nu) if has_room else None
            if more is None and not polished:
                more = self._prune(self._polish(chosen, nu), nu)
            elif more is None and has_room:
                more = self._split(now, nu)
            if more is None:
                break
            chosen, polished = more, True
        if self.stated:
            nu = max((STATED, UNKNOWN), key=lambda v: self.total(chosen, v))
        return self._sum_nearby(chosen, nu)

    def _grow(self, now: Evidence, nu: float) -> tuple[Choice, ...] | None:
        """A likelier set with one cause more, each chosen again beside the others; None if there
        is none."""
        names = {one.block.name for one in now.chosen}
        ranked = self.rank(now, names)
        if not ranked or ranked[0].log_p <= now.log_p:
            return None
        more = self._polish((*now.chosen, self._find_best(now, ranked)), nu)
        return self._if_likelier(self._prune(more, nu), now, nu)

    def _split(self, now: Evidence, nu: float) -> tuple[Choice, ...] | None:
        """A likelier set with an effect and another cause in the place of one that may imitate them
        together; None if there is none."""
        names = {one.block.name for one in now.chosen}
        for k, one in enumerate(now.chosen):
            if one.block.kind == KNOCK:  # it imitates nothing
                continue
            rest = now.chosen[:k] + now.chosen[k + 1 :]
            without = self.evidence(rest, nu)
            ranked = [other for other in self.rank(without, names) if other.log_p > without.log_p]
            effects = [other for other in ranked if other.best.block.kind == EFFECT]
            for first in effects[:MAX_FIRST]:  # each explains part of what the one imitates
                beside = self.evidence((*rest, first.best), nu)
                seconds = self.rank(beside, {*names, first.best.block.name})
                if not seconds:
                    continue
                # Beside each other both may be another choice: in all joints, not in one alone.
                both = self._settle((*rest, first.best, seconds[0].best), nu, 2)
                if self.evidence(both, nu).log_p > now.log_p:
                    more = self._polish(both, nu)
                    if likelier := self._if_likelier(self._prune(more, nu), now, nu):
                        return likelier
        return None

    def _if_likelier(
        self, more: tuple[Choice, ...], now: Evidence, nu: float
    ) -> tuple[Choice, ...] | None:
        """Other causes, if their evidence is not less than that of those chosen now."""
        if {one.block.name for one in more} == {one.block.name for one in now.chosen}:
            return None
        return more if self.evidence(more, nu).log_p >= now.log_p else None

    def choose(self, blocks: Sequence[Block]) -> tuple[Choice, ...]:
        """The likeliest setting and size of each of these causes beside all others."""
        return self._settle(tuple(Choice(block, 0, 1) for block in blocks), self.nu, len(blocks))

    def _settle(self, chosen: tuple[Choice, ...], nu: float, count: int) -> tuple[Choice, ...]:
        """The last `count` causes of a set, each with its likeliest setting and size beside all
        others."""
        for _ in range(MAX_ROUNDS):
            before = chosen
            for k in range(len(chosen) - count, len(chosen)):
                rest = self.evidence(chosen[:k] + chosen[k + 1 :], nu)
                likeliest = rest.rank_one(chosen[k].block).best
                chosen = (*chosen[:k], likeliest, *chosen[k + 1 :])
            if chosen == before:
                break
        return chosen

    def total(self, chosen: Sequence[Choice], nu: float) -> float:
        return self.evidence(chosen, nu).log_p + self._doubt(nu)

    def judge(self, found: Posterior) -> float:
        """The log posterior of the set that a search found."""
        return self.total(found.chosen, found.nu)

    def _refined(self, beside: Evidence, best: Choice) -> Choice:
        return self.refine(beside, best) if self.refine else best

    def _find_best(self, beside: Evidence, ranked: Sequence[Ranked]) -> Choice:
        """The likeliest of other causes, at the peak of its numbers."""
        near = [one for one in ranked if self._highest(beside, one) >= ranked[0].log_p]
        return max((self._at_peak(beside, one) for one in near), key=lambda one: one.log_p).best

    def _highest(self, beside: Evidence, one: Ranked) -> float:
        """The log posterior that one more cause has at most at the peak of its numbers."""
        has_numbers = bool(one.best.block.settings[one.best.setting])
        return beside.highest(one.log_p) if has_numbers else one.log_p

    def _at_peak(self, beside: Evidence, one: Ranked) -> Ranked:
        """One more cause, with its numbers refined between those that were scanned."""
        peaks = [
            beside.rank(refined.block.alone)[0]
            for choice in (one.best, *one.rivals)
            if (refined := self._refined(beside, choice)) is not choice
        ]
        if not peaks:
            return one
        highest = max(peaks, key=lambda peak: peak.log_p)
        return replace(highest, log_p=max(one.log_p, highest.log_p))

    def _polish(self, chosen: tuple[Choice, ...], nu: float) -> tuple[Choice, ...]:
        """Choose each cause again beside all others, until they stay."""
        for _ in range(MAX_ROUNDS):
            before = [one.block.name for one in chosen]
            for k in range(len(chosen)):
                rest = chosen[:k] + chosen[k + 1 :]
                beside = self.evidence(rest, nu)
                own = self.evidence((*rest, chosen[k]), nu).log_p
                likeliest = self.rank(beside, {one.block.name for one in rest})[0]
                same = likeliest.best.block.name == chosen[k].block.name
                if same and own >= self.evidence((*rest, likeliest.best), nu).log_p:
                    continue  # its refined settings stay: no scanned one is better
                if self._highest(beside, likeliest) <= own:
                    continue
                peak = self._at_peak(beside, likeliest).best
                if self.evidence((*rest, peak), nu).log_p > own:
                    chosen = (*chosen[:k], peak, *chosen[k + 1 :])
            if before == [one.block.name for one in chosen]:
                break
        return chosen

    def _prune(self, chosen: tuple[Choice, ...], nu: float) -> tuple[Choice, ...]:
        """Remove causes without which the rest is likelier."""
        while chosen:
            parts = [chosen[:k] + chosen[k + 1 :] for k in range(len(chosen))]
            without = [self.evidence(rest, nu) for rest in parts]
            gains = [
                self._marginal(rest, one) - rest.log_p
                for rest, one in zip(without, chosen, strict=True)
            ]
            least = int(np.argmin(gains))
            if gains[least] > 0:
                break
            chosen = parts[least]
        return chosen

    def _marginal(self, rest: Evidence, one: Choice) -> float:
        """Log posterior of one cause beside the rest, over all its settings and sizes."""
        scanned = next(block for block in self.blocks if block.name == one.block.name)
        return max(rest.rank(block.alone)[0].log_p for block in {scanned, one.block})

    def _sum_nearby(self, chosen: tuple[Choice, ...], nu: float) -> Posterior:
        """Sum over the chosen set, and all sets with one cause less, more, or exchanged."""
        names = tuple(one.block.name for one in chosen)
        now = self.evidence(chosen, nu)
        sets: dict[frozenset[str], float] = {}
        # What each cause gains by its other settings and sizes.
        without = [self.evidence(chosen[:k] + chosen[k + 1 :], nu) for k in range(len(chosen))]
        gains = [
            self._marginal(rest, one) - now.log_p for rest, one in zip(without, chosen, strict=True)
        ]
        total = sum(gains)

        def note(members: Sequence[str], log_p: float) -> None:
            sets[frozenset(members)] = max(log_p, sets.get(frozenset(members), -np.inf))

        note(names, now.log_p + total)
        for more in self.rank(now, names):
            note((*names, more.best.block.name), more.log_p + total)
        for name, beside, gain in zip(names, without, gains, strict=True):
            others = [other for other in names if other != name]
            left = total - gain
            note(others, beside.log_p + left)
            for other in self.rank(beside, names):
                if self._highest(beside, other) > now.log_p + gain - NO_RIVAL:
                    other = self._at_peak(beside, other)
                note((*others, other.best.block.name), other.log_p + left)
        logs = np.array(list(sets.values()))
        p = np.exp(logs - np.logaddexp.reduce(logs))
        order = np.argsort(-p)
        keys = list(sets)
        likeliest = tuple((tuple(sorted(keys[i])), float(p[i])) for i in order)
        probability = {
            block.name: min(1.0, float(sum(p[[block.name in key for key in keys]])))
            for block in self.blocks
        }
        kinds = {block.name: block.kind for block in self.blocks}
        return Posterior(chosen, nu, likeliest, probability, kinds)
