"""Steps of a calibration with their gate and their entry in the model file's history."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from parallel_cal.base.errors import FitError
from parallel_cal.diagnosis.catalogue import candidate
from parallel_cal.diagnosis.scene import scene
from parallel_cal.identification.fit import Result, fit
from parallel_cal.identification.prediction_errors import held_out_ratio
from parallel_cal.model.effect import parse_effect
from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset

NEGLIGIBLE = 1.01  # a removal may raise the held-out error by a hundredth


@dataclass(frozen=True)
class Step:
    """What a step (`fit`, `add`, `remove`) leaves: the model to be written, with the step in its
    history, and words of warning. `rival` is the identification on the same data that an effect
    must beat: without the one added, with the one removed."""

    name: str
    model: Model
    result: Result
    warnings: tuple[str, ...]
    rival: Result | None = None

    def document(self) -> dict[str, Any]:
        """The result's, with the errors of what the step had to beat."""
        document = self.result.document()
        if self.rival is not None:
            key = {"add": "held_out_without_effect", "remove": "held_out_with_effect"}[self.name]
            document[key] = self.rival.held_out.document()
        return document


def fitted(model: Model, dataset: Dataset, **options: Any) -> Step:
    """Identify the model's free parameters; options as in identification.fit (FitError)."""
    result = fit(model, dataset, **options)
    ratio = held_out_ratio(result.held_out_before.summary, result.held_out.summary)
    words = result.warnings
    if ratio is not None and ratio >= 1:
        words += (f"the error at poses left out did not fall (factor {ratio:.3f})",)
    return _step("fit", result, words)


def added(model: Model, effect: str, dataset: Dataset, force: bool = False, **options: Any) -> Step:
    """Identify anew with one more effect; FitError when that does not help at poses left out.

    `effect` is NAME[:param=value,...]: given numbers are held; an unknown gear ratio and the like
    are searched for. What it must beat is the model without the effect,
    identified on the same data: otherwise the re-identification of the geometry would pass for
    the effect's merit.
    """
    name, settings = parse_effect(effect)
    base = fit(model, dataset, **options)
    model.with_effect(name)  # a wrong name is better said before a search
    result = fit(model.with_effect(name, settings or _searched(base, name)), dataset, **options)
    ratio = held_out_ratio(base.held_out.summary, result.held_out.summary)
    words = _gate(
        ratio, 1.0, force,
        f"'{name}' does not lower the error at poses left out", "add it",
    )  # fmt: skip
    return _step("add", result, (*result.warnings, *words), name, base)


def _searched(base: Result, name: str) -> Mapping[str, float]:
    """The settings of an effect that fit best to what the model without it leaves."""
    here = scene(base.model, base.dataset, base.observations, base.free)
    return candidate(here, name).settings


def removed(
    model: Model, effect: str, dataset: Dataset, force: bool = False, **options: Any
) -> Step:
    """Identify anew without one of the effects; FitError when that costs accuracy."""
    smaller = model.without_effect(effect)
    with_it = fit(model, dataset, **options)
    result = fit(smaller, dataset, **options)
    ratio = held_out_ratio(with_it.held_out.summary, result.held_out.summary)
    words = _gate(
        ratio, NEGLIGIBLE, force,
        f"without '{effect}' the error at poses left out rises", "remove it",
    )  # fmt: skip
    return _step("remove", result, (*result.warnings, *words), effect, with_it)


def _gate(ratio: float | None, limit: float, force: bool, what: str, do: str) -> tuple[str, ...]:
    """A refusal, or with `force` a warning; nothing where the step is good."""
    if ratio is not None and ratio < limit:
        return ()
    text = f"{what} ({'too few poses to tell' if ratio is None else f'factor {ratio:.3f}'})"
    if force:
        return (text,)
    raise FitError(f"{text}; nothing was written. --force to {do} all the same")


def _step(
    name: str,
    result: Result,
    warnings: tuple[str, ...],
    effect: str | None = None,
    rival: Result | None = None,
) -> Step:
    """The step's model with one more entry in its history: no date, so that it is repeatable."""
    entry: dict[str, Any] = {"step": name}
    if effect is not None:
        entry["effect"] = effect
    document = result.document()
    entry |= {key: document[key] for key in ("method", "samples", "dataset")}
    entry |= _unusual(result)
    entry |= {key: document[key] for key in ("before", "after", "held_out", "chi2_per_dof")}
    model = replace(result.model, history=(*result.model.history, entry))
    return Step(name, model, result, warnings, rival)


def _unusual(result: Result) -> dict[str, Any]:
    """What was not plain least squares of all free parameters on all samples."""
    loss = result.options.loss if result.options.loss != "linear" else None
    samples = [doubted.sample for doubted in result.down_weighted]
    how = {"loss": loss, "refit": list(result.refit), "down_weighted": samples}
    return {key: value for key, value in how.items() if value}
