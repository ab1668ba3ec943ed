"""Make the rows of a diagnosis: the evidence for and against each candidate."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from parallel_cal.diagnosis.catalogue import Candidate
from parallel_cal.diagnosis.explanation import Explanation
from parallel_cal.diagnosis.findings import share_explained
from parallel_cal.diagnosis.noise import NoiseLevel
from parallel_cal.diagnosis.scoring import canonical_correlation
from parallel_cal.diagnosis.search import Chosen, Search, Trial, ratio_of
from parallel_cal.diagnosis.thresholds import MAX_REFITTED_CANDIDATES, MIN_CONFUSED_CORRELATION
from parallel_cal.identification.fit import ParameterEstimate
from parallel_cal.identification.prediction_errors import Summary


@dataclass(frozen=True)
class SingleEffectFit:
    """Fit with one candidate: validation errors without and with it, `ratio` with over without,
    chi2/dof, the share of the error above the noise floor that it removes, and its parameters."""

    before: Summary
    after: Summary
    ratio: float | None
    chi2_per_dof: float
    share_explained: float | None
    parameters: Mapping[str, ParameterEstimate]


@dataclass(frozen=True)
class Entry:
    """A candidate with its rank (from 1) and its evidence.

    `probability` is that of the robot having the effect, among all causes; None if the samples
    cannot show it, or if it was refuted. `probable` effects are worth a fit of their own, `alone`.
    `confused_with` are its lookalikes in these data. `reason` is the objection to it.
    """

    candidate: Candidate
    rank: int
    probability: float | None
    probable: bool
    confused_with: tuple[str, ...]
    reason: str
    alone: SingleEffectFit | None = None

    @property
    def name(self) -> str:
        return self.candidate.name

    @property
    def remaining(self) -> float | None:
        """Share of its columns that no geometry imitates."""
        return self.candidate.score.remaining if self.candidate.score else None

    def document(self) -> dict[str, Any]:
        one, score, alone = self.candidate, self.candidate.score, self.alone
        row = {
            "effect": one.name,
            "rank": self.rank,
            "probability": self.probability,
            "physics": one.effect.physics,
            "source": one.effect.source,
            "p_value": one.p_value if score else None,
            "log10_p": one.log_p / np.log(10) if score else None,
            "F": score.F if score else None,
            "freedoms": score.q if score else None,
            "settings": one.settings,
            "settings_sigma": one.sigma,
            "tried": one.tried,
            "remaining_after_geometry": self.remaining,
            "typical_size_in_sigmas": score.size if score else None,
            "confused_with": self.confused_with,
            "lookalikes": one.effect.lookalikes,
            "separated_by": one.effect.separated_by,
            "remedy": one.effect.remedy,
            "missing_conditions": one.missing,
            "holdout_before": alone.before if alone else None,
            "holdout_after": alone.after if alone else None,
            "share_explained": alone.share_explained if alone else None,
            "parameters": alone.parameters if alone else {},
            "reason": self.reason,
        }
        if alone:
            row |= {"holdout_ratio": alone.ratio, "chi2_per_dof": alone.chi2_per_dof}
        return row


def entries(
    ranked: Sequence[Candidate],
    base: Trial,
    search: Search,
    noise: NoiseLevel,
    against: Mapping[str, str],
    best: Trial,
    explanation: Explanation,
    suspected: Collection[str],
) -> tuple[Entry, ...]:
    """Make one entry for each candidate, the most probable first: evidence if it is testable, else
    a reason. Effects that are `suspected`, but not proven at held-out poses, have no probability:
    they may imitate what is not in the catalogue.

    Probable ones are fitted, each alone by a single step; those that `best` chose as large as the
    data show, even if that is unusual.
    """
    named, probable = set(best.names), explanation.probable
    alike = defaultdict[str, tuple[str, ...]](tuple)
    for one, other in combinations(ranked, 2):
        if are_confused(one, other):
            alike[one.name] += (other.name,)
            alike[other.name] += (one.name,)

    shown = [one.name for one in ranked if one.testable and one.name not in suspected]
    probability = {name: explanation.probability_of(name) for name in shown}

    def place(one: Candidate) -> tuple[bool, bool, float, float]:
        p = probability.get(one.name) or 0.0
        return not one.testable, one.name not in named, -p, one.log_p

    rows = []
    for rank, one in enumerate(sorted(ranked, key=place), 1):
        reason, alone = against.get(one.name) or one.reason, None
        likely = one.testable and one.name in probable
        if likely and rank <= MAX_REFITTED_CANDIDATES:
            fit = search.fit_as_shown if one.name in named else search.fit
            trial = fit(Chosen.of(one), once=True)
            reason = trial.reason or reason
            alone = _summarise_single_fit(one, base, trial, noise) if trial.result else None
        p = probability.get(one.name)
        rows.append(Entry(one, rank, p, likely, alike[one.name], reason, alone))
    return tuple(rows)


def _summarise_single_fit(
    one: Candidate, base: Trial, trial: Trial, noise: NoiseLevel
) -> SingleEffectFit:
    before, after = base.fitted, trial.fitted
    chi2 = after.estimate.chi2_per_dof
    old, table = before.model.table, after.model.table
    parameters = {}
    for name, estimated in after.parameters().items():
        known = name in old.names
        # A parameter that the base does not identify counts as new.
        if not known or (after.free[table.index_of(name)] and not before.free[old.index_of(name)]):
            parameters[name.removeprefix(f"{one.name}.")] = estimated
    return SingleEffectFit(
        before=before.held_out.summary,
        after=after.held_out.summary,
        ratio=ratio_of(base, trial),
        chi2_per_dof=chi2,
        share_explained=share_explained(chi2_before(base, trial, [one]), chi2, noise.variance),
        parameters=parameters,
    )


def chi2_before(base: Trial, after: Trial, ranked: Sequence[Candidate]) -> float:
    """chi2/dof of the base, on the rows of the model after: a larger model has more of them."""
    taken = {c.name for c in after.chosen}
    wider = [c.scene for c in ranked if c.name in taken and c.scene is not base.scene]
    return next((s.chi2_per_dof for s in wider if s is not None), base.scene.chi2_per_dof)


def are_confused(one: Candidate, other: Candidate) -> bool:
    """Whether the data cannot distinguish two effects: without the part that the geometry absorbs,
    both act in one direction."""
    if one.score is None or other.score is None or not (one.testable and other.testable):
        return False
    if one.scene is not other.scene:  # a larger model's rows are others
        return False
    return canonical_correlation(one.score.U, other.score.U) > MIN_CONFUSED_CORRELATION
