"""Estimate the noise that a diagnosis judges by: stated, or measured by replicates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parallel_cal.base.confidence import SIGNIFICANCE_LEVEL
from parallel_cal.diagnosis.field import Field
from parallel_cal.diagnosis.region import is_of_touches
from parallel_cal.diagnosis.thresholds import REPLICATE_CONTRADICTION_LEVEL
from parallel_cal.identification.fit import FitResult
from parallel_cal.identification.fit_warnings import chi2_band
from parallel_cal.identification.image_poses import IMAGE_SCATTER
from parallel_cal.identification.thresholds import MIN_DOF
from parallel_cal.posterior.scene import Scene
from parallel_cal.recordings.replicates import subtract_visits_mean

# The noise of images was measured without the robot's model, so it counts as stated.
STATED = ("option", "dataset", "model file", IMAGE_SCATTER)


@dataclass(frozen=True)
class PureError:
    """Mean square of replicates about their mean, in units of the observations' variance, and its
    degrees of freedom; None without replicates.

    The part that depends linearly on the conditions of a visit is not measurement noise and is
    removed.
    """

    variance: float | None
    dof: int

    @property
    def contradicts_stated_noise(self) -> bool:
        """Whether replicates differ significantly from the stated noise."""
        from scipy.special import chdtr, chdtrc

        if self.variance is None or self.dof < MIN_DOF:
            return False
        squares = self.variance * self.dof
        return bool(
            min(chdtr(self.dof, squares), chdtrc(self.dof, squares))
            < REPLICATE_CONTRADICTION_LEVEL / 2
        )

    @classmethod
    def of(cls, scene: Scene, field: Field) -> PureError:
        """Estimate from replicates of poses or of what sensors read; without either they cannot be
        distinguished from neighbours."""
        read = np.isfinite(scene.reading_residuals).any()
        if scene.dataset.mode == "continuous" or not (field.measured.any() or read):
            return cls(None, 0)
        squares, dof = 0.0, 0
        for z in field.noise_units.T:
            known = np.flatnonzero(z)  # what was not measured is exactly zero
            visits = scene.observations.group[known]
            conditions = {name: c[known] for name, c in scene.dataset.conditions.items()}
            apart, own = subtract_visits_mean(z[known, None], visits, conditions)
            squares, dof = squares + float(np.sum(apart**2)), dof + own
        return cls(squares / dof if dof else None, dof)


@dataclass(frozen=True)
class NoiseLevel:
    """The noise that a diagnosis judges by, which must not come from the fit.

    `variance` is in units of the observations' noise, None if unknown; `dof` are its degrees of
    freedom, None if it is stated; `source` says where it comes from; `pure_error` is the estimate
    from replicates; `misstated` is the ratio to the stated noise if replicates contradict it.
    Without a stated noise it is the ratio to the jitter within dwells (`from_jitter`), if
    replicates differ by more.
    """

    variance: float | None
    dof: int | None
    source: str
    pure_error: PureError
    misstated: float | None = None
    from_jitter: bool = False

    @classmethod
    def of(
        cls, scene: Scene, field: Field, structured: bool, correlated: bool = False
    ) -> NoiseLevel:
        """Use the stated noise unless replicates contradict it; use replicates instead of a guess
        from jitter.

        A smaller noise than stated is accepted unless neighbours in time are similar: visits soon
        after each other then share their noise. A larger one is accepted only if the residuals
        show no structure: motion between two visits of a pose would pass for noise.
        """
        seen = PureError.of(scene, field)
        sources = set(scene.observations.noise_from.values())
        if sources <= set(STATED):
            variance = seen.variance if seen.contradicts_stated_noise else None
            if variance is None or (structured if variance > 1 else correlated):
                return cls(1.0, None, f"stated ({', '.join(sorted(sources))})", seen)
            words = f"replicates ({seen.dof} degrees of freedom)"
            return cls(variance, seen.dof, words, seen, variance**0.5)
        if seen.variance is not None and seen.dof >= MIN_DOF:
            words = f"replicates ({seen.dof} degrees of freedom)"
            return cls(seen.variance, seen.dof, words, seen, *_compare_with_jitter(scene))
        return cls(None, None, f"unknown ({', '.join(sorted(sources))})", seen)

    @property
    def is_exceeded(self) -> bool:
        """Whether visits of one pose differ by more than the noise that the fit used."""
        return self.misstated is not None and self.misstated > 1

    @property
    def used(self) -> str:
        """The noise that the fit used, in words."""
        return "the jitter within dwells" if self.from_jitter else "the stated noise"

    def count_testing_dof(self, dof: int) -> int:
        """Count the degrees of freedom of a fit that can show an error of the model: those of
        replicates only show the noise."""
        return dof - (self.dof or 0)

    def band(self, dof: int) -> tuple[float, float]:
        """Band that holds chi2/dof of 99 % of complete models; infinite if the noise is unknown.

        Replicates are samples of the fit, so their scatter is a part of chi2. Only the rest, with
        dof - self.dof degrees of freedom, is independent of it: rest / scatter is F-distributed.
        """
        from scipy.special import fdtri

        if self.variance is None or dof <= 0:
            return (0.0, float("inf"))
        if self.dof is None:
            return chi2_band(dof)
        rest = self.count_testing_dof(dof)
        if rest <= 0:
            return (0.0, float("inf"))
        low, high = (
            (rest * float(fdtri(rest, self.dof, p)) + self.dof) / dof
            for p in (SIGNIFICANCE_LEVEL / 2, 1 - SIGNIFICANCE_LEVEL / 2)
        )
        return low * self.variance, high * self.variance


def _compare_with_jitter(scene: Scene) -> tuple[float | None, bool]:
    """By how many times visits of a pose differ more than samples within a dwell, if they do, and
    whether this scatter is known."""
    at_rest = scene.observations.at_rest
    if at_rest is None:
        return None, False
    resting = Scene.of(scene.model, scene.dataset, at_rest, scene.free, within=scene.within)
    seen = PureError.of(resting, Field.of(resting))
    ratio = (seen.variance or 0.0) ** 0.5
    return (ratio if seen.contradicts_stated_noise and ratio > 1 else None), True


def advise_on_noise(result: FitResult, revisits: int) -> str:
    """Say how an owner finds out what noise was not stated; `revisits` are too few to show it."""
    dataset, sensors = result.dataset, {sensor.name for sensor in result.model.sensors}
    again, one = ("touch", "point") if is_of_touches(dataset) else ("visit", "pose")
    places = {
        f"`sigma` of its sensor {kind.name}" if kind.name in sensors else "`noise`"
        for kind in result.observations.unknown
    }
    return (
        f"to learn whether anything is left, {again} {max(MIN_DOF - revisits, 1)} "
        f"{one}s or more a second time, or measure one {one} ten times and state the standard "
        f"deviation in the model file ({' and '.join(sorted(places)) or '`noise`'}); then diagnose "
        "again"
    )
