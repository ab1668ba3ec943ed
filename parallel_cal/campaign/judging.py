"""What the samples so far say: a verdict, the error at unseen poses, where to measure next.

It takes seconds and may be done in another process: what goes in and out can be pickled.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.campaign.targets import Target, next_targets
from parallel_cal.campaign.way import Guard
from parallel_cal.diagnosis.diagnose import Diagnosis, diagnose
from parallel_cal.diagnosis.separate import told_apart
from parallel_cal.identification.observations import observe
from parallel_cal.identification.options import FitOptions
from parallel_cal.identification.prediction_errors import errors
from parallel_cal.model.file.modelfile import dump_model, parse_model
from parallel_cal.model.mechanism import Box
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.session.session import Session
from parallel_cal.session.steps import Unproven

DONE = ("at_noise", "explained")
KINDS = ("position", "orientation")
LISTS = ("effects", "doubt", "untold", "suspected", "missing")
Tell = Callable[[str, float], None]


@dataclass(frozen=True)
class Judgement:
    """A diagnosis of `samples` samples: verdict and summary, the effects found, what is still in
    `doubt`, whether poses tell it or not (`untold`), or `suspected`, what would settle it, and the
    model with these effects as the `text` of a file.

    `unseen` are rms errors of that model at the poses that no fit saw, `before` those of the model
    that the campaign began with, `usual` at all samples, by kind (m, rad); `targets` where to
    measure next."""

    samples: int
    verdict: str
    summary: str
    effects: tuple[str, ...]
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
    def of(cls, document: Mapping[str, Any]) -> Judgement:
        """From JSON."""
        lists = {key: tuple(document[key]) for key in LISTS}
        targets = tuple(map(Target.of, document["targets"]))
        return cls(**{**document, **lists, "targets": targets})

    def settles(self, before: Judgement | None) -> bool:
        """Whether nothing is left to find: nothing is suspected, nor in doubt that poses may tell,
        no condition is to be changed yet, and the samples since the judgement before have changed
        nothing."""
        if before is None or self.suspected or set(self.doubt) - set(self.untold):
            return False
        if any(target.conditions for target in self.targets):
            return False
        names, were = ({*one.effects, *one.doubt} for one in (self, before))
        return self.verdict in DONE and (self.verdict, names) == (before.verdict, were)


@dataclass(frozen=True)
class Question:
    """What is asked about samples: the model's text, boxes to keep out of, how many `more` poses
    are to be measured next and how many are `left` in all, by how much conditions may be changed
    for them, and how it is identified."""

    model: str
    keep_out: tuple[Box, ...] = ()
    effects: tuple[str, ...] = ()
    more: int = 0
    left: int = 0
    changes: Mapping[str, float] = field(default_factory=dict)
    seed: int = 0
    options: FitOptions = field(default_factory=FitOptions)


def judged(
    question: Question, dataset: Dataset, unseen: np.ndarray, tell: Tell | None = None
) -> Judgement:
    """Diagnose the samples that are not `unseen` (N,); FitError where they identify nothing."""
    model = parse_model(question.model)
    fitted = dataset.select(~unseen)
    found = diagnose(
        model, fitted, effects=question.effects, options=question.options, progress=tell
    )
    best = found.best.fitted.model
    text = dump_model(best)
    doubt = tuple(dict.fromkeys([*(n for s in found.swaps.values() for n in s),
                                 *found.robot_or_device]))  # fmt: skip
    targets, untold = list[Target](), tuple[str, ...]()
    if question.more:
        guard = Guard.of(replace(best, covariance=None), question.keep_out)
        targets, untold = next_targets(
            found, guard, question.more, question.left, question.changes, question.seed
        )
    return Judgement(
        len(dataset), found.verdict.word, found.verdict.summary, found.effects, doubt,
        untold, found.suspected, missing(found), text,
        rms(found.model, dataset.select(unseen), question.options),
        rms(best, dataset.select(unseen), question.options),
        rms(best, dataset, question.options), tuple(targets), found.document(),
    )  # fmt: skip


def missing(found: Diagnosis) -> tuple[str, ...]:
    """What would settle what is in doubt, a sentence each."""
    told = [
        told_apart(name, other) for name in found.effects for other in found.swaps.get(name, ())
    ]
    record = [
        f"record {' and '.join(conditions)} for {name}"
        for name, conditions in found.measure_next.record.items()
    ]
    more = [f"measure more: {name} is no chance, and not proven yet" for name in found.suspected]
    return tuple(dict.fromkeys([*(t for t in told if t), *found.verdict.against, *more, *record]))


def rms(model: Any, dataset: Dataset, options: FitOptions) -> dict[str, float]:
    """Of a model's errors at samples, by kind where measured (m, rad)."""
    if not len(dataset):
        return {}
    summary = errors(model, observe(model, dataset, options.joint_sigma)).summary
    found = {kind: summary.rms(kind) for kind in KINDS}
    return {kind: float(value) for kind, value in found.items() if value is not None}


@dataclass(frozen=True)
class Conclusion:
    """What a campaign's session ends in: the model as text where it is proven better than the one
    before, and a sentence."""

    text: str
    words: str


def concluded(folder: Path, judgement: Judgement) -> Conclusion:
    """The session's last steps: identify, and add each effect that was found, as far as that is
    proven at poses left out."""
    session = Session(folder)
    state = session.fit()
    if state.against:
        return Conclusion("", f"{state.against}; nothing was written")
    added, refused = [], []
    for effect in judgement.effects:
        try:
            session.add(effect)
        except Unproven as error:
            refused.append(f"{effect} not added: {error.against}")
        except FitError as error:
            refused.append(f"{effect} not added: {error}")
        else:
            added.append(effect)
    words = f"identified{''.join(f', {name} added' for name in added)}"
    return Conclusion(dump_model(session.model), "; ".join([words, *refused]))
