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
from parallel_cal.exporting.projection import Array, Machine
from parallel_cal.importing.touch_samples import Touches
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.model.model import Model

PROBE = "probe"
MAX_STEPS = 50  # of Newton's method; three are usual
CLOSE = 1e-10  # m; a smaller step has converged
DIFFERENCE = 1e-6  # m, for slopes of the firmware's formula


@dataclass(frozen=True)
class BedHeights:
    """Rms heights (m) at `touches` touches, before and after the new numbers.

    `before` is None if there is no file of the firmware.
    """

    touches: int
    before: float | None
    after: float

    @property
    def worse(self) -> bool:
        return self.before is not None and self.after > self.before


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
    frame, firmware = machine.frame, machine.firmware
    motors = firmware.homed + frame.motors(touches.q - machine.stops)
    near = Kinematics(model, quick=True).direct(touches.q)
    r, R = frame.poses(near.position, near.rotation)
    for _ in range(MAX_STEPS):
        off = firmware.joints(r, R) - motors
        slopes = np.stack(
            [
                (firmware.joints(r + d, R) - firmware.joints(r - d, R)) / (2 * DIFFERENCE)
                for d in DIFFERENCE * np.eye(3)
            ],
            axis=2,
        )
        bad = ~(np.isfinite(slopes).all(axis=(1, 2)) & np.isfinite(off).all(axis=1))
        slopes[bad] = np.eye(3)
        step = np.linalg.solve(slopes, off[:, :, None])[:, :, 0]
        step[bad] = np.nan
        r = r - step
        if not (np.abs(step) > CLOSE).any():
            break
    else:
        r = np.where(np.abs(step) > CLOSE, np.nan, r)
    tip = next(sensor for sensor in model.sensors if sensor.name == PROBE).options.get("tip")
    below = 0.0 if tip is None else float(tip[2])
    upwards = np.sign(frame.turn[2, 2])  # 1 if z of the firmware points along z of {B}, else -1
    return np.asarray(r[:, 2] + upwards * (below - touches.height))


def bed_heights(
    model: Model, before: Machine | None, after: Machine, touches: Touches
) -> BedHeights:
    """Return rms heights at touches, before and after; ModelError if a touch is out of reach."""
    if words := why_not(model):
        raise ModelError(words)

    def rms(machine: Machine, whose: str) -> float:
        heights = nozzle_heights(model, machine, touches)
        if beyond := int(np.isnan(heights).sum()):
            raise ModelError(
                f"{touches.source}: {beyond} of {len(heights)} touches are beyond the "
                f"firmware's reach with {whose} numbers: expected touches of this "
                "machine, imported with the configuration from which the model was made"
            )
        return float(np.sqrt(np.mean(heights**2)))

    old = None if before is None else rms(before, "the file's")
    return BedHeights(len(touches.q), old, rms(after, "the new"))
