"""Search for a set of effects: forward by score, backward, and by exchange, judged at held-out
poses."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from parallel_cal.base.errors import FitError, ModelError
from parallel_cal.base.progress import Progress
from parallel_cal.diagnosis.catalogue import Candidate
from parallel_cal.diagnosis.scene import Scene
from parallel_cal.diagnosis.scoring import log_p_of
from parallel_cal.diagnosis.thresholds import (
    EFFECT_SIGNIFICANCE_LEVEL,
    MAX_EFFECTS,
    MAX_EQUAL_SHUFFLES,
    MAX_SWAP_ERROR_RATIO,
    MIN_SEPARATION_SIGMAS,
    SHUFFLES,
)
from parallel_cal.identification.acceptance import acceptance
from parallel_cal.identification.fit import FitResult
from parallel_cal.identification.methods._estimate import Estimate
from parallel_cal.identification.prediction_errors import held_out_ratio
from parallel_cal.model.model import Model

Refit = Callable[[Model, bool], FitResult]  # of a model; whether numbers out of range are let be


@dataclass(frozen=True)
class Chosen:
    """An effect with the settings of its fixed numbers, as pairs."""

    name: str
    fixed: tuple[tuple[str, float], ...] = ()

    @classmethod
    def of(cls, one: Candidate) -> Chosen:
        return cls(one.name, tuple(sorted(one.settings.items())))

    @property
    def settings(self) -> dict[str, float]:
        return dict(self.fixed)

    @property
    def text(self) -> str:
        """The effect as `add` takes it."""
        numbers = (f"{key}={float(value)!r}" for key, value in self.fixed)
        return ":".join(filter(None, [self.name, ",".join(numbers)]))


@dataclass(frozen=True)
class Trial:
    """A refit of the model with some effects, or the reason why it failed."""

    chosen: tuple[Chosen, ...]
    result: FitResult | None
    reason: str = ""

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(c.name for c in self.chosen)

    @property
    def fitted(self) -> FitResult:
        """The refit; FitError if it failed."""
        if self.result is None:
            raise FitError(self.reason)
        return self.result

    @cached_property
    def scene(self) -> Scene:
        r = self.fitted
        return Scene.of(r.model, r.dataset, r.observations, r.free)


Rank = Callable[[Trial], list[Candidate]]  # what may be added to it, the best first
Rivals = Mapping[str, list[Candidate]]  # of each effect, what the data confuse it with


class Search:
    """The refits of one diagnosis, each made once."""

    def __init__(self, model: Model, refit: Refit, progress: Progress):
        self._model, self._refit, self._progress = model, refit, progress
        self._known: dict[tuple[tuple[Chosen, ...], bool], Trial] = {}

    def fit(self, *chosen: Chosen, insist: bool = False) -> Trial:
        """Fit the baseline with these effects on all poses and judge it at held-out poses; with
        `insist`, implausible parameters are accepted."""
        if insist and (plain := self.fit(*chosen)).result is not None:
            return plain
        if (chosen, insist) not in self._known:
            self._progress(f"refitting with {', '.join(c.name for c in chosen) or 'nothing'}", 0.5)
            self._known[chosen, insist] = self._fit(chosen, insist)
        return self._known[chosen, insist]

    def _fit(self, chosen: tuple[Chosen, ...], insist: bool) -> Trial:
        model = self._model
        try:
            for one in chosen:
                model = model.with_effect(one.name, one.settings)
            result = self._refit(model, insist)
        except (FitError, ModelError) as error:  # or an effect of the larger model, without it
            return Trial(chosen, None, str(error))
        return Trial(chosen, result)

    def try_adding(self, before: Trial, one: Candidate) -> tuple[Trial, str]:
        """Refit with one more effect; return the trial and the objection to it (empty: none)."""
        after = self.fit(*before.chosen, Chosen.of(one))
        if after.result is None:
            return after, after.reason
        if reason := _describe_held_out_objection(before, after) or _describe_chance_objection(
            before, after, one
        ):
            return after, reason
        if (size := _compute_oversize_ratio(before.fitted, after.result)) > 1:
            return (
                after,
                f"its coefficients would be {size:.0f} times their usual size for little gain",
            )
        return after, ""

    def is_suspected(self, before: Trial, one: Candidate) -> bool:
        """Whether one more effect is significant but not proven yet, so that more poses would
        decide."""
        after = self.fit(*before.chosen, Chosen.of(one))
        if after.result is None or _describe_chance_objection(before, after, one):
            return False
        return bool(
            _describe_held_out_objection(before, after)
            or _compute_oversize_ratio(before.fitted, after.result) > 1
        )

    def forward(self, start: Trial, rank: Rank) -> tuple[Trial, dict[str, str]]:
        """Add effects one by one while one is significant and has no objection."""
        trial: Trial = start
        against: dict[str, str] = {}
        while len(trial.chosen) < MAX_EFFECTS:
            for one in rank(trial):
                after, reason = self.try_adding(trial, one)
                if not reason:
                    trial = after
                    break
                against[one.name] = reason
            else:
                both = self._try_pairs(trial, rank)
                if both is None:
                    break
                trial = both
        return trial, against

    def _try_pairs(self, before: Trial, rank: Rank) -> Trial | None:
        """Find the best pair of effects of which one alone would need implausible parameters: the
        error may belong to the other, or half to a lookalike. None if no pair passes."""
        found, ranked = [], rank(before)
        for one in ranked:
            alone = (*before.chosen, Chosen.of(one))
            if self.fit(*alone).result is not None:
                continue
            beyond = self.fit(*alone, insist=True)
            more = rank(beyond) if beyond.result is not None else []
            halves = [c for c in ranked if c.name in one.effect.lookalikes]
            for other, less in [*((c, beyond) for c in more), *((c, before) for c in halves)]:
                both = self.fit(*alone, Chosen.of(other))
                if (
                    both.result is None
                    or _describe_held_out_objection(before, both)
                    or _describe_chance_objection(less, both, other)
                ):
                    continue
                if _compute_oversize_ratio(before.fitted, both.result) <= 1:
                    found.append(both)
                    break
        return min(found, key=lambda both: both.fitted.estimate.chi2_per_dof, default=None)

    def backward(self, trial: Trial) -> Trial:
        """Remove effects that later ones have made superfluous."""
        for one in trial.chosen:
            if len(trial.chosen) < 2:
                break
            without = self.fit(*(c for c in trial.chosen if c != one))
            if _is_superfluous_effect(without, trial):
                trial = without
        return trial

    def rescan_settings(self, trial: Trial, rank: Rank) -> Trial:
        """Scan the settings again with all chosen effects: the first scan did not know the later
        ones."""
        for name in trial.names if len(trial.chosen) > 1 else ():
            place = trial.names.index(name)
            *before, one = trial.chosen[: place + 1]
            behind = trial.chosen[place + 1 :]
            others = self.fit(*before, *behind, insist=True) if one.fixed else None
            if others is None or others.result is None:
                continue
            again = next(c for c in rank(others) if c.name == name)
            after = self.fit(*before, Chosen.of(again), *behind)
            if after.result and after.result.estimate.chi2 < trial.fitted.estimate.chi2:
                trial = after
        return trial

    def exchange_rivals(self, trial: Trial, rivals: Rivals) -> Trial:
        """Exchange one effect for a rival that explains clearly more; the same trial if there is
        none."""
        clear = [
            other
            for *_, other in self._iterate_swaps(trial, rivals)
            if _is_clearly_better(trial, other)
        ]
        return min(clear, key=lambda other: other.fitted.estimate.chi2_per_dof, default=trial)

    def swaps(self, trial: Trial, rivals: Rivals) -> dict[str, list[str]]:
        """For each chosen effect, the rivals that explain the data as well in its place."""
        found: dict[str, list[str]] = {}
        for name, rival, other in self._iterate_swaps(trial, rivals):
            if _is_as_good(trial, other):
                found.setdefault(name, []).append(rival)
        return found

    def _iterate_swaps(self, trial: Trial, rivals: Rivals) -> Iterator[tuple[str, str, Trial]]:
        """Iterate over chosen effects, their rivals, and the trials with the one in place of the
        other."""
        for i, one in enumerate(trial.chosen):
            for other in rivals.get(one.name, []):
                swapped = (*trial.chosen[:i], Chosen.of(other), *trial.chosen[i + 1 :])
                yield one.name, other.name, self.fit(*swapped)


def _describe_held_out_objection(before: Trial, after: Trial) -> str:
    """Objection to a refit by its validation error; empty without held-out poses, because the
    verdict then says that nothing is proven."""
    judgement = acceptance(after.fitted, before.fitted)
    return judgement.against if judgement.judged else ""


def _describe_chance_objection(before: Trial, after: Trial, one: Candidate) -> str:
    """Objection that a refit is chance."""
    if _is_superfluous_effect(before, after):
        return "explains nothing of the remaining error"
    p = one.shuffled_p
    if p is not None and p > (1 + MAX_EQUAL_SHUFFLES) / (SHUFFLES + 1):
        return "explains no more than with its condition shuffled between poses"
    return ""


def _compute_oversize_ratio(before: FitResult, after: FitResult) -> float:
    """Rms of the new parameters in tolerances if the squares of all effects rise by more than the
    fall of chi2; else 0."""
    known = set(before.model.table.names)
    new = np.array([name not in known for name in after.model.table.names])
    were, squares = _sizes(before), _sizes(after)
    worth = (before.estimate.chi2 - after.estimate.chi2) / after.estimate.chi2_per_dof
    rise = squares.sum() - were.sum()
    return float(np.sqrt(squares[new & after.free].mean())) if rise > max(worth, 0.0) else 0.0


def _sizes(result: FitResult) -> np.ndarray:
    """Squares of the effects' numbers in tolerances (n_parameters,), less what is their own
    uncertainty; 0 for all others."""
    table, sigma = result.model.table, result.estimate.sigma
    away = (result.model.values - table.nominal) ** 2 - sigma**2
    counts = result.free & np.array([p.group == "effect" for p in table])
    return np.where(counts, np.maximum(away / table.tolerance**2, 0.0), 0.0)


def _is_as_good(trial: Trial, other: Trial) -> bool:
    ratio = ratio_of(trial, other)
    if ratio is None or ratio >= MAX_SWAP_ERROR_RATIO:
        return False
    own, its = trial.fitted.estimate, other.fitted.estimate
    return its.chi2 - own.chi2 < MIN_SEPARATION_SIGMAS**2 * max(own.chi2_per_dof, 1e-300)


def _is_clearly_better(trial: Trial, other: Trial) -> bool:
    """Whether other effects explain more, by more than their numbers and chance are worth."""
    if other.result is None:
        return False
    own, its = trial.fitted.estimate, other.result.estimate
    worth = MIN_SEPARATION_SIGMAS**2 + 2 * max(own.dof - its.dof, 0)
    return own.chi2 - its.chi2 > worth * its.chi2_per_dof and not _describe_held_out_objection(
        trial, other
    )


def ratio_of(before: Trial, after: Trial) -> float | None:
    """Held-out error after over before; None where one is not known."""
    if before.result is None or after.result is None:
        return None
    return held_out_ratio(before.result.held_out.summary, after.result.held_out.summary)


def _is_superfluous_effect(without: Trial, trial: Trial) -> bool:
    """Whether an effect explains nothing significant next to the others."""
    if without.result is None or trial.result is None:
        return False
    return is_superfluous(without.result.estimate, trial.result.estimate)


def is_superfluous(less: Estimate, more: Estimate) -> bool:
    """Whether the improvement by additional parameters may be chance, by an F test."""
    q = less.dof - more.dof
    if q <= 0 or more.dof <= 0:
        return False
    F = max(less.chi2 - more.chi2, 0.0) / q / max(more.chi2_per_dof, 1e-300)
    return bool(log_p_of(F, q, more.dof) > np.log(EFFECT_SIGNIFICANCE_LEVEL))
