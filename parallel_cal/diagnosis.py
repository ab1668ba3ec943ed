"""What is missing in a model: effects ranked by evidence, a verdict, what to measure next."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from parallel_cal.dataset import Dataset
from parallel_cal.diagnosing.catalogue import Candidate, candidate, names_of
from parallel_cal.diagnosing.fields import Field, Reference, field, reference
from parallel_cal.diagnosing.patterns import odd_samples
from parallel_cal.diagnosing.scene import Progress, Scene
from parallel_cal.diagnosing.scoring import alike, resampled, score
from parallel_cal.diagnosing.search import (
    SIGNIFICANT,
    Chosen,
    Refit,
    Search,
    ratio_of,
    shuffled_p,
)
from parallel_cal.diagnosing.separate import next_measurement
from parallel_cal.diagnosing.statistics import holm
from parallel_cal.diagnosing.structure import Structure, structure
from parallel_cal.diagnosing.verdict import Verdict, judge, listed, share_explained
from parallel_cal.identification import fit, single_threaded
from parallel_cal.model import Model

ALIKE = 0.9  # canonical correlation above which two effects are one entry
RESAMPLES = 200
REFITTED = 5  # best candidates that are identified and judged at poses left out


@dataclass(frozen=True)
class Diagnosis:
    """A diagnosis with the inputs that made it.

    `base` is the model identified without further effects, `best` with those chosen; `ranked` the
    candidates of the base, best first; `left` the structure that remains in `best`.
    """

    model: Model
    dataset: Dataset
    base: Refit
    best: Refit
    ranked: tuple[Candidate, ...]
    entries: tuple[Mapping[str, Any], ...]
    placebo: Mapping[str, Any]
    noise: Reference
    verdict: Verdict
    left: Structure
    field: Field
    odd: tuple[Mapping[str, Any], ...]
    swaps: Mapping[str, list[str]]
    next: Mapping[str, Any]

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the effects found."""
        return tuple(c.name for c in self.best.chosen)

    def document(self) -> dict[str, Any]:
        """The JSON document of `parallel-cal diagnose`; all values SI, None where not known."""
        low, high = self.noise.band(self.base.fitted.estimate.dof)
        return {
            "verdict": self.verdict.word,
            "summary": self.verdict.summary,
            "effects": list(self.effects),
            "share_explained": self.verdict.share,
            "against": list(self.verdict.against),
            "samples": len(self.dataset),
            "baseline": self.base.document["held_out"]["after"],
            "best": self.best.document["held_out"]["after"],
            "chi2_per_dof": {
                "baseline": self.base.fitted.estimate.chi2_per_dof,
                "best": self.best.fitted.estimate.chi2_per_dof,
                "band": [low, high if np.isfinite(high) else None],
            },
            "noise": {
                "variance": self.noise.variance,
                "source": self.noise.source,
                "replicates": self.noise.replicates,
                "replicates_dof": self.noise.replicates_dof,
                "floor": self.best.document["noise_floor"],
            },
            "candidates": list(self.entries),
            "placebo": dict(self.placebo),
            "swaps": dict(self.swaps),
            "structure": self.left.document(),
            "odd_samples": list(self.odd),
            "measure_next": self.next,
            "warnings": list(self.best.document["warnings"]),
            "dataset": {"source": self.dataset.source, "sha256": self.dataset.sha256},
        }


def diagnose(
    model: Model,
    dataset: Dataset,
    *,
    effects: Iterable[str] = (),
    also: Iterable[str] = (),
    hold_out: float = 0.25,
    seed: int = 0,
    progress: Progress | None = None,
    **options: Any,
) -> Diagnosis:
    """What is missing in a model, judged on these data (see docs/judge_your_calibration.md).

    The geometry is identified first; every effect of the catalogue (or only `effects`, and `also`
    a user's own by Python path) is scored off the geometry, the best are refitted and judged at
    poses left out. Further options as in `identification.fit`. FitError where the baseline itself
    cannot be identified.
    """
    report = progress or (lambda stage, fraction: None)
    refit = partial(_refit, dataset=dataset, hold_out=hold_out, seed=seed, options=options)
    with single_threaded():
        search = Search(model, refit, report)
        report("identifying the geometry", 0.0)
        base = search.fit()
        return _Diagnosing(model, dataset, search, base, names_of(model, also, effects), report)()


def _refit(model: Model, dataset: Dataset, hold_out: float, seed: int, options: Any) -> Any:
    return fit(model, dataset, hold_out=hold_out, seed=seed, **options)


class _Diagnosing:
    """One diagnosis under way: the catalogue ranked, effects searched, the rest described."""

    def __init__(
        self,
        model: Model,
        dataset: Dataset,
        search: Search,
        base: Refit,
        names: list[str],
        report: Progress,
    ):
        self._model, self._dataset, self._search = model, dataset, search
        self._base, self._names, self._report = base, names, report
        self._known: dict[tuple[Chosen, ...], list[Candidate]] = {}

    def __call__(self) -> Diagnosis:
        base, search = self._base, self._search
        scene, ranked = base.scene, self._ranked(base)
        best, against = search.forward(base, self._significant)
        best = search.backward(best)
        swaps = search.swaps(best, _rivals(best, ranked))
        there = best.scene
        seen, found = field(scene), field(there)
        noise, left = reference(scene, seen), structure(there, found)
        names = listed([c.name for c in best.chosen], swaps)
        before = _chi2_before(base, best, ranked)
        verdict = judge(base, best, before, noise, left, found.held, names)
        self._report("planning what to measure next", 0.9)
        rivals = {c.name: swaps.get(c.name, []) for c in best.chosen}
        return Diagnosis(
            model=self._model,
            dataset=self._dataset,
            base=base,
            best=best,
            ranked=tuple(ranked),
            entries=tuple(self._entries(ranked, noise, against)),
            placebo=_placebo(scene, ranked),
            noise=noise,
            verdict=verdict,
            left=left,
            field=found,
            odd=tuple(odd_samples(there, found)),
            swaps=swaps,
            next=next_measurement(best, rivals, ranked),
        )

    def _ranked(self, here: Refit) -> list[Candidate]:
        """The catalogue beside a refit, best first; those that cannot be tested last."""
        if here.chosen in self._known:
            return self._known[here.chosen]
        scene, found = here.scene, []
        taken = {c.name for c in here.chosen}
        for k, name in enumerate(n for n in self._names if n not in taken):
            self._report(f"testing {name}", 0.1 + 0.3 * k / len(self._names))
            found.append(candidate(scene, name))
        self._known[here.chosen] = sorted(found, key=lambda c: (not c.testable, c.log_p))
        return self._known[here.chosen]

    def _significant(self, here: Refit) -> list[Candidate]:
        ranked = [c for c in self._ranked(here) if c.testable]
        adjusted = holm(np.array([c.p_value for c in ranked]))
        return [c for c, p in zip(ranked, adjusted, strict=True) if p < SIGNIFICANT][:REFITTED]

    def _entries(
        self, ranked: list[Candidate], noise: Reference, against: Mapping[str, str]
    ) -> list[dict[str, Any]]:
        """One row a candidate: evidence for the testable, a reason for the others."""
        self._report("drawing poses anew", 0.8)
        tested = [c for c in ranked if c.testable]
        adjusted = dict(
            zip([c.name for c in tested], holm(np.array([c.p_value for c in tested])), strict=True)
        )
        picks = first_picks(tested)
        rows = []
        for rank, one in enumerate(ranked, 1):
            row = _row(one, rank, ranked) | {
                "p_adjusted": adjusted.get(one.name), "first_picks": picks.get(one.name),
                "reason": one.reason or against.get(one.name, ""),
            }  # fmt: skip
            if one.testable and rank <= REFITTED:
                row |= self._judged(one, noise)
            rows.append(row)
        return rows

    def _judged(self, one: Candidate, noise: Reference) -> dict[str, Any]:
        """What a refit with this effect alone says."""
        base, after = self._base, self._search.fit(Chosen.of(one))
        if after.result is None:
            return {"reason": after.reason}
        estimate = after.fitted.estimate
        own = {
            name.removeprefix(f"{one.name}."): p
            for name, p in after.document["parameters"].items()
            if name not in base.document["parameters"] or _freed(name, base, after)
        }
        return {
            "holdout_before": base.document["held_out"]["after"],
            "holdout_after": after.document["held_out"]["after"],
            "holdout_ratio": ratio_of(base, after),
            "chi2_per_dof": estimate.chi2_per_dof,
            "share_explained": share_explained(
                _chi2_before(base, after, [one]), estimate.chi2_per_dof, noise.variance
            ),
            "shuffled_p_value": shuffled_p(one),
            "parameters": own,
        }


def _chi2_before(base: Refit, after: Refit, ranked: list[Candidate]) -> float:
    """chi2/dof of the base, on the rows of the model after: a larger model has more of them."""
    taken = {c.name for c in after.chosen}
    wider = [c.there for c in ranked if c.name in taken and c.there is not base.scene]
    return next((s.chi2_per_dof for s in wider if s is not None), base.scene.chi2_per_dof)


def _freed(name: str, base: Refit, after: Refit) -> bool:
    return bool(
        base.document["parameters"][name]["fixed"]
        and not after.document["parameters"][name]["fixed"]
    )


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
    return alike(one.score.U, other.score.U) > ALIKE


def _rivals(best: Refit, ranked: list[Candidate]) -> dict[str, list[Candidate]]:
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


def _placebo(here: Scene, ranked: list[Candidate]) -> dict[str, Any]:
    """A group of random columns as if it were an effect: where does it rank?"""
    draw = np.random.default_rng(0).standard_normal((len(here.residual), 6))
    random = score(here, draw * (here.residual != 0)[:, None])
    better = sum(c.score is not None and c.log_p < random.log_p for c in ranked)
    return {"random_group": {"p_value": random.p_value, "rank": better + 1}}
