"""The rows of a diagnosis: what speaks for each candidate, and what against it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from parallel_cal.diagnosis.catalogue import Candidate
from parallel_cal.diagnosis.fields import Reference
from parallel_cal.diagnosis.scene import Scene
from parallel_cal.diagnosis.scoring import canonical_correlation, resampled, score
from parallel_cal.diagnosis.search import Chosen, Search, Trial, ratio_of
from parallel_cal.diagnosis.statistics import holm
from parallel_cal.diagnosis.thresholds import ALIKE, REFITTED, RESAMPLES
from parallel_cal.diagnosis.verdict import share_explained
from parallel_cal.identification.fit import Result


def entries(
    ranked: list[Candidate],
    base: Trial,
    search: Search,
    noise: Reference,
    against: Mapping[str, str],
) -> list[dict[str, Any]]:
    """One row a candidate: observations for the testable, a reason for the others."""
    tested = [c for c in ranked if c.testable]
    raised = holm(np.array([c.p_value for c in tested]))
    adjusted = dict(zip([c.name for c in tested], raised.tolist(), strict=True))
    picks = first_picks(tested)
    rows = []
    for rank, one in enumerate(ranked, 1):
        row = _row(one, rank, ranked) | {
            "p_adjusted": adjusted.get(one.name),
            "first_picks": picks.get(one.name),
            "reason": one.reason or against.get(one.name, ""),
        }
        if one.testable and rank <= REFITTED:
            row |= _judged(one, base, search, noise)
        rows.append(row)
    return rows


def _judged(one: Candidate, base: Trial, search: Search, noise: Reference) -> dict[str, Any]:
    """What a refit with this effect alone says."""
    after = search.fit(Chosen.of(one))
    if after.result is None:
        return {"reason": after.reason}
    chi2 = after.result.estimate.chi2_per_dof
    own = {
        name.removeprefix(f"{one.name}."): p
        for name, p in after.result.parameters().items()
        if _new(name, base.fitted, after.result)
    }
    return {
        "holdout_before": base.fitted.held_out.document(),
        "holdout_after": after.result.held_out.document(),
        "holdout_ratio": ratio_of(base, after),
        "chi2_per_dof": chi2,
        "share_explained": share_explained(chi2_before(base, after, [one]), chi2, noise.variance),
        "shuffled_p_value": one.shuffled_p,
        "parameters": own,
    }


def chi2_before(base: Trial, after: Trial, ranked: list[Candidate]) -> float:
    """chi2/dof of the base, on the rows of the model after: a larger model has more of them."""
    taken = {c.name for c in after.chosen}
    wider = [c.there for c in ranked if c.name in taken and c.there is not base.scene]
    return next((s.chi2_per_dof for s in wider if s is not None), base.scene.chi2_per_dof)


def _new(name: str, base: Result, after: Result) -> bool:
    """Whether a parameter is one that the base has not, or does not identify."""
    known, table = base.model.table, after.model.table
    if name not in known.names:
        return True
    return bool(after.free[table.index_of(name)] and not base.free[known.index_of(name)])


def _row(one: Candidate, rank: int, ranked: list[Candidate]) -> dict[str, Any]:
    """What is known of a candidate without a refit."""
    score = one.score
    return {
        "effect": one.name,
        "rank": rank,
        "physics": one.effect.physics,
        "source": one.effect.source,
        "p_value": one.p_value if score else None,
        "log10_p": one.log_p / np.log(10) if score else None,
        "F": score.F if score else None,
        "freedoms": score.q if score else None,
        "settings": dict(one.settings),
        "tried": one.tried,
        "remaining_after_geometry": score.remaining if score else None,
        "typical_size_in_sigmas": score.size if score else None,
        "confused_with": [c.name for c in ranked if c is not one and confused(one, c)],
        "lookalikes": list(one.effect.lookalikes),
        "separated_by": one.effect.separated_by,
        "missing_conditions": list(one.missing),
        "holdout_before": None,
        "holdout_after": None,
        "share_explained": None,
        "parameters": {},
    }


def confused(one: Candidate, other: Candidate) -> bool:
    """Whether the data cannot tell two effects: off the geometry they act in one direction."""
    if one.score is None or other.score is None or not (one.testable and other.testable):
        return False
    if one.there is not other.there:  # a larger model's rows are others
        return False
    return canonical_correlation(one.score.U, other.score.U) > ALIKE


def rivals_of(best: Trial, ranked: list[Candidate]) -> dict[str, list[Candidate]]:
    """For each chosen effect the candidates that the data confuse it with, all not chosen."""
    taken = {c.name for c in best.chosen}
    return {
        one.name: [c for c in ranked if c.name not in taken and confused(one, c)]
        for one in ranked
        if one.name in taken
    }


def first_picks(tested: list[Candidate]) -> dict[str, float]:
    """Share of the resamples of the poses in which each candidate scores best."""
    seen = [c for c in tested if c.score is not None and c.there is not None]
    if not seen:
        return {}
    logs = np.zeros((RESAMPLES, len(seen)))
    for there in {id(c.there): c.there for c in seen}.values():
        mine = [k for k, c in enumerate(seen) if c.there is there]
        groups = [seen[k].score.U for k in mine]  # type: ignore[union-attr]
        assert there is not None
        logs[:, mine] = resampled(there, groups, RESAMPLES) + np.log([seen[k].tried for k in mine])
    wins = np.bincount(np.argmin(logs, axis=1), minlength=len(seen)) / RESAMPLES
    return {c.name: float(w) for c, w in zip(seen, wins, strict=True)}


def negative_control(here: Scene, ranked: list[Candidate]) -> dict[str, Any]:
    """What no effect is: where a group of random columns ranks, and how often copies of each
    effect's own condition, shuffled between samples, score as well as the condition itself."""
    draw = np.random.default_rng(0).standard_normal((len(here.x), here.rows, 6))
    random = score(here, (here.whitener @ draw).reshape(-1, 6))
    better = sum(c.score is not None and c.log_p < random.log_p for c in ranked)
    shuffled = {c.name: p for c in ranked if c.testable and (p := c.shuffled_p) is not None}
    return {"random_group": {"p_value": random.p_value, "rank": better + 1}, "shuffled": shuffled}
