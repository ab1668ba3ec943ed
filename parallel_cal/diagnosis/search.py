"""Which effects together: forward by score, judged by leaving poses out, backward, swaps."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.diagnosis.catalogue import Candidate
from parallel_cal.diagnosis.scene import Progress, Scene
from parallel_cal.diagnosis.scoring import log_p_of
from parallel_cal.diagnosis.thresholds import (
    APART,
    AS_GOOD,
    LIKE,
    MOST_EFFECTS,
    SHUFFLES,
    SIGNIFICANT,
)
from parallel_cal.identification.acceptance import acceptance
from parallel_cal.identification.fit import Result
from parallel_cal.identification.methods._estimate import Estimate
from parallel_cal.identification.prediction_errors import held_out_ratio
from parallel_cal.model.model import Model


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


@dataclass(frozen=True)
class Trial:
    """A model identified anew with some effects, or why that failed."""

    chosen: tuple[Chosen, ...]
    result: Result | None
    reason: str = ""

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(c.name for c in self.chosen)

    @property
    def fitted(self) -> Result:
        """The identification; FitError where it failed."""
        if self.result is None:
            raise FitError(self.reason)
        return self.result

    @cached_property
    def scene(self) -> Scene:
        r = self.fitted
        return Scene.of(r.model, r.dataset, r.observations, r.free)


class Search:
    """The refits of one diagnosis, each made once."""

    def __init__(self, model: Model, refit: Callable[[Model], Result], progress: Progress):
        self._model, self._refit, self._progress = model, refit, progress
        self._known: dict[tuple[Chosen, ...], Trial] = {}

    def fit(self, *chosen: Chosen) -> Trial:
        """The baseline with these effects, identified on all poses and judged on those left out."""
        if chosen not in self._known:
            self._progress(f"refitting with {', '.join(c.name for c in chosen) or 'nothing'}", 0.5)
            self._known[chosen] = self._fit(chosen)
        return self._known[chosen]

    def _fit(self, chosen: tuple[Chosen, ...]) -> Trial:
        model = self._model
        try:
            for one in chosen:
                model = model.with_effect(one.name, one.settings)
            result = self._refit(model)
        except FitError as error:
            return Trial(chosen, None, str(error))
        return Trial(chosen, result)

    def accepts(self, before: Trial, one: Candidate) -> tuple[Trial, str]:
        """The refit with one more effect, and what stands against it (empty: nothing)."""
        after = self.fit(*before.chosen, Chosen.of(one))
        if after.result is None:
            return after, after.reason
        if reason := _unproven(before, after) or _chance(before, after, one):
            return after, reason
        if (size := _too_large(before.fitted, after.result)) > 1:
            return after, f"its numbers would be {size:.0f} times their usual size for little gain"
        return after, ""

    def suspects(self, before: Trial, one: Candidate) -> bool:
        """Whether one more effect is no chance, and only not proven yet: more poses tell."""
        after = self.fit(*before.chosen, Chosen.of(one))
        if after.result is None or _chance(before, after, one):
            return False
        return bool(_unproven(before, after) or _too_large(before.fitted, after.result) > 1)

    def forward(
        self, start: Trial, rank: Callable[[Trial], list[Candidate]]
    ) -> tuple[Trial, dict[str, str]]:
        """Effects added one by one while one is significant and nothing stands against it."""
        trial: Trial = start
        against: dict[str, str] = {}
        while len(trial.chosen) - len(start.chosen) < MOST_EFFECTS:
            for one in rank(trial):
                after, reason = self.accepts(trial, one)
                if not reason:
                    trial = after
                    break
                against[one.name] = reason
            else:
                break
        return trial, against

    def backward(self, trial: Trial) -> Trial:
        """Effects taken out again that those added later have made superfluous."""
        for one in trial.chosen:
            if len(trial.chosen) < 2:
                break
            without = self.fit(*(c for c in trial.chosen if c != one))
            if _superfluous(without, trial):
                trial = without
        return trial

    def swaps(self, trial: Trial, rivals: Mapping[str, list[Candidate]]) -> dict[str, list[str]]:
        """For each chosen effect those of its rivals that tell as good a story in its place."""
        found: dict[str, list[str]] = {}
        for i, one in enumerate(trial.chosen):
            for other in rivals.get(one.name, []):
                swapped = list(trial.chosen)
                swapped[i] = Chosen.of(other)
                if _as_good(trial, self.fit(*swapped)):
                    found.setdefault(one.name, []).append(other.name)
        return found


def _unproven(before: Trial, after: Trial) -> str:
    """What errors at poses left out say against a refit; empty where none were left out: then the
    verdict says that nothing is proven."""
    judgement = acceptance(after.fitted, before.fitted)
    return judgement.against if judgement.judged else ""


def _chance(before: Trial, after: Trial, one: Candidate) -> str:
    """What says that a refit is chance."""
    if _superfluous(before, after):
        return "explains nothing of what is left"
    p = one.shuffled_p
    if p is not None and p > (1 + AS_GOOD) / (SHUFFLES + 1):
        return "explains no more than its own condition shuffled between poses"
    return ""


def _too_large(before: Result, after: Result) -> float:
    """Rms of the new numbers in tolerances, where their squares, less what is their own
    uncertainty, are more than the fall of chi2 is worth; else 0."""
    model, estimate = after.model, after.estimate
    known = set(before.model.table.names)
    new = after.free & np.array([name not in known for name in model.table.names])
    away = ((model.values - model.table.nominal) ** 2 - estimate.sigma**2)[new]
    squares = np.maximum(away / model.table.tolerance[new] ** 2, 0.0)
    worth = (before.estimate.chi2 - estimate.chi2) / estimate.chi2_per_dof
    return float(np.sqrt(squares.mean())) if squares.sum() > max(worth, 0.0) else 0.0


def _as_good(trial: Trial, other: Trial) -> bool:
    ratio = ratio_of(trial, other)
    if ratio is None or ratio >= LIKE:
        return False
    own, its = trial.fitted.estimate, other.fitted.estimate
    return its.chi2 - own.chi2 < APART**2 * max(own.chi2_per_dof, 1e-300)


def ratio_of(before: Trial, after: Trial) -> float | None:
    """Held-out error after over before; None where one is not known."""
    if before.result is None or after.result is None:
        return None
    return held_out_ratio(before.result.held_out.summary, after.result.held_out.summary)


def _superfluous(without: Trial, trial: Trial) -> bool:
    """Whether an effect explains nothing significant beside the others."""
    if without.result is None or trial.result is None:
        return False
    return superfluous(without.result.estimate, trial.result.estimate)


def superfluous(less: Estimate, more: Estimate) -> bool:
    """Whether what some parameters more explain may be chance, by an F test."""
    q = less.dof - more.dof
    if q <= 0 or more.dof <= 0:
        return False
    F = max(less.chi2 - more.chi2, 0.0) / q / max(more.chi2_per_dof, 1e-300)
    return log_p_of(F, q, more.dof) > np.log(SIGNIFICANT)
