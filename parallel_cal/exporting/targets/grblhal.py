"""grblHAL: settings $641 to $646 of its symmetric rotary Delta.

All motors are alike, z = 0 is the plane of their axes, and angles count down from the horizontal.
The settings called radii are sides of triangles: an axis is tan(30)/2 times the side from the
centre. Only the difference of the two counts, so $644 is 0. Source: grblHAL core,
kinematics/delta.c and its settings' descriptions.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from parallel_cal.base.units import DEGREE, MM
from parallel_cal.exporting.deltas import ROTARY, fit_equal_shoulders
from parallel_cal.exporting.projection import Firmware, Projection, Refinement
from parallel_cal.importing.deltas import Shoulders
from parallel_cal.importing.settings import Settings, SourceLine, read_lines
from parallel_cal.model.model import Model

HOLDS = ROTARY
FILE = "settings.txt"
SHOULDER_ANGLES = np.radians([270.0, 30.0, 150.0])
SIDE = np.tan(np.radians(30)) / 2  # distance of an axis from the centre, per side of its triangle


def settings(paths: Sequence[Path]) -> Settings:
    """Read settings such as `$641=250.000`, as `$$` lists them."""
    texts: dict[str, tuple[str, SourceLine]] = {}
    for path in paths:
        for place, line in read_lines(path):
            if found := re.match(r"\s*(\$\d+)\s*=\s*([^\s;(]*)", line):
                texts[found[1]] = (found[2], place)
    return Settings(texts, paths)


def firmware(stated: Settings) -> Firmware:
    rod, arm = (stated.number(f"${n}", "a length in mm", low=1.0) * MM for n in (641, 642))
    sides = [stated.number(f"${n}", "a triangle's side in mm", low=0.0) for n in (643, 644)]
    top = stated.number("$646", "the homing angle in degrees", low=-90.0, high=90.0)
    same, limits = np.ones(3), ((-np.pi / 2, -top * DEGREE),) * 3
    radius = SIDE * (sides[0] - sides[1]) * MM
    return Shoulders(radius, 0 * same, arm * same, rod * same, SHOULDER_ANGLES, limits)


def project(model: Model, present: Refinement | None = None) -> Projection:
    delta, found = fit_equal_shoulders(model, SHOULDER_ANGLES, one_stop=True, present=present)
    numbers = (delta.rods[0] / MM, delta.arms[0] / MM, delta.radius / MM / SIDE, 0.0)
    written = {f"${641 + k}": f"{number:.3f}" for k, number in enumerate(numbers)}
    written["$646"] = f"{-delta.homed[0] / DEGREE:.3f}"
    return Projection({FILE: written}, found.frame, found.stops)
