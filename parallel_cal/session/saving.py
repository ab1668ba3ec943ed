"""Compare a session's model with the model in use, on the same samples, before replacing it.

A robot uses the file that a save overwrites. A worse or doubtful model is written only if the owner
insists after reading both errors.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from parallel_cal.base.errors import ModelFileError, ParallelCalError
from parallel_cal.base.files import BACKUP_SUFFIX
from parallel_cal.diagnosis.verdict import AMBER_VERDICTS
from parallel_cal.diagnosis.verdict_words import describe_verdict
from parallel_cal.identification.acceptance import format_errors
from parallel_cal.identification.fit import FitResult, fit
from parallel_cal.identification.fit_warnings import (
    list_moved_parameters,
    list_parameter_warnings,
)
from parallel_cal.identification.given_model import GivenModel, was_fitted, was_last_fitted_to
from parallel_cal.identification.observations import blocks
from parallel_cal.identification.options import FitOptions
from parallel_cal.identification.prediction_errors import (
    ERRORS,
    Errors,
    Summary,
    compute_rms_sigmas,
    held_out_ratio,
)
from parallel_cal.identification.thresholds import MAX_NEGLIGIBLE_ERROR_RISE
from parallel_cal.model.file.modelfile import (
    model_hash,
    model_text,
    parse_model,
    replace_model,
    write_model,
)
from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.session.history import SessionError, State

HELD_OUT = "at held-out poses"
UNSEEN = "at samples that none of its fits used"
PERHAPS_USED = "at samples that one of its fits may have used"
USED = "at the samples of its fit"


@dataclass(frozen=True)
class ComparedModel:
    """One of two models that a save compares: its `errors` at the `samples` at which both have one,
    with the standard deviation of the rms by kind; `where` says how they were judged."""

    name: str
    effects: tuple[str, ...]
    errors: Summary
    sigmas: Mapping[str, float]
    samples: int
    where: str


@dataclass(frozen=True)
class Replacement:
    """A model that is about to replace the model in a file.

    `comparison` is a sentence with the errors of both, empty if they cannot be compared, and
    `judgement` its last part, which says which one is better. `objections` are the reasons to ask
    the owner first, empty if the model may be written. `in_use_hash` is empty if there is no
    readable file. `errors` and `in_use_errors` are summaries at the same samples, None if not
    known; `models` are both models with these errors, empty if they cannot be compared.
    """

    file: Path
    comparison: str
    objections: tuple[str, ...]
    model_hash: str
    in_use_hash: str
    errors: Summary | None = None
    in_use_errors: Summary | None = None
    judgement: str = ""
    models: tuple[ComparedModel, ...] = ()

    @property
    def key(self) -> str:
        """A hash of both models and the reasons: a confirmation is valid for these only."""
        return model_hash("\n".join((self.model_hash, self.in_use_hash, *self.reasons)))

    @property
    def reasons(self) -> tuple[str, ...]:
        """The objections, and the comparison if it is none of them."""
        more = (self.comparison,) if self.comparison else ()
        return (*more, *(one for one in self.objections if one != self.comparison))

    @property
    def is_in_use(self) -> bool:
        """Whether the file contains this model already."""
        return self.model_hash == self.in_use_hash

    def document(self) -> dict[str, Any]:
        """Return its part of the document of `parallel-cal session save --json`; errors are SI."""
        known = (self.errors, self.in_use_errors)
        this, in_use = (None if e is None else e.document() for e in known)
        return {
            "comparison": self.comparison,
            "objections": list(self.objections),
            "errors": this,
            "in_use": {"hash": self.in_use_hash, "errors": in_use},
        }

    def entry(self, reason: str = "") -> dict[str, Any]:
        """Return the history entry of a model that the owner insisted on, with his reason."""
        found = self.document()
        errors = {key: found[key] for key in ("errors", "in_use")}
        stated = {"reason": reason} if reason else {}
        return {"step": "save", "forced": "; ".join(self.reasons), **stated, **errors}


class SaveRefused(SessionError):
    """A model was not written, because the owner must confirm the `replacement` first."""

    def __init__(self, replacement: Replacement):
        super().__init__(f"{'; '.join(replacement.reasons)}; {replacement.file} was not written")
        self.replacement = replacement


def compare_with_model_in_use(
    model: Model,
    state: State,
    read_samples: Callable[[], tuple[Dataset, FitOptions]],
    file: Path,
) -> Replacement:
    """Compare the model of a session's `state` with the model in `file` on the same samples.

    `read_samples` returns the samples, with the options to fit them. If the models cannot be
    compared, the reason is an objection, not an error.
    """
    own = model_hash(model)
    objections = list[str]()
    if not state.errors:
        objections.append("this model was not identified on this session's samples: run Fit first")
    if state.against:
        objections.append(state.against)
    if state.verdict in AMBER_VERDICTS:
        words = describe_verdict(state.verdict, state.summary)
        objections.append(f"the verdict on this model is {words}")
    samples: tuple[Dataset, FitOptions] | None = None
    judged: _Judged | None = None
    try:
        samples = read_samples()
        judged = _Judged.of(model, *samples, fitted_to_these=bool(state.errors))
        objections += judged.doubts
    except ParallelCalError as error:
        objections.append(f"the errors of this model are not known: {error}")
    if not file.exists():
        known = None if judged is None else judged.errors.summary
        return Replacement(file, "", tuple(objections), own, "", known)
    in_use_hash = _hash_of(file)
    if in_use_hash == own:
        return Replacement(file, "", (), own, in_use_hash)
    other: _Judged | None = None
    try:
        other = _judge_in_use(file, model, samples)
    except ParallelCalError as error:
        objections.insert(0, f"the model in use cannot be compared with this one: {error}")
    if other is None or judged is None or samples is None:
        return Replacement(file, "", tuple(objections), own, in_use_hash)
    models = _compare_at_common_samples(other, judged, samples[0])
    old, new = (one.errors for one in models)
    ratio = held_out_ratio(old, new)
    judgement = _judge_ratio(ratio, new)
    words = (
        f"on the same samples the model in use has an error of {format_errors(old)} {other.where}, "
        f"this model of {format_errors(new)} {judged.where}: {judgement}"
    )
    if ratio is None or ratio > 1 + MAX_NEGLIGIBLE_ERROR_RISE:
        objections.insert(0, words)
    return Replacement(
        file, words, tuple(objections), own, in_use_hash, new, old, judgement, models
    )


def write_for_robot(
    model: Model, replacement: Replacement, insisted: bool, reason: str = ""
) -> Model:
    """Write the model to the replacement's file atomically and back up the previous file.

    Return the model as written; its history has an entry with the `reason` if the owner
    `insisted`. SaveRefused if
    there are objections and the owner does not insist; SessionError if the file has changed since
    the comparison.
    """
    if replacement.is_in_use:
        return model
    if replacement.objections:
        if not insisted:
            raise SaveRefused(replacement)
        model = replace(model, history=(*model.history, replacement.entry(reason)))
    file = replacement.file
    if (now := _hash_of(file)) != replacement.in_use_hash:
        raise SessionError(
            f"{file} changed during the comparison: its sha256 is {now[:12] or 'unknown'}, "
            f"expected {replacement.in_use_hash[:12] or 'no file'}; save again to compare with "
            "the present file"
        )
    if file.is_file() and not _is_text(file):
        try:
            shutil.copyfile(file, f"{file}{BACKUP_SUFFIX}")
        except OSError as error:
            raise ModelFileError(
                f"{file}: cannot write the backup {file}{BACKUP_SUFFIX}: {error.strerror}"
            ) from None
        write_model(model, file)
    else:
        replace_model(model, file)
    return model


def _hash_of(file: Path) -> str:
    """Return the sha256 (hex) of a file, "" if it is not readable."""
    try:
        return model_hash(file.read_bytes()) if file.is_file() else ""
    except OSError:
        return ""


def _is_text(file: Path) -> bool:
    try:
        model_text(file)
    except ModelFileError:
        return False
    return True


@dataclass(frozen=True)
class _Judged:
    """A model, its errors at samples, their origin, and doubts about its parameters.

    `where` completes a sentence: "at held-out poses".
    """

    model: Model
    errors: Errors
    where: str
    doubts: tuple[str, ...] = ()

    @classmethod
    def of(
        cls, model: Model, dataset: Dataset, options: FitOptions, fitted_to_these: bool
    ) -> _Judged:
        """Judge a model: by errors at held-out poses if it was fitted to exactly these samples.

        Otherwise by the errors of the unchanged model: a fit to few samples would make a good
        model look bad.
        """
        if not fitted_to_these:
            found = GivenModel.of(model, dataset, options.joint_sigma).errors
            return cls(model, found, PERHAPS_USED if was_fitted(model) else UNSEEN)
        result: FitResult = fit(model, dataset, options)
        # What the program frees by itself and the data do not determine keeps its values.
        list_doubts = list_parameter_warnings if options.free else list_moved_parameters
        doubts = tuple(list_doubts(result.model, result.estimate, result.free))
        if result.held_out.summary.is_known:
            return cls(model, result.held_out, HELD_OUT, doubts)
        return cls(model, result.before, USED, doubts)


def _judge_in_use(file: Path, model: Model, samples: tuple[Dataset, FitOptions] | None) -> _Judged:
    """Judge the model in a file; ParallelCalError if it cannot be compared with `model`."""
    in_use = parse_model(model_text(file), str(file))
    if in_use.mechanism.name != model.mechanism.name:
        raise SessionError(
            f"{file} is a {in_use.mechanism.name}, this model is a {model.mechanism.name}"
        )
    if samples is None:
        raise SessionError("there are no samples to compare them on")
    dataset, options = samples
    # What this session fixes or frees is no property of the other model.
    others = replace(options, fix=(), free=())
    return _Judged.of(in_use, dataset, others, was_last_fitted_to(in_use, dataset))


def _compare_at_common_samples(
    in_use: _Judged, this: _Judged, dataset: Dataset
) -> tuple[ComparedModel, ...]:
    """Return both models with each kind of error at the samples at which both have it."""
    theirs, mine = in_use.errors.parts(), this.errors.parts()
    for kind in ERRORS:
        a, b = theirs[kind], mine[kind]
        if a.shape == b.shape:
            known = np.isfinite(a) & np.isfinite(b)
            theirs[kind], mine[kind] = (np.where(known, part, np.nan) for part in (a, b))
    groups = blocks(dataset)
    return tuple(
        ComparedModel(
            name,
            tuple(effect.name for effect in one.model.effects),
            errors.summary,
            compute_rms_sigmas(errors, groups),
            int(errors.judged.sum()),
            one.where,
        )
        for name, one, errors in (
            ("model in use", in_use, Errors(**theirs)),
            ("this model", this, Errors(**mine)),
        )
    )


def _judge_ratio(ratio: float | None, new: Summary) -> str:
    """Say which model is better, by the ratio of the error of the new one to that in use."""
    if ratio is None:
        return "it is not known which one is better"
    if abs(ratio - 1) <= MAX_NEGLIGIBLE_ERROR_RISE:
        return "they are equally good"
    worse = ratio > 1
    factor = ratio if worse else 1 / ratio
    words = f"this model is {'worse' if worse else 'better'} by a factor of {factor:.3g}"
    if new.position_rms and new.orientation_rms:
        words += " (position and orientation together)"
    return words
