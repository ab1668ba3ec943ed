"""Warn of what is doubtful about a fit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from parallel_cal.base.confidence import SIGMAS_AT_SIGNIFICANCE_LEVEL, SIGNIFICANCE_LEVEL
from parallel_cal.identification.estimate import Estimate
from parallel_cal.identification.noise_figures import list_noise
from parallel_cal.identification.observations import ESTIMATED, LAST, Observations
from parallel_cal.identification.prediction_errors import Summary
from parallel_cal.identification.thresholds import (
    MAX_HELD_ERROR_RATIO,
    MAX_MOVED_TOLERANCES,
    MAX_NAMED_DIRECTIONS,
    MAX_NAMED_WEAK_DIRECTIONS,
    MIN_DOF,
    MIN_TRUSTED_WEIGHT,
)
from parallel_cal.model.model import Model
from parallel_cal.model.words import direction_in_words, parameters_in_words
from parallel_cal.recordings.dataset import Dataset


def list_moved_parameters(model: Model, estimate: Estimate, free: np.ndarray) -> list[str]:
    """List parameters that moved far from their nominal values.

    The size of an effect that the data determine is a result: its nominal value, zero, only states
    that the effect is absent. Sizes that are larger than usual have a sentence of their own when
    they are accepted.
    """
    table = model.table
    moved = (model.values - table.nominal) / table.tolerance
    sigma = estimate.sigma / table.tolerance
    effects = {effect.name for effect in model.effects}
    is_size = np.array([p.name.partition(".")[0] in effects for p in table], dtype=bool)
    with np.errstate(invalid="ignore"):
        is_result = is_size & (np.abs(moved) > SIGMAS_AT_SIGNIFICANCE_LEVEL * sigma)
    return [
        f"{p.shown_name} moved {moved[i]:+.1f} tolerances from nominal{_describe_sigma(sigma[i])}"
        for i, p in enumerate(table)
        if free[i]
        and abs(moved[i]) > MAX_MOVED_TOLERANCES
        and p.name not in model.usual_tolerances
        and not is_result[i]
    ]


def list_parameter_warnings(model: Model, estimate: Estimate, free: np.ndarray) -> list[str]:
    """List parameters that moved far, and combinations that the data do not determine."""
    table, words = model.table, list_moved_parameters(model, estimate, free)
    unidentifiable = estimate.spectrum.unidentifiable
    if len(unidentifiable) > MAX_NAMED_DIRECTIONS:
        part_of = {name for direction in unidentifiable for name in direction}
        together = parameters_in_words((n for n in table.names if n in part_of), table)
        words.append(
            f"the data do not determine {len(unidentifiable)} combinations of "
            f"{together}: they keep "
            "the values that the model had"
        )
    elif unidentifiable:
        named = "; ".join(direction_in_words(c, table) for c in unidentifiable)
        words.append(f"the data do not determine {named}")
    return words


def list_setting_warnings(model: Model) -> list[str]:
    """List fixed parameters of effects that lie outside their range, such as a lead in mm."""
    effects = {effect.name for effect in model.effects}
    return [
        f"{p.shown_name} is {value:g}{unit}, but usually {p.low:g} to {p.high:g}{unit}: settings "
        "of effects are in SI units (m, rad, kg, s, N)"
        for p, value, fixed in zip(model.table, model.values, model.fixed, strict=True)
        if fixed and p.name.partition(".")[0] in effects and not p.low <= value <= p.high
        for unit in ("" if p.unit == "1" else f" {p.unit}",)
    ]


def _describe_sigma(tolerances: float) -> str:
    """The sigma of a parameter in its tolerances; the data may not determine it."""
    if not np.isfinite(tolerances):
        return ", but the data do not determine it"
    return f" (sigma {tolerances:.2g} tolerances)"


def on_priors(model: Model, estimate: Estimate) -> list[str]:
    """Say which weak directions the tolerances decide as priors, what this means, and what to
    do."""
    weak = estimate.spectrum.weak
    if not (estimate.spectrum.held and weak):
        return []
    named = [
        direction_in_words(c, model.table) for c in weak[: -MAX_NAMED_WEAK_DIRECTIONS - 1 : -1]
    ]
    more = f"; and {len(weak) - len(named)} more" if len(weak) > len(named) else ""
    if one := len(weak) == 1:
        it, its, stays = "it", "its", "it stays"
    else:
        it, its, stays = "them", "their", "they stay"
    return [
        f"these samples hardly determine {len(weak)} combination{'' if one else 's'} of "
        f"parameters: a change by one tolerance moves the residuals by less than one sigma. So the "
        f"tolerances decided: {stays} near nominal, and {its} sigma is about the tolerance that "
        f"the model file states, not a result of the measurement. Errors near the measured poses "
        f"hardly depend on {it}; elsewhere they may. To determine {it}, measure more varied poses "
        f"(plan proposes them), or state a smaller tolerance if you know the part better. "
        f"{'The combination' if one else 'The combinations'}: {'; '.join(named)}{more}"
    ]


def list_noise_warnings(
    model: Model,
    estimate: Estimate,
    observations: Observations,
    inseparable: Sequence[Sequence[str]] = (),
) -> list[str]:
    """Compare the residuals with the stated noise, or say what noise they contain.

    `inseparable` lists kinds of noise that the data do not separate.
    """
    if observations.noise_assumed:
        found = [one for one in list_noise(model, observations) if one.source == ESTIMATED]
        named = "; ".join(one.describe(_write_noise) for one in found)
        if not found:
            return [
                "the noise is not stated, and too few measurements remain to estimate it: the "
                "weights of the measurements are a guess"
            ]
        words = [
            f"the noise is not stated, so it was estimated from the residuals ({named}): they "
            "cannot show whether the model is complete"
        ]
        return words + [
            f"the data do not separate the noise of {' and '.join(names)}: the ratio of their "
            "standard deviations is a guess"
            for names in inseparable
        ]
    low, high = chi2_band(estimate.dof)
    if estimate.dof > 0 and not low <= estimate.chi2_per_dof <= high:
        size = "larger" if estimate.chi2_per_dof > high else "smaller"
        shown = format_distinctly([estimate.chi2_per_dof, low, high])
        noise = "stated noise"
        if LAST in observations.noise_from.values():
            noise = "noise that the last calibration estimated"
        return [
            f"chi2/dof {shown[0]} is outside {shown[1]}..{shown[2]}: the residuals are {size} than "
            f"the {noise}"
        ]
    return []


def _write_noise(value: float, unit: str) -> str:
    prefix, factor = ("u", 1e6) if value < 1e-3 else ("m", 1e3)
    return f"{value * factor:.3g} {prefix}{unit}"


def format_distinctly(values: Sequence[float]) -> list[str]:
    """Numbers with two decimals, or as many as the first needs to differ from the others."""
    for digits in range(2, 8):
        shown = [f"{value:.{digits}f}" for value in values]
        if shown[0] not in shown[1:]:
            break
    return shown


def list_held_coordinate_warnings(
    model: Model, after: Summary, noise: Callable[[], Summary]
) -> list[str]:
    """List measured coordinates that vary although the model holds them: chi2 ignores them."""
    words = []
    for kind, part in (("position", range(3)), ("orientation", range(3, 6))):
        error = after.rms(kind)
        if error is None or any(i in model.mechanism.moved for i in part):
            continue
        floor = noise().rms(kind)
        if floor is not None and error > MAX_HELD_ERROR_RATIO * floor:
            words.append(
                f"the {kind} error is {error / floor:.0f} times its noise, but "
                f"{model.mechanism.name} holds the {kind} at one value: a larger "
                f"model may explain it"
            )
    return words


@dataclass(frozen=True)
class DownWeightedSample:
    """A sample that a robust loss down-weights: its number, time (s) and weight."""

    sample: int
    time: float
    weight: float


def find_down_weighted_samples(
    estimate: Estimate, dataset: Dataset
) -> tuple[DownWeightedSample, ...]:
    """Find samples that a robust loss gave less than half their weight, smallest weight first."""
    if estimate.weight is None:
        return ()
    order = np.argsort(estimate.weight, kind="stable")
    return tuple(
        DownWeightedSample(
            int(dataset.numbers[i]), float(dataset.time[i]), float(estimate.weight[i])
        )
        for i in order
        if estimate.weight[i] < MIN_TRUSTED_WEIGHT
    )


def list_sample_warnings(estimate: Estimate, dataset: Dataset, loss: str) -> list[str]:
    """List samples that a robust loss down-weights."""
    words = [
        f"{d.sample} ({d.time:.1f} s, weight {d.weight:.2g})"
        for d in find_down_weighted_samples(estimate, dataset)
    ]
    return [f"samples down-weighted by loss {loss}: {', '.join(words)}"] if words else []


def chi2_band(dof: int) -> tuple[float, float]:
    """Compute the band that holds chi2/dof of 99 % of fits with a complete model and a stated
    noise."""
    from scipy.special import chdtri  # of the upper tail

    if dof <= 0:
        return (0.0, float("inf"))
    tail = SIGNIFICANCE_LEVEL / 2
    return float(chdtri(dof, 1 - tail)) / dof, float(chdtri(dof, tail)) / dof


def leaves_only_noise(model: Model, estimate: Estimate, observations: Observations) -> bool:
    """Whether a fit of the geometry alone leaves the noise that was stated, no more and no less: of
    noise that was stated too large, an error may be a part."""
    low, high = chi2_band(estimate.dof)
    return (
        not (model.effects or observations.noise_assumed)
        and estimate.dof >= MIN_DOF
        and low <= estimate.chi2_per_dof <= high
    )


def finite_or_none(value: float) -> float | None:
    """Convert a number for a document: None if it is not finite."""
    return float(value) if np.isfinite(value) else None
