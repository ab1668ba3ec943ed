"""Identification: a model and a dataset in, a better model and how far to trust it out."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from parallel_cal.accuracy import Errors, errors, improvement, noise_floor
from parallel_cal.dataset import Dataset
from parallel_cal.errors import FitError
from parallel_cal.estimators import Estimator, estimator, need_settling
from parallel_cal.evidence import SCATTER, Evidence, gather
from parallel_cal.methods.implicit import Estimate
from parallel_cal.model import Model
from parallel_cal.parameters import Parameter
from parallel_cal.planners.words import direction_in_words
from parallel_cal.prior import Prior
from parallel_cal.refit import considered

Progress = Callable[[str, float], None]
FAR = 5.0  # tolerances: a parameter that moved further deserves a word
DOUBTED = 0.5  # a sample that a robust loss gives less weight than this is named


@dataclass(frozen=True)
class Result:
    """An identification with the inputs that made it.

    `held_out` errors come from fits that did not see the pose they are judged at; the
    estimates themselves use all samples.
    """

    model: Model
    start: Model
    estimate: Estimate
    free: np.ndarray
    before: Errors
    after: Errors
    held_out: Errors
    noise: dict[str, float | None]
    evidence: Evidence
    dataset: Dataset
    method: str
    loss: str = "linear"
    refit: tuple[str, ...] = ()
    warnings: tuple[str, ...] = field(default=())

    @property
    def samples(self) -> int:
        return len(self.evidence)

    def document(self) -> dict[str, Any]:
        """The JSON document of `parallel-cal fit`; all values SI, None where not known."""
        before, after = self.before.document(), self.after.document()
        held = {"before": self._held_out_before(), "after": self.held_out.document()}
        return {
            "samples": self.samples,
            "parameters": self._parameters(),
            "before": before,
            "after": after,
            "held_out": held,
            "improvement": improvement(before, after),
            "improvement_held_out": improvement(held["before"], held["after"]),
            "chi2_per_dof": finite_or_none(self.estimate.chi2_per_dof),
            "chi2_band": self._band(),
            "dof": self.estimate.dof,
            "rank": self.estimate.spectrum.rank,
            "free": int(self.free.sum()),
            "unidentifiable": [
                {"text": direction_in_words(c, self.model.mechanism), "parameters": c}
                for c in self.estimate.spectrum.unidentifiable
            ],
            "weak": [
                {"text": direction_in_words(c, self.model.mechanism), "parameters": c}
                for c in self.estimate.spectrum.weak
            ],
            "noise_floor": self.noise,
            "noise_from": self.evidence.noise_from,
            "method": self.method,
            "loss": self.loss,
            "refit": list(self.refit),
            "down_weighted": doubted(self.estimate, self.dataset),
            "iterations": self.estimate.iterations,
            "warnings": list(self.warnings),
            "dataset": {"source": self.dataset.source, "sha256": self.dataset.sha256},
        }

    def _band(self) -> list[float | None]:
        """Where chi2/dof of a complete model lies; nowhere where nobody knows the noise."""
        assumed = self.evidence.noise_assumed
        return [None, None] if assumed else list(chi2_band(self.estimate.dof))

    def _held_out_before(self) -> dict[str, float | None]:
        kinds = ("position", "orientation", "reading")
        judged = np.any([np.isfinite(self.held_out.norms(kind)) for kind in kinds], axis=0)
        return self.before.select(judged).document()

    def _parameters(self) -> dict[str, dict[str, Any]]:
        table, sigma = self.model.table, self.estimate.sigma
        return {
            p.name: {
                "value": float(self.model.values[i]),
                "sigma": finite_or_none(sigma[i]),
                "nominal": p.nominal,
                "unit": p.unit,
                "fixed": not bool(self.free[i]),
                "moved_tolerances": float((self.model.values[i] - p.nominal) / p.tolerance),
            }
            for i, p in enumerate(table)
        }

    def correlations(self) -> np.ndarray:
        """Correlation matrix (n_free, n_free) of the free parameters."""
        covariance = self.estimate.covariance[np.ix_(self.free, self.free)]
        sigma = np.sqrt(np.diag(covariance))
        return covariance / np.outer(sigma, sigma)


def fit(
    model: Model,
    dataset: Dataset,
    *,
    method: str = "implicit",
    free: Iterable[str] = (),
    fix: Iterable[str] = (),
    refit: Iterable[str] = (),
    hold_out: float = 0.25,
    joint_sigma: float | None = None,
    prior: bool | Prior = False,
    loss: str = "linear",
    seed: int = 0,
    progress: Progress | None = None,
) -> Result:
    """Identify a model's free parameters; errors at poses that the fit did not see.

    `free` and `fix` are name patterns (`chain1.*`) that change what the model file says; where
    one set lies inside the other the narrower wins (`fix=["*"], free=["chain1.Lb"]`). `refit`
    identifies these alone and keeps the others with the model's covariance (re-homing, warming
    up: a few poses are enough). `prior` is True (tolerances) or a Prior; `loss` one of scipy's
    (`huber`): samples that it mistrusts are named. FitError where the data cannot carry it.
    """
    report = progress or (lambda stage, fraction: None)
    mask, partial = _chosen(model, free, fix, refit)
    estimate_with = estimator(method, prior, loss)
    if partial:
        need_settling(method, "a partial re-calibration")
    evidence = gather(model, dataset, joint_sigma)
    _check_enough(model, evidence, mask, prior)
    report("errors before", 0.0)
    before = errors(model, evidence)
    report("identifying", 0.1)
    with single_threaded():
        estimate = estimate_with(model, evidence, mask)
        if evidence.noise_assumed:
            estimate = scaled(estimate)
        if partial:
            estimate = considered(model, evidence, mask, estimate)
        fitted = model.with_values(estimate.values, estimate.covariance)
        _check_plausible(fitted, estimate, mask)
        after = errors(fitted, evidence)
        held_out = _held_out(
            model, dataset, evidence, mask, hold_out, seed, prior, estimate_with, report
        )
    return Result(
        model=replace(fitted, fixed=model.fixed if partial else ~mask),
        start=model,
        estimate=estimate,
        free=mask,
        before=before,
        after=after,
        held_out=held_out,
        noise=noise_floor(fitted, evidence),
        evidence=evidence,
        dataset=dataset,
        method=method,
        loss=loss,
        refit=tuple(n for n, m in zip(model.table.names, mask, strict=True) if partial and m),
        warnings=(
            *dataset.warnings,
            *_warnings(fitted, estimate, mask),
            *_of_noise(estimate, evidence),
            *_doubts(estimate, dataset, loss),
        ),
    )


def scaled(estimate: Estimate) -> Estimate:
    """The same with sigmas from the residuals, covariance * chi2/dof: all that can be said where
    only the proportions of the noise were given."""
    if estimate.dof <= 0:
        return estimate
    return replace(estimate, covariance=estimate.covariance * estimate.chi2_per_dof)


def single_threaded() -> Any:
    """One BLAS thread: a second one costs more than it brings on matrices this small."""
    from threadpoolctl import threadpool_limits

    return threadpool_limits(limits=1)


def _chosen(
    model: Model, free: Iterable[str], fix: Iterable[str], refit: Iterable[str]
) -> tuple[np.ndarray, bool]:
    """Which parameters are identified, and whether the others keep their covariance."""
    refit, free, fix = tuple(refit), tuple(free), tuple(fix)
    if refit and (free or fix):
        raise FitError("refit names all that is identified: give it no free or fix patterns")
    return (model.table.matching(refit), True) if refit else (_free_mask(model, free, fix), False)


def _free_mask(model: Model, free: Iterable[str], fix: Iterable[str]) -> np.ndarray:
    freed, fixed = model.table.matching(free), model.table.matching(fix)
    own = ~np.asarray(model.fixed)
    both, only_freed, only_fixed = freed & fixed, freed & ~fixed, fixed & ~freed
    if both.any() and only_freed.any() == only_fixed.any():
        names = [n for n, b in zip(model.table.names, both, strict=True) if b]
        raise FitError(f"{', '.join(names)}: both freed and fixed; say which")
    free_is_narrower = both.any() and not only_freed.any()
    mask = (own & ~fixed) | freed if free_is_narrower else (own | freed) & ~fixed
    if not mask.any():
        raise FitError("no parameter is left free; give --free a pattern or fix fewer")
    return np.asarray(mask)


def _check_enough(model: Model, evidence: Evidence, free: np.ndarray, prior: bool | Prior) -> None:
    """A clear word before the numbers fail: too few poses, or all of them the same; with a
    prior one equation is enough."""
    poses, first = np.unique(evidence.group, return_index=True)
    n = len(model.joints)
    moved = [n + i for i in model.mechanism.moved]
    given = evidence.measured[:, moved].sum(axis=1) + np.isfinite(evidence.reading).sum(axis=1)
    equations = np.maximum(model.structure.phi.shape[0] - len(moved) + given, 0)[first]
    carried, most = int(equations.sum()), max(int(equations.max(initial=0)), 1)
    if carried < (1 if prior else free.sum()):
        raise FitError(
            f"{len(poses)} different poses give {carried} equations, but {int(free.sum())} "
            f"parameters are free: measure at least {-(-int(free.sum()) // most)} different "
            "poses (better twice as many), or fix parameters"
        )


def _check_plausible(model: Model, estimate: Estimate, free: np.ndarray) -> None:
    """A small residual bought with an absurd parameter is a failed fit, not a good one."""
    for i, p in enumerate(model.table):
        low, high = p.plausible_range()
        value = model.values[i]
        if free[i] and not low <= value <= high:
            raise FitError(_implausible(p, float(value), estimate.chi2_per_dof))


def _implausible(p: Parameter, value: float, chi2_per_dof: float) -> str:
    low, high = p.plausible_range()
    shown = f"{value:.6g}" if p.unit == "1" else f"{value:.6g} {p.unit}"
    if p.group == "effect":  # what is wrong is the effect, not the file or the units
        plausible = f"({low:.6g} to {high:.6g})"
        return f"{p.name} would have to be {shown}, which is not plausible {plausible}"
    return (
        f"{p.name} went to {shown}, {(value - p.nominal) / p.tolerance:+.1f} tolerances from its "
        f"nominal {p.nominal:.6g} (plausible {low:.6g} to {high:.6g}; chi2/dof "
        f"{chi2_per_dof:.3g}): check units and mechanism, fix the parameter, use priors, or "
        "correct nominal and tolerance in the model file"
    )


def _held_out(
    model: Model,
    dataset: Dataset,
    evidence: Evidence,
    free: np.ndarray,
    fraction: float,
    seed: int,
    prior: bool | Prior,
    estimate_with: Estimator,
    report: Progress,
) -> Errors:
    """Errors at every pose of fits that left it out; NaN where leaving out is not possible."""
    joined = {"position": 3, "orientation": 3, "joint": len(model.joints)}
    joined["reading"] = len(model.structure.channels)
    joined["closure"] = model.structure.phi.shape[0]
    parts = {kind: np.full((len(evidence), size), np.nan) for kind, size in joined.items()}
    folds = dataset.folds(fraction, seed) if fraction > 0 else []
    for k, (train, test) in enumerate(folds):
        report("leaving poses out", 0.2 + 0.8 * k / len(folds))
        try:
            _check_enough(model, evidence.select(train), free, prior)
        except FitError:
            continue
        found = estimate_with(model, evidence.select(train), free)
        judged = errors(model.with_values(found.values), evidence.select(test))
        for kind, array in parts.items():
            array[test] = getattr(judged, kind)
    return Errors(**parts)


def _warnings(model: Model, estimate: Estimate, free: np.ndarray) -> list[str]:
    table = model.table
    moved = (model.values - table.nominal) / table.tolerance
    words = [
        f"{p.name} moved {moved[i]:+.1f} tolerances from nominal"
        for i, p in enumerate(table)
        if free[i] and abs(moved[i]) > FAR
    ]
    unseen = estimate.spectrum.unidentifiable
    words += [f"the data cannot tell {direction_in_words(c, model.mechanism)}" for c in unseen]
    return words


def _of_noise(estimate: Estimate, evidence: Evidence) -> list[str]:
    """Residuals beside the noise that was stated."""
    if evidence.noise_assumed:
        return [
            "noise: assumed, so its proportions alone count: sigmas are from the residuals, and "
            "whether more than noise is left cannot be known"
        ]
    low, high = chi2_band(estimate.dof)
    if estimate.dof > 0 and not low <= estimate.chi2_per_dof <= high:
        size = "larger" if estimate.chi2_per_dof > high else "smaller"
        guessed = [kind for kind, source in evidence.noise_from.items() if source == SCATTER]
        noise = "the stated noise"
        if guessed:  # a robot that comes back shows more than its jitter at rest
            which = " and ".join(guessed)
            noise = f"the jitter within dwells, taken for the {which} noise that nobody stated"
        return [
            f"chi2/dof {estimate.chi2_per_dof:.2f} is outside {low:.2f}..{high:.2f}: the residuals "
            f"are {size} than {noise}"
        ]
    return []


def doubted(estimate: Estimate, dataset: Dataset) -> list[dict[str, Any]]:
    """Samples that a robust loss gave less than half their weight, least trusted first."""
    if estimate.weight is None:
        return []
    order = np.argsort(estimate.weight, kind="stable")
    return [
        {
            "sample": int(dataset.numbers[i]),
            "time": float(dataset.time[i]),
            "weight": float(estimate.weight[i]),
        }
        for i in order
        if estimate.weight[i] < DOUBTED
    ]


def _doubts(estimate: Estimate, dataset: Dataset, loss: str) -> list[str]:
    words = [
        f"{d['sample']} ({d['time']:.1f} s, weight {d['weight']:.2g})"
        for d in doubted(estimate, dataset)
    ]
    return [f"samples down-weighted by loss {loss}: {', '.join(words)}"] if words else []


def chi2_band(dof: int) -> tuple[float, float]:
    """Where chi2/dof lies in 99 % of fits with a complete model (Wilson-Hilferty)."""
    if dof <= 0:
        return (0.0, float("inf"))
    a = 2 / (9 * dof)
    return tuple((1 - a + z * a**0.5) ** 3 for z in (-2.5758, 2.5758))  # type: ignore[return-value]


def finite_or_none(value: float) -> float | None:
    """A number as documents hold it: None where it is not known."""
    return float(value) if np.isfinite(value) else None
