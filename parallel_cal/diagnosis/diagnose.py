"""What is missing in a model: effects ranked by observations, a verdict, what to measure next."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from parallel_cal.diagnosis.catalogue import Candidate, candidate, names_of
from parallel_cal.diagnosis.entries import (
    chi2_before,
    entries,
    negative_control,
    rivals_of,
)
from parallel_cal.diagnosis.fields import Field, Reference, field, reference
from parallel_cal.diagnosis.lack_of_fit import LackOfFit, lack_of_fit
from parallel_cal.diagnosis.patterns import odd_samples
from parallel_cal.diagnosis.scene import Progress
from parallel_cal.diagnosis.search import (
    Chosen,
    Search,
    Trial,
)
from parallel_cal.diagnosis.separate import next_measurement
from parallel_cal.diagnosis.statistics import holm
from parallel_cal.diagnosis.thresholds import REFITTED, SIGNIFICANT
from parallel_cal.diagnosis.verdict import Verdict, judge, listed
from parallel_cal.identification.fit import Result, fit, single_threaded
from parallel_cal.identification.options import FitOptions
from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset


@dataclass(frozen=True)
class Diagnosis:
    """A diagnosis with the inputs that made it.

    `base` is the model identified without further effects, `best` with those chosen; `ranked` the
    candidates of the base, best first; `left` the structure that remains in `best`.
    """

    model: Model
    dataset: Dataset
    base: Trial
    best: Trial
    ranked: tuple[Candidate, ...]
    entries: tuple[Mapping[str, Any], ...]
    negative_control: Mapping[str, Any]
    noise: Reference
    verdict: Verdict
    left: LackOfFit
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
            "baseline": self.base.fitted.held_out.document(),
            "best": self.best.fitted.held_out.document(),
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
                "floor": self.best.fitted.noise.document(),
            },
            "candidates": list(self.entries),
            "negative_control": dict(self.negative_control),
            "swaps": dict(self.swaps),
            "structure": self.left.document(),
            "odd_samples": list(self.odd),
            "measure_next": self.next,
            "warnings": list(self.best.fitted.warnings),
            "dataset": {"source": self.dataset.source, "sha256": self.dataset.sha256},
        }


def diagnose(
    model: Model,
    dataset: Dataset,
    *,
    effects: Iterable[str] = (),
    also: Iterable[str] = (),
    options: FitOptions | None = None,
    progress: Progress | None = None,
    **changes: Any,
) -> Diagnosis:
    """What is missing in a model, judged on these data (see docs/judge_your_calibration.md).

    The geometry is identified first; every effect of the catalogue (or only `effects`, and `also`
    a user's own by Python path) is scored off the geometry, the best are refitted and judged at
    poses left out. With a robust `loss`, samples that it gives less than half their weight are set
    aside first, and named. `changes` are options by name, as of `fit`. FitError where the
    baseline itself cannot be identified.
    """
    report = progress or (lambda stage, fraction: None)
    options = replace(options or FitOptions(), **changes)
    if options.loss != "linear":
        first = fit(model, dataset, options, hold_out=0)
        dataset = dataset.excluding([d.sample for d in first.down_weighted])
    plain = replace(options, loss="linear")

    def refit(model: Model) -> Result:
        return fit(model, dataset, plain)

    with single_threaded():
        search = Search(model, refit, report)
        report("identifying the geometry", 0.0)
        base = search.fit()
        return _Diagnosing(model, dataset, search, base, names_of(model, also, effects), report)()


class _Diagnosing:
    """One diagnosis under way: the catalogue ranked, effects searched, the rest described."""

    def __init__(
        self,
        model: Model,
        dataset: Dataset,
        search: Search,
        base: Trial,
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
        swaps = search.swaps(best, rivals_of(best, ranked))
        there = best.scene
        seen, found = field(scene), field(there)
        noise, left = reference(scene, seen), lack_of_fit(there, found)
        names = listed([c.name for c in best.chosen], swaps)
        before = chi2_before(base, best, ranked)
        verdict = judge(base, best, before, noise, left, found.held, names)
        self._report("weighing the observations", 0.8)
        rivals = {c.name: swaps.get(c.name, []) for c in best.chosen}
        return Diagnosis(
            model=self._model,
            dataset=self._dataset,
            base=base,
            best=best,
            ranked=tuple(ranked),
            entries=tuple(entries(ranked, base, search, noise, against)),
            negative_control=negative_control(scene, ranked),
            noise=noise,
            verdict=verdict,
            left=left,
            field=found,
            odd=tuple(odd_samples(there, found)),
            swaps=swaps,
            next=next_measurement(best, rivals, ranked),
        )

    def _ranked(self, here: Trial) -> list[Candidate]:
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

    def _significant(self, here: Trial) -> list[Candidate]:
        ranked = [c for c in self._ranked(here) if c.testable]
        adjusted = holm(np.array([c.p_value for c in ranked]))
        return [c for c, p in zip(ranked, adjusted, strict=True) if p < SIGNIFICANT][:REFITTED]
