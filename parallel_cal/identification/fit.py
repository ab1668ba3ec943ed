"""Identification: a model and a dataset in, a better model and how far to trust it out."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.identification.checks import check_enough, check_plausible, chosen_parameters
from parallel_cal.identification.doubts import (
    Doubted,
    chi2_band,
    doubted,
    finite_or_none,
    on_held,
    on_noise,
    on_parameters,
    on_samples,
)
from parallel_cal.identification.estimators import Estimator, estimator, need_settling
from parallel_cal.identification.methods.implicit import Estimate
from parallel_cal.identification.noise_floor import noise_floor
from parallel_cal.identification.observations import Observations, observe
from parallel_cal.identification.prediction_errors import Errors, Summary, errors, improvement
from parallel_cal.identification.prior import Prior
from parallel_cal.identification.refit import considered
from parallel_cal.model.model import Model
from parallel_cal.model.words import direction_in_words
from parallel_cal.recordings.dataset import Dataset

Progress = Callable[[str, float], None]


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
    noise: Summary
    observations: Observations
    dataset: Dataset
    method: str
    loss: str = "linear"
    refit: tuple[str, ...] = ()
    warnings: tuple[str, ...] = field(default=())

    @property
    def samples(self) -> int:
        return len(self.observations)

    @cached_property
    def held_out_before(self) -> Errors:
        """Errors of the model before at the poses that `held_out` judges."""
        kinds = ("position", "orientation", "reading")
        judged = np.any([np.isfinite(self.held_out.norms(kind)) for kind in kinds], axis=0)
        return self.before.select(judged)

    @property
    def down_weighted(self) -> tuple[Doubted, ...]:
        """Samples that a robust loss gave less than half their weight."""
        return doubted(self.estimate, self.dataset)

    def document(self) -> dict[str, Any]:
        """The JSON document of `parallel-cal fit`; all values SI, None where not known."""
        before, after = self.before.summary, self.after.summary
        held_before, held_after = self.held_out_before.summary, self.held_out.summary
        return {
            "samples": self.samples,
            "parameters": self.parameters(),
            "before": before.document(),
            "after": after.document(),
            "held_out": {"before": held_before.document(), "after": held_after.document()},
            "improvement": improvement(before, after),
            "improvement_held_out": improvement(held_before, held_after),
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
            "noise_floor": self.noise.document(),
            "noise_from": self.observations.noise_from,
            "method": self.method,
            "loss": self.loss,
            "refit": list(self.refit),
            "down_weighted": [asdict(d) for d in self.down_weighted],
            "iterations": self.estimate.iterations,
            "warnings": list(self.warnings),
            "dataset": {"source": self.dataset.source, "sha256": self.dataset.sha256},
        }

    def _band(self) -> list[float | None]:
        """Where chi2/dof of a complete model lies; nowhere where nobody knows the noise."""
        assumed = self.observations.noise_assumed
        return [None, None] if assumed else list(chi2_band(self.estimate.dof))

    def parameters(self) -> dict[str, dict[str, Any]]:
        """Every parameter by name, as documents hold it."""
        return parameter_rows(self.model, self.estimate.sigma, ~self.free)

    def correlations(self) -> np.ndarray:
        """Correlation matrix (n_free, n_free) of the free parameters."""
        covariance = self.estimate.covariance[np.ix_(self.free, self.free)]
        sigma = np.sqrt(np.diag(covariance))
        return covariance / np.outer(sigma, sigma)


def parameter_rows(model: Model, sigma: np.ndarray, fixed: np.ndarray) -> dict[str, dict[str, Any]]:
    """Every parameter by name, as documents hold it: SI, and moved in tolerances."""
    return {
        p.name: {
            "value": float(model.values[i]),
            "sigma": finite_or_none(sigma[i]),
            "nominal": p.nominal,
            "unit": p.unit,
            "fixed": bool(fixed[i]),
            "moved_tolerances": float((model.values[i] - p.nominal) / p.tolerance),
        }
        for i, p in enumerate(model.table)
    }


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
    mask, partial = chosen_parameters(model, free, fix, refit)
    estimate_with = estimator(method, prior, loss)
    if partial:
        need_settling(method, "a partial re-calibration")
    observations = observe(model, dataset, joint_sigma)
    check_enough(model, observations, mask, prior)
    report("errors before", 0.0)
    before = errors(model, observations)
    report("identifying", 0.1)
    with single_threaded():
        estimate = estimate_with(model, observations, mask)
        if observations.noise_assumed:
            estimate = scaled(estimate)
        if partial:
            estimate = considered(model, observations, mask, estimate)
        fitted = model.with_values(estimate.values, estimate.covariance)
        check_plausible(fitted, estimate, mask)
        after = errors(fitted, observations)
        held_out = _held_out(
            model, dataset, observations, mask, hold_out, seed, prior, estimate_with, report
        )
    noise = noise_floor(fitted, observations)
    return Result(
        model=replace(fitted, fixed=model.fixed if partial else ~mask),
        start=model,
        estimate=estimate,
        free=mask,
        before=before,
        after=after,
        held_out=held_out,
        noise=noise,
        observations=observations,
        dataset=dataset,
        method=method,
        loss=loss,
        refit=tuple(n for n, m in zip(model.table.names, mask, strict=True) if partial and m),
        warnings=(
            *dataset.warnings,
            *on_parameters(fitted, estimate, mask),
            *on_noise(estimate, observations),
            *on_held(fitted, after.summary, noise),
            *on_samples(estimate, dataset, loss),
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


def _held_out(
    model: Model,
    dataset: Dataset,
    observations: Observations,
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
    parts = {kind: np.full((len(observations), size), np.nan) for kind, size in joined.items()}
    folds = dataset.folds(fraction, seed) if fraction > 0 else []
    for k, (train, test) in enumerate(folds):
        report("leaving poses out", 0.2 + 0.8 * k / len(folds))
        try:
            check_enough(model, observations.select(train), free, prior)
        except FitError:
            continue
        found = estimate_with(model, observations.select(train), free)
        judged = errors(model.with_values(found.values), observations.select(test))
        for kind, array in parts.items():
            array[test] = getattr(judged, kind)
    return Errors(**parts)
