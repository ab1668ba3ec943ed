"""What the samples so far say: a verdict, the error at unseen poses, where to measure next.

It takes seconds and may be done in another process: what goes in and out can be pickled.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.base.threads import single_threaded
from parallel_cal.campaign.path_guard import Guard
from parallel_cal.campaign.targets import Target, next_targets
from parallel_cal.diagnosis.diagnose import Diagnosis, diagnose
from parallel_cal.diagnosis.separate import explain_separation
from parallel_cal.identification.observations import observe
from parallel_cal.identification.options import FitOptions
from parallel_cal.identification.prediction_errors import errors
from parallel_cal.model.file.modelfile import parse_model, readable_text
from parallel_cal.model.mechanism import Box
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.session.session import Session
from parallel_cal.session.steps import UnprovenStepError

FINAL_VERDICTS = ("at_noise", "explained")
KINDS = ("position", "orientation")
MAX_ERROR_RISE = (
    1.5  # times the error at unseen poses: they are the same ones, so that it is no chance
)
TUPLE_FIELDS = ("effects", "additions", "doubt", "untold", "suspected", "missing")
Tell = Callable[[str, float], None]


@dataclass(frozen=True)
class Judgement:
    """A diagnosis of `samples` samples: verdict and summary, the effects found, by name and as
    `add` takes them, what is still in `doubt`, whether poses tell it or not (`untold`), or
    `suspected`, what would settle it, and the model with these effects as the `text` of a file.

    `unseen` are rms errors of that model at the poses that no fit saw, `before` those of the model
    that the campaign began with, `usual` at all samples, by kind (m, rad); `targets` where to
    measure next."""

    samples: int
    verdict: str
    summary: str
    effects: tuple[str, ...]
    additions: tuple[str, ...]
    doubt: tuple[str, ...]
    untold: tuple[str, ...]
    suspected: tuple[str, ...]
    missing: tuple[str, ...]
    text: str
    before: Mapping[str, float]
    unseen: Mapping[str, float]
    usual: Mapping[str, float]
    targets: tuple[Target, ...] = ()
    diagnosis: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> Judgement:
        """From JSON."""
        lists = {key: tuple(document[key]) for key in TUPLE_FIELDS}
        targets = tuple(map(Target.from_document, document["targets"]))
        return cls(**{**document, **lists, "targets": targets})

    @property
    def validation_error(self) -> float:
        """rms at the poses that no fit saw, m (rad where no position is measured)."""
        return select_primary_error(self.unseen)

    def is_final(self, before: Judgement | None) -> bool:
        """Whether nothing is left to find: nothing is suspected, nor in doubt that poses may tell,
        no condition is to be changed yet, and the samples since the judgement before have changed
        nothing; where an effect was found they were to show what hides beside it."""
        if before is None or self.suspected or set(self.doubt) - set(self.untold):
            return False
        if any(
            target.conditions
            for target in (*self.targets, *(before.targets if self.effects else ()))
        ):
            return False
        names, were = ({*one.effects, *one.doubt} for one in (self, before))
        return self.verdict in FINAL_VERDICTS and (self.verdict, names) == (before.verdict, were)


@dataclass(frozen=True)
class JudgementRequest:
    """What is asked about samples: the model's text, boxes to keep out of and how many times as
    large as the workspace what may be used is, how many `more` poses are to be measured next and
    how many are `left` in all, by how much conditions may be changed for them, and how it is
    identified."""

    model: str
    keep_out: tuple[Box, ...] = ()
    reach: float = 1.0
    effects: tuple[str, ...] = ()
    more: int = 0
    left: int = 0
    changes: Mapping[str, float] = field(default_factory=dict)
    seed: int = 0
    options: FitOptions = field(default_factory=FitOptions)


@single_threaded()
def judge_samples(
    question: JudgementRequest, dataset: Dataset, unseen: np.ndarray, tell: Tell | None = None
) -> Judgement:
    """Diagnose the samples that are not `unseen` (N,); FitError where they identify nothing."""
    model = parse_model(question.model)
    fitted = dataset.select(~unseen)
    found = diagnose(
        model, fitted, effects=question.effects, options=question.options, progress=tell
    )
    best = found.best.fitted.model
    text = readable_text(best, f"the model of the judgement of {len(dataset)} samples")
    doubt = tuple(
        dict.fromkeys([*(n for s in found.swaps.values() for n in s), *found.robot_or_device])
    )
    targets, untold = list[Target](), tuple[str, ...]()
    if question.more:
        guard = Guard.of(replace(best, covariance=None), question.keep_out, question.reach)
        targets, untold = next_targets(
            found, guard, question.more, question.left, question.changes, question.seed
        )
    return Judgement(
        len(dataset),
        found.verdict.word,
        found.verdict.summary,
        found.effects,
        found.additions,
        doubt,
        untold,
        found.suspected,
        describe_missing_evidence(found),
        text,
        rms(found.base.fitted.given.model, dataset.select(unseen), question.options),
        rms(best, dataset.select(unseen), question.options),
        rms(best, dataset, question.options),
        tuple(targets),
        found.document(),
    )


def describe_missing_evidence(found: Diagnosis) -> tuple[str, ...]:
    """What would settle what is in doubt, a sentence each."""
    told = [
        explain_separation(name, other)
        for name in found.effects
        for other in found.swaps.get(name, ())
    ]
    record = [
        f"record {' and '.join(conditions)} to test {name}"
        for name, conditions in found.measure_next.record.items()
    ]
    more = [f"measure more: {name} is significant but not proven yet" for name in found.suspected]
    return tuple(dict.fromkeys([*(t for t in told if t), *found.verdict.against, *more, *record]))


def rms(model: Any, dataset: Dataset, options: FitOptions) -> dict[str, float]:
    """Of a model's errors at samples, by kind where measured (m, rad)."""
    if not len(dataset):
        return {}
    summary = errors(model, observe(model, dataset, options.joint_sigma)).summary
    found = {kind: summary.rms(kind) for kind in KINDS}
    return {kind: float(value) for kind, value in found.items() if value is not None}


def select_primary_error(errors: Mapping[str, float]) -> float:
    """The position's, or where none was measured the orientation's; NaN where there is none."""
    return next(iter(errors.values()), np.nan)


@dataclass(frozen=True)
class Conclusion:
    """What a campaign's session ends in: the model as text where it is proven better than the one
    before, and a sentence."""

    text: str
    words: str


@single_threaded()
def conclude(folder: Path, judgements: Sequence[Judgement]) -> Conclusion:
    """The session's last steps: identify, and add each effect that was found, as far as that is
    proven at poses left out; the model of an earlier judgement where since then all that was
    added and measured has made the error at unseen poses rise."""
    judgement, best = judgements[-1], min(judgements, key=lambda one: one.validation_error)
    now, least = judgement.validation_error, best.validation_error
    if now > MAX_ERROR_RISE * least > 0 and least < select_primary_error(best.before):
        words = "since then the error at the validation poses rose"
        return Conclusion(
            best.text,
            f"the model is that of {best.samples} poses: {words} by a factor of {now / least:.1f}",
        )
    session = Session(folder)
    state = session.fit()
    if state.against:
        return Conclusion("", f"{state.against}; nothing was written")
    words, why = "parameters identified", dict[str, str]()
    left = dict(zip(judgement.effects, judgement.additions, strict=True))
    while one := _add_first_proven(session, left, why):
        words += f", {one} added"
        del left[one]
    together = {" and ".join(left): "+".join(left.values())} if len(left) > 1 else {}
    if one := _add_first_proven(
        session, together, why
    ):  # alone each would need what no such robot has
        words += f", {one} added together"
        left.clear()
    refused = (f"{name} not added: {why[name]}" for name in left)
    text = readable_text(session.model, "the campaign's last model")
    return Conclusion(text, "; ".join([words, *refused]))


def _add_first_proven(session: Session, effects: Mapping[str, str], why: dict[str, str]) -> str:
    """The first of some effects that is added, or nothing; of those before it why not."""
    for name, text in effects.items():
        try:
            session.add(text)
        except UnprovenStepError as error:
            why[name] = error.against
        except FitError as error:
            why[name] = str(error)
        else:
            return name
    return ""
