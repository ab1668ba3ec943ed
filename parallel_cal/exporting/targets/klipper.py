"""Klipper: the numbers of `kinematics: delta` and `rotary_delta` in printer.cfg.

Klipper takes the steppers at any angle, but counter-clockwise seen from above: of the two points
where the rods meet, its forward problem finds the lower one only then (klippy/mathutil.py,
trilateration). Its axes are those of {B}, turned over about x where z of {B} points down.
Sources: Klipper documentation, "Configuration reference" and "Delta calibration".
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.units import DEGREE, MM
from parallel_cal.exporting.deltas import LINEAR, ROTARY, shoulders, towers
from parallel_cal.exporting.projection import Firmware, Projection
from parallel_cal.importing.deltas import Shoulders
from parallel_cal.importing.importers import klipper
from parallel_cal.importing.importers.klipper import STEPPERS
from parallel_cal.importing.settings import Settings
from parallel_cal.model.model import Model

HOLDS = (*LINEAR, *ROTARY)
FILE = "printer.cfg"
DECIMALS = 6  # of mm and degrees, as SAVE_CONFIG writes them


def settings(paths: Sequence[Path]) -> Settings:
    return klipper.settings(paths)


def firmware(stated: Settings) -> Firmware:
    return klipper.delta(stated)


def project(model: Model) -> Projection:
    if model.mechanism.name in LINEAR:
        tall, c = towers(model, places=None, tilted=False)
        kind, heights = "delta", tall.heights
        printer = {"delta_radius": tall.radius[0] / MM}
        angles = tall.first + np.arange(3) * 120 * DEGREE + tall.trim
        each = {"arm_length": tall.rods / MM}
    else:
        turned, c = shoulders(model, places=None, level=True)
        kind, heights, angles = "rotary_delta", end_stop_heights(turned), turned.angles
        printer = {"shoulder_radius": turned.radius / MM}
        printer |= {"shoulder_height": turned.heights[0] / MM}
        each = {"upper_arm_length": turned.arms / MM, "lower_arm_length": turned.rods / MM}
    each |= {"angle": np.round(angles / DEGREE, DECIMALS) % 360, "position_endstop": heights / MM}
    found = {"[printer] kinematics": kind}
    found |= {f"[printer] {key}": f"{number:.{DECIMALS}f}" for key, number in printer.items()}
    for i, stepper in enumerate(STEPPERS):
        found |= {f"{stepper} {key}": f"{three[i]:.{DECIMALS}f}" for key, three in each.items()}
    return Projection({FILE: found}, c.frame, c.stops, _remarks(model, c.frame.order))


def _remarks(model: Model, order: tuple[int, ...]) -> tuple[str, ...]:
    """Which steppers drive other joints than the model's order suggests, and why."""
    moved = [(STEPPERS[i], model.joints[k]) for i, k in enumerate(order) if i != k]
    if not moved:
        return ()
    drives = " and ".join(f"{stepper} drives {joint}" for stepper, joint in moved)
    return (
        f"{drives}. Klipper needs its steppers counter-clockwise seen from above: "
        "the pins in these sections must be those of these joints",
    )


def end_stop_heights(delta: Shoulders) -> np.ndarray:
    """Where the nozzle in the middle (3,) m is believed with one arm at its end-stop."""
    out = delta.radius + delta.arms * np.cos(delta.homed)
    if (out > delta.rods).any():
        raise ModelError("with the arms at their end-stops no rod reaches the middle")
    return np.asarray(
        delta.heights + delta.arms * np.sin(delta.homed) - np.sqrt(delta.rods**2 - out**2)
    )
