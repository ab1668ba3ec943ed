"""FluidNC: the sizes of its ParallelDelta, the anchors of its WallPlotter, and those of Maslow.

Of a ParallelDelta, only the difference of the two triangles' sides counts:
end_effector_triangle_mm stays as it is, unless the base would leave its range. The position when
homed is always mpos_mm, so that the origin follows from up_degrees. The meaning of the numbers and
their source are in the importer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.units import DEGREE, MM
from parallel_cal.exporting.deltas import ROTARY, describe_unequal_stops, fit_equal_shoulders
from parallel_cal.exporting.editing import format_number
from parallel_cal.exporting.projection import (
    MAX_EQUAL_DIFFERENCE_M,
    Array,
    Firmware,
    Frame,
    Machine,
    Projection,
    Refinement,
    fit_numbers,
)
from parallel_cal.importing.deltas import HANGING_ANGLES, SIDE, heights_on_axis
from parallel_cal.importing.importers import fluidnc
from parallel_cal.importing.importers.fluidnc import (
    ANCHORS,
    ARM,
    ARM_MM,
    BELTS,
    CORNERS,
    DELTA,
    EFFECTOR_MM,
    EXTENSION,
    HOMED_AT,
    PLOTTER,
    RANGES,
    SIZES,
    UP,
)
from parallel_cal.importing.settings import Settings
from parallel_cal.importing.wall_lines import MaslowBelts, PlotterLines
from parallel_cal.model.model import Model

HOLDS = (*ROTARY, "cable")
FILE = "config.yaml"
DECIMALS = 4  # of mm
ANGLE_DECIMALS = 6  # of degrees; a position when homed follows from them
UNEQUAL_ANCHORS = (
    "the anchors differ in y, but FluidNC (read e952f33f) takes both at left_anchor_y when it "
    "computes the position from the motors: reported positions are wrong, moves are right"
)
OFFSETS_LOST = "it has no number for the offset of {} line, so it is lost: fit --fix '*.offset'"


def settings(paths: Sequence[Path]) -> Settings:
    return fluidnc.settings(paths)


def firmware(stated: Settings) -> Firmware:
    return fluidnc.kinematics(stated)


def project(
    model: Model, present: Refinement | None = None, stated: Settings | None = None
) -> Projection:
    if model.mechanism.name in ROTARY:
        return _delta(model, present, stated)
    cable: Any = model.mechanism
    if cable.moves != ("x", "y") or cable.spools or any(cable.moving_pulleys):
        raise ModelError(
            "fluidnc: expected a cable robot in x and y, whose readings are lengths of line and "
            "whose lines end at the point"
        )
    n, whole = len(model.joints), cable.whole
    if not (n == 2 and not whole and not cable.zero_point.any()) and not (n == 4 and whole):
        raise ModelError(
            f"fluidnc: {n} lines that count from "
            f"{'the anchors' if whole else cable.zero_point.tolist()}, expected two lines that "
            "count from the origin (WallPlotter), or four from the anchors (Maslow)"
        )
    return _maslow(model, stated) if whole else _plotter(model)


def _delta(model: Model, present: Refinement | None, stated: Settings | None) -> Projection:
    delta, found = fit_equal_shoulders(model, HANGING_ANGLES, one_stop=True, present=present)
    at = 0.0 if stated is None else stated.number(HOMED_AT[2], "mm", 0.0) * MM
    above = at - heights_on_axis(delta, delta.homed)[0]  # the motors, over the firmware's origin
    frame = replace(found.frame, origin=found.frame.origin - above * found.frame.axes[:, 2])
    fields = [f"{DELTA}/{key}" for key in SIZES]
    effector = EFFECTOR_MM if stated is None else stated.number(fields[3], "mm", EFFECTOR_MM)
    base = delta.radius / MM / SIDE + effector
    outside = base - np.clip(base, *RANGES[fields[2]])
    sizes = (delta.arms[0] / MM, delta.rods[0] / MM, base - outside, effector - outside)
    written = {field: f"{size:.{DECIMALS}f}" for field, size in zip(fields, sizes, strict=True)}
    written[UP] = format_number(-delta.homed[0] / DEGREE, ANGLE_DECIMALS)
    for field, text in written.items():
        low, high = RANGES[field]
        if not low <= float(text) <= high:
            raise ModelError(
                f"fluidnc: {field} would be {text}, expected {low:g} to {high:g}: the firmware "
                "takes the nearer end of this range. It cannot move this robot; grblhal can"
            )
    remarks = describe_unequal_stops(model, HANGING_ANGLES)
    return Projection({FILE: written}, frame, found.stops, remarks)


def _anchors(model: Model) -> Array:
    rows = range(1, len(model.joints) + 1)
    return np.array([[model.value(f"line{i}.A_{axis}") for axis in "xy"] for i in rows])


def _plotter(model: Model) -> Projection:
    start = _anchors(model)
    order = tuple(int(i) for i in np.argsort(start[:, 0]))  # left and right

    def machine(v: Array) -> Machine:
        return Machine(PlotterLines(v.reshape(2, 2)), Frame(order, np.ones(2)), np.zeros(2))

    anchors = fit_numbers(model, start[list(order)].ravel(), machine)
    numbers = {
        f"{PLOTTER}/{key}": f"{value / MM:.{DECIMALS}f}"
        for key, value in zip(ANCHORS, anchors, strict=True)
    }
    remarks = []
    if abs(anchors[1] - anchors[3]) > MAX_EQUAL_DIFFERENCE_M:
        remarks.append(UNEQUAL_ANCHORS)
    if any(model.value(f"line{i}.offset") for i in (1, 2)):
        remarks.append(OFFSETS_LOST.format("a"))
    return Projection({FILE: numbers}, Frame(order, np.ones(2)), np.zeros(2), tuple(remarks))


def _maslow(model: Model, stated: Settings | None) -> Projection:
    """Fit anchors and one offset; then place the anchors in the coordinates of the file."""
    n, start = 4, _anchors(model)
    offsets = np.array([model.value(f"line{i + 1}.offset") for i in range(n)])

    def belts(v: Array) -> MaslowBelts:
        return MaslowBelts(v[:-1].reshape(n, 2), float(v[-1]))

    def frame(found: MaslowBelts, axes: Array) -> Frame:
        origin = np.array([*found.centre, 0.0])
        return Frame(tuple(range(n)), np.ones(n), origin, axes, axes)

    def machine(v: Array) -> Machine:
        return Machine(belts(v), frame(belts(v), np.eye(3)), np.zeros(n))

    found = belts(fit_numbers(model, np.array([*start.ravel(), offsets.mean()]), machine))
    own = None if stated is None else fluidnc.kinematics(stated)
    corner, along = np.zeros(2), np.array([1.0, 0.0])
    if isinstance(own, MaslowBelts):
        corner, along = own.anchors[2], own.anchors[3] - own.anchors[2]
    edge = found.anchors[3] - found.anchors[2]
    turn = np.arctan2(edge[1], edge[0]) - np.arctan2(along[1], along[0])
    cos, sin = float(np.cos(turn)), float(np.sin(turn))
    axes = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    places = corner + (found.anchors - found.anchors[2]) @ axes[:2, :2]
    arm = ARM_MM if stated is None else stated.number(ARM, "mm", ARM_MM)
    written = dict(zip(CORNERS, places.ravel() / MM, strict=True))
    written[EXTENSION] = found.offset / MM - arm
    numbers = {key: format_number(v, DECIMALS) for key, v in written.items()}
    remarks = [f"the lines are the belts {BELTS}, in this order"]
    if np.ptp(offsets) > MAX_EQUAL_DIFFERENCE_M:
        remarks.append(OFFSETS_LOST.format("each"))
    return Projection({FILE: numbers}, frame(found, axes), np.zeros(n), tuple(remarks))
