"""A factor that all identified lengths of a robot have in common, against those of its drawing.

Angles of joints and pixels of an image contain no length. If a camera measures a robot with
revolute joints, all its lengths follow from one stated length, the side of the board's squares. A
robot whose lengths all differ from the drawing by one factor was measured with a board of another
size.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parallel_cal.base.confidence import EQUAL_EVIDENCE
from parallel_cal.base.errors import FitError
from parallel_cal.identification.methods import implicit
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.prior import Prior
from parallel_cal.identification.thresholds import (
    MAX_UNSCALED_SHARE,
    MIN_COMMON_SCALE,
    MIN_SCALED_LENGTHS,
    UNKNOWN_TOLERANCES,
)
from parallel_cal.model.model import Model
from parallel_cal.model.sensor import Sensor


@dataclass(frozen=True)
class CommonScale:
    """By how much (relative, with its standard deviation) the robot is larger than its drawing, if
    the length that a sensor states is right."""

    excess: float
    sigma: float
    sensor: Sensor

    @classmethod
    def find(cls, model: Model, observations: Observations, free: np.ndarray) -> CommonScale | None:
        """Find a common factor of an identified model that contradicts the drawing; None if there
        is none, or if no sensor states a length that the fit keeps.

        A second fit identifies the stated length, too. The tolerances of all other parameters are
        its prior, except those of the places of the sensor's parts, which grow with the robot.
        """
        own = free & (np.arange(len(free)) < len(model.mechanism.parameters))
        shared, _, lengths = _fit_scale(model, own)
        # Where joints read lengths, the data may hold the others near nominal.
        least = 0.0 if "m" in model.mechanism.joint_units else MIN_COMMON_SCALE
        if not lengths or abs(shared) < least:
            return None
        for sensor in model.sensors:
            names = [f"{sensor.name}.{one}" for one in sensor.scale_parameters]
            scale = [model.table.index_of(name) for name in names]
            if not scale or free[scale].any():
                continue
            size = model.table.tolerance.copy()
            parts = [f"{sensor.name}.{part}" for part in (sensor.base_part, sensor.platform_part)]
            unknown = model.table.matching(parts)
            unknown[scale] = True
            size[unknown] *= UNKNOWN_TOLERANCES
            prior = Prior(model.table.names, model.table.nominal, np.diag(size**2))
            freed = free.copy()
            freed[scale] = True
            try:
                found = implicit.estimate(model, observations, freed, prior)
            except FitError:
                continue  # the fit without the scale says what is wrong
            moved = (found.values - model.table.nominal)[own] / model.table.tolerance[own]
            # A robot that differs by more than its tolerances says less about its size.
            spread = max(float(np.sqrt(np.mean(moved**2))), 1.0)
            excess = 1.0 / float(found.values[scale[0]]) - 1.0
            one = cls(excess, spread * float(found.covariance[scale[0], scale[0]]) ** 0.5, sensor)
            clear = excess**2 > 2 * EQUAL_EVIDENCE * one.sigma**2
            if clear and abs(excess) > MIN_COMMON_SCALE:
                return one
        return None

    def __str__(self) -> str:
        name, option = self.sensor.name, self.sensor.stated_length
        stated = float(getattr(self.sensor, option))
        return (
            f"the robot is {100 * abs(self.excess):.2g} % (sigma {100 * self.sigma:.1g} %) "
            f"{'larger' if self.excess > 0 else 'smaller'} than its nominal lengths say, if "
            f"{option}: {stated:.6g} of {name} is right. If the nominal lengths are right, "
            f"{option} is about {stated / (1 + self.excess):.4g} m: measure it"
        )


def find_scale_of_lengths(model: Model, geometry: np.ndarray) -> float | None:
    """The relative change that all lengths of the geometry share, if it is most of what moved them,
    as a wrong unit or device causes; else None."""
    scale, left, lengths = _fit_scale(model, geometry)
    return scale if lengths >= MIN_SCALED_LENGTHS and left < MAX_UNSCALED_SHARE else None


def _fit_scale(model: Model, own: np.ndarray) -> tuple[float, float, int]:
    """The relative change that the lengths of `own` (mask) share, the share of the squares of what
    moved them, in tolerances, that it leaves, and how many of them are not zero in the drawing."""
    table = model.table
    lengths = own & np.array([p.unit == "m" for p in table])
    size = (table.nominal / table.tolerance)[lengths]
    moved = ((model.values - table.nominal) / table.tolerance)[lengths]
    if not (size.any() and moved.any()):
        return 0.0, 1.0, int(np.count_nonzero(size))
    scale = float(moved @ size) / float(size @ size)
    left = float(np.sum((moved - scale * size) ** 2) / np.sum(moved**2))
    return scale, left, int(np.count_nonzero(size))


def describe_scale_of_lengths(scale: float) -> str:
    larger = "larger" if scale > 0 else "smaller"
    return f"all lengths would be {100 * abs(scale):.3g} % {larger} than drawn"
