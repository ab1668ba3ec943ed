"""Judge the samples so far: the verdict, the error at the validation poses, the next targets.

A judgement takes seconds and may run in another process: its inputs and outputs can be pickled.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from parallel_cal.base.errors import FitError, ModelFileError
from parallel_cal.base.threads import single_threaded
from parallel_cal.campaign.laws import LawSearch, search_laws
from parallel_cal.campaign.path_guard import Guard
from parallel_cal.campaign.targets import Target, next_targets, repeat_first_poses
from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.diagnosis.result import Diagnosis
from parallel_cal.diagnosis.separate import explain_separation
from parallel_cal.discovery.in_session import write_effects
from parallel_cal.identification.image_poses import estimate_robot_error, find_shown_poses
from parallel_cal.identification.observations import observe
from parallel_cal.identification.options import FitOptions
from parallel_cal.identification.prediction_errors import Summary, errors
from parallel_cal.identification.predictions import predict_configurations
from parallel_cal.identification.registration import register_device
from parallel_cal.model.file.modelfile import parse_model, readable_text
from parallel_cal.model.mechanism import Box
from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.session.session import Session
from parallel_cal.session.steps import UnprovenStepError

DESCRIBED = "described"  # no effect of the catalogue explains the error, but a proven law does
FINAL_VERDICTS = ("at_noise", "explained", DESCRIBED)
KINDS = ("position", "orientation")
# Factor by which the error at the validation poses may rise. The poses stay the same, so a larger
# rise is not due to chance.
MAX_ERROR_RISE = 1.5
TUPLE_FIELDS = ("effects", "additions", "doubt", "untold", "suspected", "missing")
ADDED_TUPLE_FIELDS = ("laws",)  # journals of earlier releases lack them
Tell = Callable[[str, float], None]


@dataclass(frozen=True)
class Judgement:
    """A diagnosis of `samples` samples.

    `effects` are the effects found by name, `additions` the same effects as `add` takes them.
    `doubt` are effects that may be confused with others; `untold` are those that no poses can
    distinguish. `suspected` effects are significant but not proven. `missing` says what would
    decide. `text` is the model file with the effects found.

    If the verdict is `described`, `laws` are the laws that were found in the data (`joint2 by
    load.joint2`), `law_effects` their effect files by name, and `doubt` laws that describe the data
    equally well. The model in `text` does not contain them: they are code for a person to review.

    Errors are rms by kind (m, rad): `unseen` of that model at the validation poses, `before` of the
    campaign's initial model there, `usual` of that model at all samples. `floor` is the noise floor
    of that model. `targets` are the poses to measure next."""

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
    floor: Mapping[str, float] = field(default_factory=dict)
    laws: tuple[str, ...] = ()
    law_effects: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> Judgement:
        """From JSON."""
        lists = {key: tuple(document[key]) for key in TUPLE_FIELDS}
        lists |= {key: tuple(document.get(key, ())) for key in ADDED_TUPLE_FIELDS}
        targets = tuple(map(Target.from_document, document["targets"]))
        return cls(**{**document, **lists, "targets": targets})

    @property
    def validation_error(self) -> float:
        """rms error at the validation poses, m (rad if no position is measured)."""
        return select_primary_error(self.unseen)

    @property
    def reported(self) -> dict[str, Any]:
        """The keys of a campaign's document that it states."""
        keys = ("verdict", "effects", "laws", "diagnosis")
        return {key: getattr(self, key) for key in keys}

    def is_final(self, before: Judgement | None) -> bool:
        """Whether further poses are pointless.

        No effect is suspected, poses can resolve no remaining doubt, no condition is still to be
        changed, and the samples since the previous judgement changed neither verdict, effects nor
        laws. If an effect was found, those samples were planned to reveal effects that it masks."""
        if before is None or self.suspected or set(self.doubt) - set(self.untold):
            return False
        if any(
            target.conditions
            for target in (*self.targets, *(before.targets if self.effects else ()))
        ):
            return False
        names, were = ({*one.effects, *one.laws, *one.doubt} for one in (self, before))
        return self.verdict in FINAL_VERDICTS and (self.verdict, names) == (before.verdict, were)


@dataclass(frozen=True)
class JudgementRequest:
    """A request to judge samples.

    `model` is the model file's text. The next targets avoid the `keep_out` boxes and stay in a
    space `reach` times as large as the workspace. `more` is how many targets to plan next, `left`
    how many poses remain in all. `changes` says by how much conditions may be changed."""

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
    """Diagnose the samples outside the mask `unseen` (N,) of the validation poses, and plan the
    next targets.

    If no model describes the samples, the judgement names no effect, states why in its summary and
    keeps the campaign's model; the next targets are the first poses again."""
    model = parse_model(question.model)
    fitted = dataset.select(~unseen)
    try:
        found = diagnose(
            model, fitted, effects=question.effects, options=question.options, progress=tell
        )
        best = found.best.fitted.plausible_model
        text = readable_text(best, f"the model of the judgement of {len(dataset)} samples")
    except (FitError, ModelFileError) as error:
        return _make_judgement_without_model(model, dataset, unseen, question, str(error))
    doubt = tuple(
        dict.fromkeys([*(n for s in found.swaps.values() for n in s), *found.robot_or_device])
    )
    guard = Guard.of(replace(best, covariance=None), question.keep_out, question.reach)
    asked = question.more, question.left, question.changes, question.seed
    targets, untold = list[Target](), tuple[str, ...]()
    if question.more:
        targets, untold = next_targets(found, guard, *asked)
    missing = describe_missing_evidence(found)
    verdict, summary, suspected = found.verdict.word, found.verdict.text, found.suspected
    if first := found.explanation.first:
        summary = f"no geometry fits the samples without {' and '.join(first)}; so: {summary}"
    laws = LawSearch("")
    if _needs_law(found, question, targets):
        laws = search_laws(model, fitted, question.options, guard, *asked, tell)
        missing = laws.missing if laws.laws else (*missing, *laws.missing)
    if laws.laws:
        # An effect that is only suspected describes a part of what the law describes.
        verdict, summary, suspected = DESCRIBED, laws.summary, ()
        doubt, untold, targets = laws.rivals, laws.untold, [*laws.targets] or targets
    return Judgement(
        len(dataset),
        verdict,
        summary,
        found.effects,
        found.additions,
        doubt,
        untold,
        suspected,
        missing,
        text,
        robot_rms(found.base.fitted.given.model, dataset.select(unseen), question.options),
        robot_rms(best, dataset.select(unseen), question.options),
        rms(best, dataset, question.options),
        tuple(targets),
        found.document(),
        {} if is_measured_by_images(best, dataset) else by_kind(found.best.fitted.noise_floor),
        laws.laws,
        laws.effects,
    )


def _needs_law(found: Diagnosis, question: JudgementRequest, targets: Sequence[Target]) -> bool:
    """Whether to search for a law outside the catalogue: the whole catalogue explains nothing, and
    no untried condition is to be tried first."""
    return (
        found.verdict.word == "unexplained"
        and not question.effects
        and not any(target.conditions for target in targets)
    )


def _make_judgement_without_model(
    model: Model, dataset: Dataset, unseen: np.ndarray, question: JudgementRequest, why: str
) -> Judgement:
    """Make a judgement that names nothing because no model describes the samples.

    If something slipped or moved, the first poses show it when they are measured again."""
    try:
        registered, _ = register_device(
            model, dataset, question.options.joint_sigma, question.options.insist
        )
        errors_before = rms(registered, dataset.select(unseen), question.options)
    except FitError:
        errors_before = {}
    guard = Guard.of(model, question.keep_out, question.reach)
    targets = repeat_first_poses(dataset.select(~unseen), guard, question.more)
    return Judgement(
        len(dataset),
        "unexplained",
        f"no model describes the {len(dataset)} samples: {why}",
        (),
        (),
        (),
        (),
        (),
        ("if the device or its target slipped, start a new campaign",),
        question.model,
        errors_before,
        errors_before,
        {},
        tuple(targets),
    )


def describe_missing_evidence(found: Diagnosis) -> tuple[str, ...]:
    """Say what would resolve each doubt, one sentence each."""
    separations = [
        explain_separation(name, other)
        for name in found.effects
        for other in found.swaps.get(name, ())
    ]
    record = [
        f"record {' and '.join(conditions)} to test {name}"
        for name, conditions in found.measure_next.record.items()
    ]
    more = [f"measure more: {name} is significant but not proven yet" for name in found.suspected]
    sentences = [*filter(None, separations), *found.verdict.against, *more, *record]
    return tuple(dict.fromkeys(sentences))


def rms(model: Any, dataset: Dataset, options: FitOptions) -> dict[str, float]:
    """Return the rms errors of a model at samples, by kind if measured (m, rad)."""
    if not len(dataset):
        return {}
    return by_kind(errors(model, observe(model, dataset, options.joint_sigma)).summary)


def robot_rms(model: Model, dataset: Dataset, options: FitOptions) -> dict[str, float]:
    """Return the rms errors of a model at samples, by kind (m, rad), without the noise of images.

    A single image shows a pose with an error that may hide the robot's. The estimate contains its
    own standard deviation, because few poses tell it badly."""
    found = rms(model, dataset, options)
    travels = any(coordinate in "xyz" for coordinate in model.mechanism.moves)
    if not (len(dataset) and travels and is_measured_by_images(model, dataset)):
        return found
    observations = observe(model, dataset, options.joint_sigma)
    shown = find_shown_poses(model, observations, predict_configurations(model, observations))
    estimate = None if shown is None else estimate_robot_error(shown)
    return found if estimate is None else {"position": float(np.hypot(*estimate))}


def is_measured_by_images(model: Model, dataset: Dataset) -> bool:
    """Whether images show the poses of the samples, which no other device measured."""
    return not dataset.measured.any() and any(sensor.shows_pose for sensor in model.sensors)


def by_kind(summary: Summary) -> dict[str, float]:
    """Return the rms errors of a summary by kind, if measured (m, rad)."""
    found = {kind: summary.rms(kind) for kind in KINDS}
    return {kind: float(value) for kind, value in found.items() if value is not None}


def select_primary_error(errors: Mapping[str, float]) -> float:
    """Return the position error, or the orientation error if no position was measured; NaN if
    neither was."""
    return next(iter(errors.values()), np.nan)


@dataclass(frozen=True)
class Conclusion:
    """The end of a campaign's session: the model file's text if it is proven better than the
    initial model, else empty, and a sentence."""

    text: str
    words: str


@single_threaded()
def conclude(folder: Path, judgements: Sequence[Judgement]) -> Conclusion:
    """Take the session's last steps: fit, and add each effect found that cross-validation proves.

    Laws that were found in the data are written as effect files, for a person to review."""
    concluded, laws = _conclude_model(folder, judgements), judgements[-1].law_effects
    if not laws:
        return concluded
    files = write_effects(laws, Session(folder).effects_folder)
    written = [
        f"a law was found and written to {file}: review it, then run "
        f"'parallel-cal session add {folder} {file.stem}'"
        for file in files
    ]
    return replace(concluded, words="; ".join([concluded.words, *written]))


def _conclude_model(folder: Path, judgements: Sequence[Judgement]) -> Conclusion:
    """Fit the model, and add each effect found that cross-validation proves.

    If the error at the validation poses has risen since an earlier judgement, or if the geometry
    alone cannot be identified, return the model of the best judgement instead."""
    judgement, best = judgements[-1], min(judgements, key=lambda one: one.validation_error)
    now, least = judgement.validation_error, best.validation_error
    if now > MAX_ERROR_RISE * least > 0 and least < select_primary_error(best.before):
        words = "since then the error at the validation poses rose"
        return Conclusion(
            best.text,
            f"the model is that of {best.samples} poses: {words} by a factor of {now / least:.1f}",
        )
    session = Session(folder)
    try:
        state = session.fit()
    except FitError as error:
        if least < select_primary_error(best.before):
            return Conclusion(best.text, f"the model is that of {best.samples} poses: {error}")
        return Conclusion("", f"{error}; nothing was written")
    if state.against:
        return Conclusion("", f"{state.against}; nothing was written")
    words, why = "parameters identified", dict[str, str]()
    left = dict(zip(judgement.effects, judgement.additions, strict=True))
    while one := _add_first_proven(session, left, why):
        words += f", {one} added"
        del left[one]
    together = {" and ".join(left): "+".join(left.values())} if len(left) > 1 else {}
    # Effects that are proven only together: each alone would need implausible coefficients.
    if one := _add_first_proven(session, together, why):
        words += f", {one} added together"
        left.clear()
    refused = (f"{name} not added: {why[name]}" for name in left)
    text = readable_text(session.model, "the campaign's last model")
    return Conclusion(text, "; ".join([words, *refused]))


def _add_first_proven(session: Session, effects: Mapping[str, str], why: dict[str, str]) -> str:
    """Add the first effect that is proven and return its name, or an empty string; `why` receives
    the reason against each effect before it."""
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
