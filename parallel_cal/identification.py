"""Identification: a model and a dataset in, a better model and how far to trust it out."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from importlib import import_module
from typing import Any

import numpy as np

from parallel_cal.accuracy import Errors, errors, improvement, noise_floor
from parallel_cal.dataset import Dataset
from parallel_cal.errors import FitError
from parallel_cal.evidence import Evidence, gather
from parallel_cal.mechanism import shelf_names
from parallel_cal.methods.implicit import Estimate
from parallel_cal.model import Model
from parallel_cal.observability import in_words

Progress = Callable[[str, float], None]
FAR = 5.0  # tolerances: a parameter that moved further deserves a word


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
            "chi2_per_dof": _number(self.estimate.chi2_per_dof),
            "chi2_band": list(chi2_band(self.estimate.dof)),
            "dof": self.estimate.dof,
            "rank": self.estimate.spectrum.rank,
            "free": int(self.free.sum()),
            "unidentifiable": [
                {"text": in_words(c), "parameters": c}
                for c in self.estimate.spectrum.unidentifiable
            ],
            "weak": [{"text": in_words(c), "parameters": c} for c in self.estimate.spectrum.weak],
            "noise_floor": self.noise,
            "noise_from": self.evidence.noise_from,
            "method": self.method,
            "iterations": self.estimate.iterations,
            "warnings": list(self.warnings),
            "dataset": {"source": self.dataset.source, "sha256": self.dataset.sha256},
        }

    def _held_out_before(self) -> dict[str, float | None]:
        judged = np.isfinite(self.held_out.norms("position")) | np.isfinite(
            self.held_out.norms("orientation")
        )
        return self.before.select(judged).document()

    def _parameters(self) -> dict[str, dict[str, Any]]:
        table, sigma = self.model.table, self.estimate.sigma
        return {
            p.name: {
                "value": float(self.model.values[i]),
                "sigma": _number(sigma[i]) if self.free[i] else 0.0,
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
    hold_out: float = 0.25,
    joint_sigma: float | None = None,
    prior: bool = False,
    seed: int = 0,
    progress: Progress | None = None,
) -> Result:
    """Identify a model's free parameters; errors at poses that the fit did not see.

    `free` and `fix` are name patterns (`chain1.*`) that change what the model file says; where
    one set lies inside the other the narrower wins (`fix=["*"], free=["chain1.Lb"]`). FitError
    where the data cannot carry it.
    """
    report = progress or (lambda stage, fraction: None)
    mask = _free_mask(model, free, fix)
    evidence = gather(model, dataset, joint_sigma)
    _check_enough(model, evidence, mask)
    report("errors before", 0.0)
    before = errors(model, evidence)
    estimator = method_named(method)
    report("identifying", 0.1)
    with single_threaded():
        estimate = estimator(model, evidence, mask, prior=prior)
        fitted = model.with_values(estimate.values, estimate.covariance)
        _check_plausible(fitted, estimate, mask)
        after = errors(fitted, evidence)
        held_out = _held_out(
            model, dataset, evidence, mask, hold_out, seed, prior, estimator, report
        )
    return Result(
        model=replace(fitted, fixed=~mask),
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
        warnings=(*dataset.warnings, *_warnings(fitted, estimate, mask)),
    )


def method_named(name: str) -> Callable[..., Estimate]:
    """The `estimate` function of parallel_cal/methods/<name>.py."""
    if name not in shelf_names("methods"):
        raise FitError(f"no method '{name}'; there are {', '.join(shelf_names('methods'))}")
    return import_module(f"parallel_cal.methods.{name}").estimate  # type: ignore[no-any-return]


def single_threaded() -> Any:
    """One BLAS thread: a second one costs more than it brings on matrices this small."""
    from threadpoolctl import threadpool_limits

    return threadpool_limits(limits=1)


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


def _check_enough(model: Model, evidence: Evidence, free: np.ndarray) -> None:
    """A clear word before the numbers fail: too few poses, or all of them the same."""
    poses, first = np.unique(evidence.group, return_index=True)
    n = len(model.joints)
    moved = [n + i for i in model.mechanism.moved]
    given = evidence.measured[:, moved].sum(axis=1) + np.isfinite(evidence.reading).sum(axis=1)
    equations = np.maximum(model.structure.phi.shape[0] - len(moved) + given, 0)[first]
    carried, most = int(equations.sum()), max(int(equations.max(initial=0)), 1)
    if carried < free.sum():
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
            raise FitError(
                f"{p.name} went to {value:.6g} {p.unit}, {(value - p.nominal) / p.tolerance:+.1f} "
                f"tolerances from its nominal {p.nominal:.6g} (plausible {low:.6g} to {high:.6g}; "
                f"chi2/dof {estimate.chi2_per_dof:.3g}): check units and mechanism, fix the "
                "parameter, use priors, or correct nominal and tolerance in the model file"
            )


def _held_out(
    model: Model,
    dataset: Dataset,
    evidence: Evidence,
    free: np.ndarray,
    fraction: float,
    seed: int,
    prior: bool,
    estimator: Callable[..., Estimate],
    report: Progress,
) -> Errors:
    """Errors at every pose of fits that left it out; NaN where leaving out is not possible."""
    joined = {"position": 3, "orientation": 3, "joint": len(model.joints)}
    parts = {kind: np.full((len(evidence), size), np.nan) for kind, size in joined.items()}
    folds = dataset.folds(fraction, seed) if fraction > 0 else []
    for k, (train, test) in enumerate(folds):
        report("leaving poses out", 0.2 + 0.8 * k / len(folds))
        try:
            _check_enough(model, evidence.select(train), free)
        except FitError:
            continue
        found = estimator(model, evidence.select(train), free, prior=prior)
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
    words += [f"the data cannot tell {in_words(c)}" for c in estimate.spectrum.unidentifiable]
    low, high = chi2_band(estimate.dof)
    if estimate.dof > 0 and not low <= estimate.chi2_per_dof <= high:
        size = "larger" if estimate.chi2_per_dof > high else "smaller"
        words.append(
            f"chi2/dof {estimate.chi2_per_dof:.2f} is outside {low:.2f}..{high:.2f}: the residuals "
            f"are {size} than the stated noise"
        )
    return words


def chi2_band(dof: int) -> tuple[float, float]:
    """Where chi2/dof lies in 99 % of fits with a complete model (Wilson-Hilferty)."""
    if dof <= 0:
        return (0.0, float("inf"))
    a = 2 / (9 * dof)
    return tuple((1 - a + z * a**0.5) ** 3 for z in (-2.5758, 2.5758))  # type: ignore[return-value]


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


@dataclass(frozen=True)
class Comparison:
    """A model beside measurements: errors a sample, and what noise alone would show."""

    model: Model
    dataset: Dataset
    evidence: Evidence
    errors: Errors
    noise: dict[str, float | None]

    def document(self) -> dict[str, Any]:
        """E and one row a sample, worst first."""
        return {
            **self.errors.document(),
            "noise_floor": self.noise,
            "samples": len(self.evidence),
            "rows": [self._row(i) for i in self._worst_first()],
        }

    def _worst_first(self) -> np.ndarray:
        norms = self.errors.norms("position")
        if not np.isfinite(norms).any():
            norms = self.errors.norms("orientation")
        return np.argsort(-np.nan_to_num(norms, nan=-1.0), kind="stable")

    def _row(self, i: int) -> dict[str, Any]:
        n = len(self.model.joints)
        parts = {
            kind: getattr(self.errors, kind)[i] for kind in ("position", "orientation", "joint")
        }
        return {
            "sample": int(i),
            "time": float(self.dataset.time[i]),
            "joints": self.evidence.x[i, :n].tolist(),
            "position": self.evidence.x[i, n : n + 3].tolist(),
            **{f"{k}_error": [_number(v) for v in part] for k, part in parts.items()},
            **{f"{k}_norm": _number(float(np.linalg.norm(part))) for k, part in parts.items()},
        }


def compare(model: Model, dataset: Dataset, joint_sigma: float | None = None) -> Comparison:
    """Predictions of a model beside what was measured, fitting nothing."""
    evidence = gather(model, dataset, joint_sigma)
    with single_threaded():
        return Comparison(
            model, dataset, evidence, errors(model, evidence), noise_floor(model, evidence)
        )
