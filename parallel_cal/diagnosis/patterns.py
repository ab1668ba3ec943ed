"""Find where a model fails: residuals along every recorded quantity, and odd samples."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from parallel_cal.base.confidence import SIGMAS_AT_SIGNIFICANCE_LEVEL
from parallel_cal.base.sample_names import format_sample
from parallel_cal.base.units import MM
from parallel_cal.causes.knocks import find_sideless_samples
from parallel_cal.diagnosis.field import Field
from parallel_cal.diagnosis.lack_of_fit import find_varying_coordinates, regressors
from parallel_cal.diagnosis.statistics import normal_below, runs_test
from parallel_cal.diagnosis.thresholds import (
    LEVELS,
    MAX_PROFILE_POINTS,
    MAX_WINDOWS,
    MIN_INFLUENTIAL_COOKS_DISTANCE,
    OUTLIER_SIGNIFICANCE_LEVEL,
    WINDOW,
)
from parallel_cal.identification.observations import Observations, conditions
from parallel_cal.identification.outliers import describe_far_values
from parallel_cal.model.model import Model
from parallel_cal.model.words import join_words
from parallel_cal.posterior.scene import Scene
from parallel_cal.recordings.dataset import Dataset

KNOCKED = "far from all others, as if somebody knocked the device"
MIN_SHOWN_MM = 1e-9
SIDELESS = "a sample of which the sides from which the joints came are not known"


@dataclass(frozen=True)
class ResidualProfile:
    """The rolling mean (m, k) of each residual component at values (m,) of a regressor, and half
    of its 99 % band (m,), in noise units.

    `strength` is the largest mean in units of its own uncertainty, `p_value` the chance of one as
    large among so many.
    """

    name: str
    at: np.ndarray
    mean: np.ndarray
    band: np.ndarray
    strength: float
    p_value: float
    runs_p_value: float


def compute_residual_profiles(scene: Scene, field: Field) -> tuple[ResidualProfile, ...]:
    """The residuals along every regressor, most striking first."""
    entries = [
        compute_mean_profile(name, values, field.noise_units) for name, values in regressors(scene)
    ]
    return tuple(sorted(entries, key=lambda entry: -entry.strength))


def compute_mean_profile(name: str, values: np.ndarray, z: np.ndarray) -> ResidualProfile:
    """The rolling mean of z (N, k) along values (N,); a mean for each of a few levels."""
    order = np.argsort(values, kind="stable")
    levels = np.unique(values)
    if len(levels) <= LEVELS:  # as direction or payload: a mean for each level, nothing rolls
        means = np.array([z[values == level].mean(axis=0) for level in levels])
        count = np.array([np.count_nonzero(values == level) for level in levels])
        at = levels
    else:
        window = min(max(WINDOW, len(z) // MAX_WINDOWS), max(3, len(z) // 4))
        means, at = _rolling(z[order], window), _rolling(values[order][:, None], window)[:, 0]
        count = np.full(len(means), window)
    scale = np.maximum(z.std(axis=0), 1e-12)
    each = np.abs(means) / scale * np.sqrt(count)[:, None]
    strength = float(each.max(initial=0.0))
    p_value = min(1.0, 2 * each.size * normal_below(-strength))
    band = SIGMAS_AT_SIGNIFICANCE_LEVEL / np.sqrt(count)
    # Neighbouring rolling means share most of their samples: of many, some show the same course.
    few = np.unique(np.linspace(0, len(at) - 1, min(len(at), MAX_PROFILE_POINTS)).astype(int))
    return ResidualProfile(
        name, at[few], means[few], band[few], strength, p_value, runs_test(z[order])
    )


def _rolling(values: np.ndarray, window: int) -> np.ndarray:
    sums = np.cumsum(np.vstack([np.zeros((1, values.shape[1])), values]), axis=0)
    return np.asarray((sums[window:] - sums[:-window]) / window)


@dataclass(frozen=True)
class Region:
    """Errors (rms of norms, mean; m and rad) in an octant of the workspace about its `middle`; a
    quarter where all was measured at one height."""

    region: str
    middle: np.ndarray
    samples: int
    position_rms: float
    orientation_rms: float
    reading_rms: float
    position_bias: np.ndarray


def regions(scene: Scene, field: Field) -> tuple[Region, ...]:
    """The eight octants of the measured workspace, worst first."""
    n = len(scene.model.joints)
    places, apart = scene.x[:, n : n + 3], find_varying_coordinates(scene)[n:]
    middle = np.median(places, axis=0)
    octant = ((places > middle) & apart) @ np.array([1, 2, 4])
    kinds = (field.pose[:, :3], field.pose[:, 3:], np.nan_to_num(scene.length_residuals))
    found = []
    for o in np.unique(octant):
        here = octant == o
        sides = [f"{axis}{'>' if o >> k & 1 else '<'}" for k, axis in enumerate("xyz") if apart[k]]
        place, turn, read = (float(np.sqrt(np.mean(np.sum(e[here] ** 2, axis=1)))) for e in kinds)
        bias, n = field.pose[here, :3].mean(axis=0), int(here.sum())
        found.append(Region(" ".join(sides), middle, n, place, turn, read, bias))
    return tuple(sorted(found, key=lambda r: -(r.position_rms + r.orientation_rms + r.reading_rms)))


@dataclass(frozen=True)
class OddSample:
    """A sample that is an outlier, or without which the geometry would be another.

    `sigmas` is its rms residual in sigmas of the noise, as Scene.sigmas. `p_value` is the chance of
    one as large in a whole data set, if the noise is as large as the typical residual. `leverage`
    is the share of the geometry's freedoms that it alone decides; position_error (3,) in m;
    `place` (3,) m where the model puts the platform. `time` is NaN if it was not recorded. It is
    `sideless` if other samples have sides from which their joints came, and it has none.
    """

    sample: int
    time: float
    sigmas: float
    p_value: float
    outlier: bool
    cooks_distance: float
    leverage: float
    position_error: np.ndarray
    place: np.ndarray
    name: str = ""
    sideless: bool = False

    @property
    def title(self) -> str:
        """Its number, and its name if it has one."""
        return format_sample(self.sample, self.name)

    @property
    def size(self) -> str:
        """Its residual in words: `19 sigmas of the noise, 0.324 mm`; without a length where no
        position was measured."""
        size = np.linalg.norm(self.position_error) / MM
        length = f", {size:.3g} mm" if size > MIN_SHOWN_MM else ""
        return f"{self.sigmas:.0f} sigmas of the noise{length}"

    @property
    def label(self) -> str:
        return "outlier" if self.outlier else "influential"


def odd_samples(scene: Scene, field: Field, also: Collection[int] = ()) -> tuple[OddSample, ...]:
    """Find outliers and influential samples, largest residual first; `also` those of these numbers.

    For p_value, the typical residual serves as the noise. An outlier's squared residual would occur
    once in a thousand data sets. A Cook's distance above 1 moves the estimate by about its sigma.
    """
    from scipy.special import chdtrc

    n, blocks = len(scene.model.joints), scene.by_sample(scene.residual)
    sideless = find_sideless_samples(scene.dataset)
    k = max(1, round(scene.dof / max(len(blocks), 1)))
    squared = np.sum(blocks**2, axis=1)
    scale = np.median(squared) / max(k - 2 / 3, 0.3)  # median of a chi-square is about k - 2/3
    leverage = np.sum(scene.by_sample(np.sum(scene.basis**2, axis=1)), axis=1)
    p = chdtrc(k, squared / max(scale, 1e-300)) * len(blocks)
    cook = squared * leverage / max(scene.basis.shape[1] * scene.chi2_per_dof, 1e-300)
    odd = [
        OddSample(
            sample=int(scene.dataset.numbers[i]),
            time=float(scene.dataset.time[i]) if scene.dataset.has_time else math.nan,
            sigmas=float(scene.sigmas[i]),
            p_value=float(min(p[i], 1.0)),
            outlier=bool(p[i] < OUTLIER_SIGNIFICANCE_LEVEL),
            cooks_distance=float(cook[i]),
            leverage=float(leverage[i]),
            position_error=field.pose[i, :3],
            place=scene.x[i, n : n + 3],
            name=scene.dataset.names.get(int(scene.dataset.numbers[i]), ""),
            sideless=int(scene.dataset.numbers[i]) in sideless,
        )
        for i in np.flatnonzero(
            (p < OUTLIER_SIGNIFICANCE_LEVEL)
            | (cook > MIN_INFLUENTIAL_COOKS_DISTANCE)
            | np.isin(scene.dataset.numbers, list(also))
        )
    ]
    return tuple(sorted(odd, key=lambda one: -one.sigmas))


def explain_exclusion(dataset: Dataset, samples: Iterable[int]) -> str:
    """Say why samples are excluded: nothing is known of their sides, or they are far away."""
    return SIDELESS if set(samples) <= find_sideless_samples(dataset) else KNOCKED


def list_samples_far_from(
    model: Model, dataset: Dataset, observations: Observations, numbers: Collection[int]
) -> list[OddSample]:
    """List some samples with their residuals from a model that was not fitted to them."""
    fixed = np.zeros(len(model.values), dtype=bool)  # no parameter follows the samples
    scene = Scene.of(model, dataset, replace(observations, a=conditions(model, dataset)), fixed)
    odd = odd_samples(scene, Field.of(scene), numbers)
    return [one for one in odd if one.sample in numbers]


def find_innocent_samples(far: Iterable[OddSample], numbers: Iterable[int]) -> frozenset[int]:
    """Find those of the samples of these numbers that are no outliers of a model which was not
    fitted to them: only about another model, without effects, they seemed to be disturbed. Of a
    sample without sides, the model predicts nothing."""
    guilty = {one.sample for one in far if one.outlier or one.sideless}
    return frozenset(numbers) - guilty


def describe_knocked_samples(knocked: Sequence[OddSample], dataset: Dataset) -> str:
    """Name the samples of a dataset that a verdict leaves out, to be put behind it."""

    far = {number: f"; {values}" for number, values in describe_far_values(dataset).items()}

    def names(samples: Sequence[OddSample]) -> str:
        return join_words(
            f"sample {one.title} ({one.size}{far.get(one.sample, '')})" for one in samples
        )

    sentences = []
    if sideless := [one for one in knocked if one.sideless]:
        whose, them = ("their", "them") if len(sideless) > 1 else ("its", "it")
        sentences.append(
            f"Not used: {names(sideless)}: from which sides {whose} joints came is not known, so "
            f"exclude {them}"
        )
    if others := [one for one in knocked if not one.sideless]:
        verb, them = ("are", "them") if len(others) > 1 else ("is", "it")
        sentences.append(
            f"Not used: {names(others)}, which {verb} far from what all others show, as if "
            f"somebody knocked the device. Check {them}, or exclude {them}"
        )
    return ". ".join(sentences)
