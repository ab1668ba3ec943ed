"""Find single samples that contradict all others, such as those at which a target slipped."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from parallel_cal.base.errors import FitError
from parallel_cal.base.sample_names import format_sample
from parallel_cal.base.units import LARGE_UNITS
from parallel_cal.identification.checks import chosen_parameters
from parallel_cal.identification.estimate import Estimate
from parallel_cal.identification.linearisation import Linearisation, System, rms_by_sample
from parallel_cal.identification.methods import implicit
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.options import FitOptions
from parallel_cal.identification.prior import Prior
from parallel_cal.identification.robust import LOSSES
from parallel_cal.identification.thresholds import (
    MAX_OUTLIER_SHARE,
    MAX_REPETITIONS,
    MIN_OUTLIER_RATIO,
    MIN_OUTSTANDING_RATIO,
    REWEIGHTINGS,
)
from parallel_cal.model.model import Model
from parallel_cal.model.words import join_words
from parallel_cal.recordings.dataset import DESCRIPTIVE, Dataset


def find_outliers(
    residual: np.ndarray, columns: np.ndarray, informative: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Find samples whose residual no change of the parameters explains as well as it explains the
    others, by a robust linear regression (iterative reweighting with the loss `cauchy`).

    A fit of least squares follows an outlier: its own residual becomes small, and that of others
    large. It is still the largest, so the regression begins with weights by the given residuals,
    first of `huber`, which has a single solution.

    Parameters
    ----------
    residual : array (N, rows)
        Whitened residuals of a fit.
    columns : array (N, rows, p)
        Their derivatives by the parameters, in any units.
    informative : array (N,)
        Number of independent rows of each sample.

    Returns
    -------
    outliers : array (n,) of int
        Indices of the outliers; none if they are more than a few.
    sizes : array (N,)
        Rms residual of each sample after the regression, in units of the typical one.
    """
    p, sizes = columns.shape[2], _relative_sizes(residual, informative)
    if sizes.max(initial=0.0) <= MIN_OUTSTANDING_RATIO:
        return np.zeros(0, dtype=int), sizes
    for round_ in range(REWEIGHTINGS):
        loss = LOSSES["huber" if round_ < REWEIGHTINGS // 2 else "cauchy"]
        weight = loss(sizes) ** 2
        normal = np.einsum("nki,n,nkj->ij", columns, weight, columns, optimize=True)
        gradient = np.einsum("nki,n,nk->i", columns, weight, residual, optimize=True)
        grain = 1e-12 * max(np.trace(normal), 1e-300) / max(p, 1)
        step = np.linalg.solve(normal + grain * np.eye(p), gradient)
        sizes = _relative_sizes(residual - columns @ step, informative)
    found = np.flatnonzero(sizes > MIN_OUTLIER_RATIO)
    few = len(found) <= max(1, MAX_OUTLIER_SHARE * len(residual))
    return found if few else found[:0], sizes


@dataclass(frozen=True)
class Outliers:
    """Samples that contradict all others.

    `sizes` are their rms residuals from a fit to the others, in units of the rms residual there;
    `values` are those that `describe_far_values` names. `chi2_per_dof` is that of a fit to all
    samples, and of the fit to the others.
    """

    numbers: tuple[int, ...]
    titles: tuple[str, ...]
    sizes: tuple[float, ...]
    values: tuple[str, ...]
    chi2_per_dof: tuple[float, float]

    @property
    def description(self) -> str:
        named = join_words(
            f"sample {title} ({size:.0f} times the usual residual{value and '; '}{value})"
            for title, size, value in zip(self.titles, self.sizes, self.values, strict=True)
        )
        them, verb = ("it", "contradicts") if len(self.numbers) == 1 else ("them", "contradict")
        every, others = (f"{chi2:.3g}" for chi2 in self.chi2_per_dof)
        return (
            f"{named} {verb} all others: without {them}, chi2/dof is {others}, and with {them} "
            f"{every}. Check {them}, or exclude {them}: --data "
            f"exclude={','.join(map(str, self.numbers))}"
        )


def describe_far_values(dataset: Dataset) -> dict[int, str]:
    """Describe the measured values that lie far outside those of most samples, such as the -9999 of
    a device that saw nothing: `z -9999 mm, others 20.1 to 179 mm`, by the number of the sample.

    Their distance from the quartiles is at least MIN_OUTLIER_RATIO times that between them.
    """
    units = dataset.joint_units or ("",) * len(dataset.joint_names)
    columns = [*zip(dataset.joint_names, units, dataset.q.T, strict=True)]
    for axis, values, known in zip("xyz", dataset.r.T, dataset.measured.T[:3], strict=True):
        columns.append((axis, "m", np.where(known, values, np.nan)))
    found = dict[int, list[str]]()
    for name, unit, values in columns:
        known = np.isfinite(values)
        low, high = np.quantile(values[known], [0.25, 0.75]) if known.any() else (0.0, 0.0)
        far = np.maximum(low - values, values - high) > MIN_OUTLIER_RATIO * (high - low)
        if not far.any() or low == high:
            continue
        shown, factor = LARGE_UNITS.get(unit, (unit, 1.0))
        usual = factor * values[known & ~far]
        others = f"others {usual.min():.6g} to {usual.max():.6g} {shown}".rstrip()
        for i in np.flatnonzero(far).tolist():
            own = f"{name} {factor * values[i]:.6g} {shown}".rstrip()
            found.setdefault(int(dataset.numbers[i]), []).append(f"{own}, {others}")
    return {number: "; ".join(words) for number, words in found.items()}


def may_hide_in_noise(observations: Observations, dataset: Dataset) -> bool:
    """Whether values far outside those of most samples may hide in the noise, which was estimated
    with them: it is as large as they are, so that none of them contradicts the others."""
    return observations.noise_assumed and bool(describe_far_values(dataset))


def _find_in(system: System) -> np.ndarray:
    return find_outliers(system.residual, system.jacobian, system.informative)[0]


def _relative_sizes(residual: np.ndarray, informative: np.ndarray) -> np.ndarray:
    """Rms residual of each sample, in units of the typical one."""
    sizes = rms_by_sample(residual, informative)
    known = sizes[informative > 0]
    return np.asarray(sizes / max(float(np.median(known)) if len(known) else 0.0, 1e-300))


def are_separated(dataset: Dataset, numbers: Collection[int]) -> bool:
    """Whether a recorded condition separates several samples from all others, such as a payload
    that only they carry: then they show an effect of it rather than a mistake."""
    mine = np.isin(dataset.numbers, list(numbers))
    if np.count_nonzero(mine) < 2 or mine.all():
        return False
    for name, values in dataset.conditions.items():
        if name.startswith(DESCRIPTIVE):
            continue
        own, others = values[mine], values[~mine]
        is_level = np.ptp(own) == 0 and not np.any(others == own[0])
        if is_level or own.min() > others.max() or own.max() < others.min():
            return True
    return False


def search_outliers(
    model: Model,
    dataset: Dataset,
    observations: Observations,
    options: FitOptions,
    known: Estimate | None = None,
) -> Outliers | None:
    """Search outliers, and confirm them by a fit to the others; None if there are none, if the
    samples are a continuous motion, or if the options select a robust loss or another method.
    `known` is the estimate of all samples, if it is known.

    Only samples count that are far from what the fit to the others predicts, and that no recorded
    condition separates from the others.
    """
    if dataset.mode == "continuous" or (options.method, options.loss) != ("implicit", "linear"):
        return None
    if known is not None:
        sizes = _relative_sizes(known.residuals, known.informative)
        if sizes.max(initial=0.0) <= MIN_OUTSTANDING_RATIO:
            return None
    (free, _), prior = chosen_parameters(model, options), options.prior
    linearise = Linearisation(model, observations, free, True)
    # Gross mistakes, such as a flipped orientation, drag a fit of least squares far away: search
    # where it starts, too.
    at_start = linearise(model.values, linearise.start())
    try:
        every = implicit.estimate(model, observations, free, prior)
    except FitError:
        return None
    for system in (at_start, every.system):
        if not isinstance(system, System):  # too many samples to keep the derivatives
            continue
        found = _confirm(_find_in(system), model, observations, free, prior)
        numbers = [int(dataset.numbers[i]) for i in found.samples] if found else []
        if found and not are_separated(dataset, numbers):
            titles = tuple(format_sample(one, dataset.names.get(one, "")) for one in numbers)
            far = describe_far_values(dataset)
            values = tuple(far.get(one, "") for one in numbers)
            both = every.chi2_per_dof, found.chi2_per_dof
            return Outliers(tuple(numbers), titles, found.sizes, values, both)
    return None


@dataclass(frozen=True)
class _Confirmed:
    """Indices of samples, their sizes as in `Outliers`, and chi2/dof of the fit to the others."""

    samples: np.ndarray
    sizes: tuple[float, ...]
    chi2_per_dof: float


def _confirm(
    found: np.ndarray,
    model: Model,
    observations: Observations,
    free: np.ndarray,
    prior: bool | Prior | None,
) -> _Confirmed | None:
    """Fit the others, until the same samples are far from the fit that does not use them."""
    for _ in range(MAX_REPETITIONS):
        if not 0 < len(found) <= max(1, MAX_OUTLIER_SHARE * len(observations)):
            return None
        kept = np.setdiff1d(np.arange(len(observations)), found)
        try:
            others = implicit.estimate(model, observations.select(kept), free, prior)
        except FitError:
            return None
        assert isinstance(others.system, System)
        if len(more := _find_in(others.system)):  # that were hidden by the first ones
            found = np.union1d(found, kept[more])
            continue
        at = Linearisation(model, observations.select(found), free, True)
        away = at(others.values, at.start())
        sizes = rms_by_sample(away.residual, away.informative)
        sizes /= max(others.chi2_per_dof, 1e-300) ** 0.5
        far = sizes > MIN_OUTLIER_RATIO
        if far.all():
            return _Confirmed(found, tuple(sizes.tolist()), others.chi2_per_dof)
        found = found[far]
    return None
