"""The result of a diagnosis: what is missing, how sure, what is left, and what to do next."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from parallel_cal.base.documents import to_json_value
from parallel_cal.base.notebook import ShownInNotebook
from parallel_cal.diagnosis.addition import Addition
from parallel_cal.diagnosis.ambiguity import Ambiguity
from parallel_cal.diagnosis.catalogue import Candidate
from parallel_cal.diagnosis.confirmation import Confirmed, format_additions
from parallel_cal.diagnosis.entries import Entry
from parallel_cal.diagnosis.explanation import Explanation
from parallel_cal.diagnosis.field import Field
from parallel_cal.diagnosis.findings import Findings
from parallel_cal.diagnosis.lack_of_fit import LackOfFit
from parallel_cal.diagnosis.next_measurement import NextMeasurement
from parallel_cal.diagnosis.noise import NoiseLevel, advise_on_noise
from parallel_cal.diagnosis.noise_shape import NoiseShape
from parallel_cal.diagnosis.patterns import OddSample
from parallel_cal.diagnosis.remaining import RemainingCondition
from parallel_cal.diagnosis.search import Trial
from parallel_cal.diagnosis.unusual import UnusualEffect
from parallel_cal.diagnosis.verdict import UNEXPLAINED_VERDICTS, Verdict
from parallel_cal.identification.drift_test import TARGET_EFFECT
from parallel_cal.identification.fit import Prepared
from parallel_cal.identification.platform_shift import find_large_device_effects
from parallel_cal.identification.recheck import DEVICE_MOVED, Recheck
from parallel_cal.identification.registration import Registration
from parallel_cal.model.model import Model
from parallel_cal.model.words import join_words
from parallel_cal.recordings.dataset import Dataset

STATE_THE_SIDES = (
    "state the sides from which the joints came, and diagnose again: columns direction.JOINT, or "
    "visits: in order in the column map if each joint moved straight from row to row. If encoders "
    "and device repeat no better, state the noise of repeated visits instead"
)


@dataclass(frozen=True)
class Diagnosis(ShownInNotebook):
    """The result of a diagnosis, with its inputs.

    Attributes
    ----------
    ready : Prepared
        The model and the samples, as they were ready for a fit.
    findings : Findings
        The fits without and with the effects found, and what the latter leaves.
    explanation : Explanation
        The causes of the residuals of `base`, with their probabilities.
    confirmed : Confirmed
        The effects found as `add` judges them.
    entries : tuple of Entry
        One for each candidate effect, the most probable first.
    verdict : Verdict
    measure_next : NextMeasurement
        Which measurements would decide between the effects found and their rivals.
    ambiguous : tuple of Ambiguity
        Effects of the model in whose place others may be.
    odd_samples : tuple of OddSample
        Samples to check before the diagnosis is relied upon: outliers, and samples with a strong
        influence on the fit.
    knocked : tuple of OddSample
        Single samples far from all others, as if somebody knocked the device. They are excluded
        from `base` and `best`.
    """

    ready: Prepared
    findings: Findings
    explanation: Explanation
    confirmed: Confirmed
    entries: tuple[Entry, ...]
    verdict: Verdict
    measure_next: NextMeasurement
    ambiguous: tuple[Ambiguity, ...]
    odd_samples: tuple[OddSample, ...]
    knocked: tuple[OddSample, ...] = ()

    @property
    def model(self) -> Model:
        """The model that was fitted, without further effects."""
        return self.ready.start

    @property
    def dataset(self) -> Dataset:
        """The samples of `base` and `best`."""
        return self.base.fitted.dataset

    @property
    def registration(self) -> Registration | None:
        """Where the device was found, if it was not where the model says."""
        return self.ready.registration

    @property
    def drift(self) -> Recheck | None:
        """Of an update: whether the robot has drifted since its last calibration; None if nothing
        tells it."""
        return self.ready.drift

    @property
    def base(self) -> Trial:
        """The fit of the model without further effects."""
        return self.findings.base

    @property
    def best(self) -> Trial:
        """The fit with the effects that were found."""
        return self.findings.best

    @property
    def ranked(self) -> tuple[Candidate, ...]:
        """The candidate effects that `base` may lack, the likeliest first."""
        return self.measure_next.ranked

    @property
    def field(self) -> Field:
        """The residuals of `best`, measured minus predicted, for each sample."""
        return self.findings.rest.field

    @property
    def structure(self) -> LackOfFit:
        """Tests whether neighbouring residuals of `best` are similar."""
        return self.findings.rest.structure

    @property
    def noise(self) -> NoiseLevel:
        """The noise by which the residuals are judged."""
        return self.findings.rest.noise

    @property
    def noise_shape(self) -> NoiseShape:
        """How the residuals of `best` are spread in time and size."""
        return self.findings.rest.shape

    @property
    def remaining(self) -> RemainingCondition | None:
        """A recorded condition on which the residuals of `best` still depend."""
        return self.findings.rest.condition

    @property
    def swaps(self) -> Mapping[str, Sequence[str]]:
        """For each effect found, the effects that may be in its place."""
        return self.findings.doubts.swaps

    @property
    def robot_or_device(self) -> tuple[str, ...]:
        """Effects found that an error of the device explains as well."""
        return self.confirmed.robot_or_device

    @property
    def unusual(self) -> tuple[UnusualEffect, ...]:
        """Effects of `best` that are larger than usual for the class of the machine, and what each
        gains at held-out poses."""
        return self.findings.doubts.unusual

    @property
    def suspected(self) -> tuple[str, ...]:
        """Effects that are significant but not yet proven at held-out poses."""
        return tuple(self.confirmed.against)

    @property
    def unseparated(self) -> tuple[str, ...]:
        """Effects of the device that the samples do not separate from errors of the robot."""
        if not self.findings.doubts.unseparated:
            return ()
        return tuple(find_large_device_effects(self.best.fitted.model))

    @property
    def addition(self) -> Addition | None:
        """The effects found that `add` accepts in one step, with the fit that it writes; None if it
        accepts none."""
        return self.confirmed.addition

    @property
    def doubted(self) -> Addition | None:
        """All effects found, judged as `add` judges them, if the robot or the device may cause some
        of them."""
        return self.confirmed.doubted

    @property
    def leaves_an_error(self) -> bool:
        """Whether an error is left that the catalogue does not describe, or describes only with
        effects that are larger than usual: a law outside the catalogue may be its cause."""
        return self.verdict.word in UNEXPLAINED_VERDICTS or bool(self.unusual)

    @property
    def next_steps(self) -> tuple[str, ...]:
        """What to do next, the most promising first: commands, with the effects found.

        A law outside the catalogue comes first if the effects found may only imitate it.
        """
        excluded = sorted(self.dataset.excluded)  # the command is copied: it names all of them
        exclude = f" --data exclude={','.join(map(str, excluded))}" if excluded else ""
        options = f"RECORDING{exclude} -o BETTER.yaml"
        adds, discovers, advice = list[str](), list[str](), list[str]()
        if (addition := self.addition) is not None:
            part = ""
            if len(addition.effects) < len(self.effects):
                part = f" ({addition.acceptance.description})"
            added = shlex.quote(addition.text)
            adds.append(f"add what was found{part}: parallel-cal add MODEL {added} {options}")
        if (doubted := self.doubted) is not None:
            what = "what errs" if self.addition is None else "all of it"
            judged = doubted.acceptance
            force = " --force" if judged.against else ""  # the samples do not tell what errs
            if judged.device_may_err or not judged.against:
                adds.append(
                    f"once you know whether the robot or the device errs, add {what}: "
                    f"parallel-cal add MODEL {shlex.quote(doubted.text)} {options}{force}"
                )
        if self.leaves_an_error and self.left != "no":
            if self.noise.variance is None and not self.explanation.laws:
                advice.append(advise_on_noise(self.best.fitted, self.noise.pure_error.dof))
            else:
                discovers.append(
                    "search for a law outside the catalogue: parallel-cal discover MODEL "
                    f"RECORDING{exclude} -o my_law.py"
                )
        if self.verdict.needs_sides:
            adds, discovers, advice = [], [], [STATE_THE_SIDES]
        commands = discovers + adds if self.verdict.suspected_of_law else adds + discovers
        refit = f"parallel-cal fit MODEL RECORDING{exclude} -o REFITTED.yaml"
        if self.drift is not None and self.drift.verdict == DEVICE_MOVED:
            # Other effects than that of the target may imitate a device that was not placed.
            is_placed = len(self.model.sensors) > len(self.base.fitted.given.start.sensors)
            adds = adds if is_placed or TARGET_EFFECT in self.effects else []
            commands = [self.drift.cure, *(f"if it stays there, {one}" for one in adds)]
        return (*self._list_checks("" if commands else refit), *commands, *advice)

    def _list_checks(self, refit: str) -> Iterator[str]:
        """Yield what to do about knocked samples: a `refit` excludes them, if the commands that
        follow do not."""
        odd = [one.title for one in self.knocked if not one.sideless]
        samples, them = ("samples", "them") if len(odd) > 1 else ("sample", "it")
        if odd and refit:
            yield f"check {samples} {join_words(odd)}, and fit without {them} if wrong: {refit}"
        elif odd:
            yield f"check {samples} {join_words(odd)}: the commands below exclude {them}"
        if refit and (sideless := [one.title for one in self.knocked if one.sideless]):
            yield f"fit without sample {', '.join(sideless)}: {refit}"

    def __repr__(self) -> str:
        found = ", ".join(self.effects) or "no effect"
        return (
            f"Diagnosis({self.model.mechanism.name}, {len(self.dataset)} samples, "
            f"{self.verdict.word}: {found})"
        )

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the effects found."""
        return tuple(c.name for c in self.best.chosen)

    @property
    def missing(self) -> list[dict[str, Any]]:
        """For each cause found: the effects that it may be, and how probable they are, together
        (`probability`) and each (`each`)."""
        return self.explanation.missing(self.effects)

    @property
    def left(self) -> str:
        """Whether an error is left that no effect found describes: `no`, `yes` or `unknown`."""
        if self.explanation.laws:
            return "yes"
        if self.noise.variance is None or self.verdict.word == "cannot_know":
            return "unknown"
        if self.verdict.word in ("at_noise", "explained"):
            return "no"
        shows = self.findings.leaves_more_than_noise
        return "yes" if shows or not self.effects else "no"

    @property
    def additions(self) -> tuple[str, ...]:
        """The effects found, as arguments of `add`, such as `gear_transmission_error:ratio=80`.

        To add all of them in one step, join them by `+`."""
        return format_additions(self.best, self.best.chosen)

    @property
    def band(self) -> tuple[float, float]:
        """Interval (low, high) that holds chi2/dof in 99 % of the cases, if the model needs no
        further effect; (0, inf) if the noise is not known."""
        return self.noise.band(self.base.fitted.estimate.dof)

    def document(self) -> dict[str, Any]:
        """The JSON document of `parallel-cal diagnose`; SI, None for unknown values."""
        base, best = self.base.fitted, self.best.fitted
        document = {
            "missing": self.missing,
            "left": self.left,
            "verdict": self.verdict.word,
            "summary": self.verdict.summary,
            "effects": self.effects,
            "additions": self.additions,
            "share_explained": self.verdict.share,
            "against": self.verdict.against,
            "remarks": self.verdict.remarks,
            "samples": len(self.dataset),
            "baseline": base.held_out.summary,
            "best": best.held_out.summary,
            "chi2_per_dof": {
                "baseline": base.estimate.chi2_per_dof,
                "best": best.estimate.chi2_per_dof,
                "band": self.band,
            },
            "noise": {
                "variance": self.noise.variance,
                "source": self.noise.source,
                "replicates": self.noise.pure_error.variance,
                "replicates_dof": self.noise.pure_error.dof,
                "misstated": self.noise.misstated,
                "shape": self.noise_shape,
                "floor": best.noise_floor,
            },
            "candidates": self.entries,
            "swaps": self.swaps,
            "robot_or_device": self.robot_or_device,
            "unusual": self.unusual,
            "suspected": self.suspected,
            "like_drift": self.verdict.like_drift,
            "ambiguous": {one.effect: one.names for one in self.ambiguous},
            "structure": self.structure,
            "depends_on": self.remaining,
            "odd_samples": self.odd_samples,
            "knocked": [one.sample for one in self.knocked],
            "measure_next": self.measure_next,
            "next_steps": self.next_steps,
            "registration": self.registration,
            "warnings": best.warnings,
            "dataset": {"source": self.dataset.source, "sha256": self.dataset.sha256},
        }
        return {key: to_json_value(value) for key, value in document.items()}
