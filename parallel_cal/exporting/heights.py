"""Compute the nozzle's height by the firmware at touches of the bed; it decides the first layer.

A touch determines the motors' positions, counted in steps from the end-stops. From these the
firmware's formula computes the nozzle's height, with its old or its new numbers. This height minus
the touch's height (the probe's trigger height, or the stored height) should be 0, because the
firmware assumes that its bed is the plane z = 0. No plane is fitted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.exporting.bed_fit import PROBE, Touched
from parallel_cal.exporting.projection import Array, Machine
from parallel_cal.importing.touch_samples import Touches
from parallel_cal.model.model import Model

ROUNDING = 0.1e-6  # m, of heights, by the digits of the numbers in a file


@dataclass(frozen=True)
class BedHeights:
    """Rms heights (m) at `touches` touches, before and after the new numbers.

    `before` is None if there is no file of the firmware. `held_out` is the rms at touches that the
    firmware's numbers were not fitted to, in folds; None if there are too few touches. `excluded`
    are the numbers of samples that the model was not fitted to, and which are no touches here.
    """

    touches: int
    before: float | None
    after: float
    held_out: float | None = None
    excluded: tuple[int, ...] = ()

    @property
    def worse(self) -> bool:
        return self.before is not None and self.after > self.before + ROUNDING


def why_not(model: Model) -> str:
    """Return why a firmware's heights at touches cannot be computed; empty if they can."""
    names = [sensor.name for sensor in model.sensors]
    if PROBE not in names:
        return (
            f"the model's sensors are {', '.join(names) or 'none'}: expected a "
            f"'{PROBE}', whose tip states how high the nozzle was at a touch"
        )
    if list(model.mechanism.controlled) != [0, 1, 2] or len(model.joints) != 3:
        return (
            "heights at touches are computed for Deltas with three motors, not for "
            f"{model.mechanism.name}: export without touches"
        )
    return ""


def nozzle_heights(model: Model, machine: Machine, touches: Touches) -> Array:
    """Return heights (N,) in m of the nozzle over the firmware's bed, minus the touches' heights.

    NaN if the firmware's formula has no solution for these motors.
    """
    return Touched.by(model, machine, touches).errors(machine.firmware)


def rms_height(model: Model, machine: Machine, touches: Touches, whose: str) -> float:
    """Return the rms height (m) at touches; ModelError if one is out of reach of the machine.

    `whose` names the numbers of the machine, for the message.
    """
    heights = nozzle_heights(model, machine, touches)
    if beyond := int(np.isnan(heights).sum()):
        raise ModelError(
            f"{touches.source}: {beyond} of {len(heights)} touches are beyond the firmware's reach "
            f"with {whose} numbers: expected touches of this machine, imported with the "
            "configuration from which the model was made"
        )
    return float(np.sqrt(np.mean(heights**2)))
