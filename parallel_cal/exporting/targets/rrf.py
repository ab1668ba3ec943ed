"""RepRapFirmware (Duet): M665 and M666 of linear Deltas, M669 of rotary ones, five-bars, cables.

Source: Duet documentation, G-code dictionary (M665, M666, M669).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from parallel_cal.base.errors import ModelError
from parallel_cal.base.units import DEGREE, MM
from parallel_cal.exporting.deltas import (
    LINEAR,
    ROTARY,
    TOWERS,
    complete_towers,
    express_gain,
    shoulders,
    towers,
)
from parallel_cal.exporting.height_map import HeightMap
from parallel_cal.exporting.projection import (
    MAX_EQUAL_DIFFERENCE_M,
    Firmware,
    Frame,
    Machine,
    Projection,
    Refinement,
    fit_numbers,
)
from parallel_cal.importing.fivebar import TURNS, FiveBars
from parallel_cal.importing.gcode import settings as settings_of
from parallel_cal.importing.hangprinter import Hangprinter
from parallel_cal.importing.importers import rrf
from parallel_cal.importing.importers.rrf import ANCHORS
from parallel_cal.importing.settings import Settings
from parallel_cal.model.model import Model

HOLDS = (*LINEAR, *ROTARY, "five_bar", "cable")
FILE, HEIGHT_MAP = "config.g", "heightmap.csv"
TEETH = 20  # of a motor's gear, if they give the ratio
EQUAL_ARMS = "the arms differ, but M669 U has one length for all: " + rrf.UNEQUAL_ARMS
MIN_BUILDUP_M = 2e-6  # m; the firmware divides by it, and rounding hides a smaller one


def settings(paths: Sequence[Path], texts: Mapping[Path, str] | None = None) -> Settings:
    return settings_of(paths, rrf.CODES, texts)


def firmware(stated: Settings) -> Firmware:
    of: dict[int, Callable[[Settings], Firmware]] = {6: rrf.read_hangprinter, 9: rrf.read_five_bars}
    return of.get(rrf.kind(stated), rrf.read_delta)(stated)


def beside(model: Model, machine: Machine) -> dict[str, str]:
    """Return the height map of a Delta with a probe: what its numbers leave of the bed's heights.

    As the firmware writes it (HeightMap::SaveToFile of Grid.cpp in 3.5.3); `0` is no height.
    """
    deltas = (*LINEAR, *ROTARY)
    if model.mechanism.name not in deltas or all(s.name != "probe" for s in model.sensors):
        return {}
    found = HeightMap.of(model, machine)
    known = found.heights[np.isfinite(found.heights)] / MM
    if not len(known):
        return {}
    low, high, step = (v / MM for v in (found.at[0], found.at[-1], found.at[1] - found.at[0]))
    n, edges = len(found.at), f"{low:.2f},{high:.2f}"
    rows = (
        ",".join("      0" if np.isnan(cell) else f"{cell / MM:7.3f}" for cell in row)
        for row in found.heights
    )
    lines = [
        f"{rrf.HEAD}, min error {known.min():.3f}, max error {known.max():.3f}, "
        f"mean {known.mean():.3f}, deviation {known.std():.3f}",
        rrf.LABELS[0],
        f"X,Y,{edges},{edges},{found.radius / MM:.2f},{step:.2f},{step:.2f},{n},{n}",
        *rows,
    ]
    return {HEIGHT_MAP: "\n".join(lines) + "\n"}


def complete(read: Firmware, model: Model) -> Firmware:
    return complete_towers(read, model, TOWERS)


def project(
    model: Model, present: Refinement | None = None, stated: Settings | None = None
) -> Projection:
    name = model.mechanism.name
    if name in LINEAR:
        return _linear(model, present, stated is not None and rrf.scale(stated) is not None)
    if name in ROTARY:
        return _rotary(model, present)
    return {"five_bar": _five_bar, "cable": _cable}[name](model)


def _linear(model: Model, present: Refinement | None, has_scale: bool) -> Projection:
    delta, c = towers(model, TOWERS, tilted=True, present=present, has_scale=has_scale)
    homed = delta.heights.mean()
    found = {"M665 L": _numbers(delta.rods / MM, 4), "M665 R": _numbers(delta.radius[:1] / MM, 4)}
    found |= {"M665 H": _numbers([homed / MM], 4)}
    found |= _format_three("M665", delta.trim / DEGREE, 5)
    found |= _format_three("M666", (delta.heights - homed) / MM, 4)
    slopes = zip("AB", delta.tilt, strict=True)
    found |= {f"M666 {axis}": _numbers([100 * slope], 5) for axis, slope in slopes}
    if delta.scale is not None:
        found |= _format_three("M92", delta.scale * MM, 5)
    made = Projection({FILE: found}, c.frame, c.stops)
    return express_gain(model, made, delta.scale, "M92")


def _rotary(model: Model, present: Refinement | None) -> Projection:
    """Fit arms of one length: the firmware's forward kinematics takes all heights by arm A's."""
    delta, c = shoulders(model, TOWERS, equal_arms=True, present=present)
    limits = np.array(model.mechanism.joint_limits, float)
    least = c.frame.motors(limits[:, 0] if c.frame.signs[0] > 0 else limits[:, 1]).max()
    top = delta.homed.mean()
    trim = (delta.angles - TOWERS + np.pi) % (2 * np.pi) - np.pi
    found = {
        "M669 K": "10",
        "M669 U": _numbers(delta.arms / MM, 4),
        "M669 L": _numbers(delta.rods / MM, 4),
        "M669 H": _numbers(delta.heights / MM, 4),
        "M669 A": _numbers([max(least, -np.pi / 2) / DEGREE, top / DEGREE], 5),
        "M669 R": _numbers([delta.radius / MM], 4),
    }
    found |= _format_three("M669", trim / DEGREE, 5) | _format_three(
        "M666", (delta.homed - top) / DEGREE, 5
    )
    remarks = (EQUAL_ARMS,) if np.ptp(c.arms) > MAX_EQUAL_DIFFERENCE_M else ()
    return Projection({FILE: found}, c.frame, c.stops, remarks)


def _five_bar(model: Model) -> Projection:
    bars_of: Any = model.mechanism
    if bars_of.has_tool:
        raise ModelError(
            "rrf: the end point is beyond the point where the rods meet, expected a five-bar whose "
            "rods meet at the end point; the targets c and table can represent it"
        )
    sides = ("left", "right")
    x, y, cranks, rods, q0 = (
        np.array([model.value(f"{side}.{name}") for side in sides])
        for name in ("x", "y", "crank", "rod", "q0")
    )
    home = model.mechanism.home
    angles, stops = np.array(home.joints) + q0, np.array(bars_of.switches)
    reach = np.array(home.position[:2]) - np.column_stack([x, y])
    left = np.sign(np.cos(angles) * reach[:, 1] - np.sin(angles) * reach[:, 0])
    turns = (int(left[0]), int(left[1]))
    if turns not in TURNS.values():
        raise ModelError(
            "rrf: no work mode for a left crank with the point to its left and a "
            "right crank with the point to its right"
        )

    def machine(v: np.ndarray) -> Machine:
        bars = FiveBars(v[:4].reshape(2, 2), v[4:6], v[6:8], turns, v[8:])
        return Machine(bars, Frame((0, 1), np.ones(2)), stops)

    start = np.array([x[0], y[0], x[1], y[1], *cranks, *rods, *(stops + q0)])
    found = machine(fit_numbers(model, start, machine))
    bars = found.firmware
    assert isinstance(bars, FiveBars)
    mode = next(mode for mode, side in TURNS.items() if side == turns)
    ends = np.array(model.mechanism.joint_limits) + (bars.homed - stops)[:, None]
    settings = {
        "M669 K": "9",
        "M669 X": _numbers(bars.axes[:, 0] / MM, 4),
        "M669 Y": _numbers(bars.axes[:, 1] / MM, 4),
        "M669 L": str(mode),
        "M669 P": _numbers(bars.cranks / MM, 4),
        "M669 D": _numbers(bars.rods / MM, 4) + ":0:0",
        "M669 B": _numbers(bars.homed / DEGREE, 5),
        "M669 C": _numbers(ends.ravel() / DEGREE, 3),
    }
    return Projection({FILE: settings}, found.frame, found.stops)


def _cable(model: Model) -> Projection:
    """Fit anchors, radii and the build-up; gears and advantages are counted, not measured."""
    n = len(model.joints)
    cable: Any = model.mechanism
    if not cable.spools or len(cable.moves) < 3:
        kind = "lengths of line" if cable.spools == () else "a planar robot"
        raise ModelError(f"rrf: {kind}, expected angles of motors of a robot in space")
    if any(cable.moving_pulleys):
        raise ModelError(
            "rrf: its lines run over pulleys on the platform, expected lines that end there"
        )
    if cable.zero_point.any():
        raise ModelError(
            f"rrf: the lines count from home {cable.zero_point.tolist()} m, expected from the "
            "origin: state the anchors relative to home"
        )
    rows = range(1, n + 1)
    anchors = np.array([[model.value(f"line{i}.A_{axis}") for axis in "xyz"] for i in rows])
    gears, advantages = (
        np.array([model.value(f"line{i}.{name}") for i in rows]) for name in ("gear", "advantage")
    )
    if not 4 <= n <= len(ANCHORS) or (advantages != np.round(advantages)).any():
        why = f"{n} lines with advantages {advantages.tolist()}"
        raise ModelError(f"rrf: {why}, expected 4 to {len(ANCHORS)} and whole numbers")
    spools = np.array(cable.spools)
    radii = [model.value(f"spool{k}.R") for k in sorted({*spools})]
    wound = model.has_effect("spool_buildup")
    buildup = [model.value("spool_buildup.Q")] if wound else []

    def machine(v: np.ndarray) -> Machine:
        own = v[3 * n : 3 * n + len(radii)][np.searchsorted(sorted({*spools}), spools)]
        grown = max(float(v[-1]), MIN_BUILDUP_M) if wound else MIN_BUILDUP_M
        lines = Hangprinter(v[: 3 * n].reshape(n, 3), own, gears, advantages, grown)
        return Machine(lines, Frame(tuple(range(n)), np.ones(n)), np.zeros(n))

    found = machine(fit_numbers(model, np.array([*anchors.ravel(), *radii, *buildup]), machine))
    lines = found.firmware
    assert isinstance(lines, Hangprinter)
    teeth = [_teeth(gear) for gear in gears]
    settings = {"M669 K": "6", "M669 N": str(n)}
    points = zip(ANCHORS, lines.anchors / MM, strict=False)
    settings |= {f"M669 {name}": _numbers(point, 4) for name, point in points}
    settings |= {
        "M666 Q": f"{lines.buildup / MM:.7f}",
        "M666 R": _numbers(lines.radii / MM, 5),
        "M666 U": _numbers(advantages, 0),
        "M666 O": ":".join("1" * n),
        "M666 L": ":".join(str(motor) for motor, _ in teeth),
        "M666 H": ":".join(str(spool) for _, spool in teeth),
    }
    remarks = []
    if lines.buildup == MIN_BUILDUP_M:
        remarks.append(
            f"M666 Q must be at least {MIN_BUILDUP_M / MM:g}, because the firmware divides by it"
        )
    if any(model.value(f"line{i}.offset") for i in rows):
        remarks.append(
            "it has no number for the offset of the lines, so the offset is lost: "
            "fit --fix '*.offset'"
        )
    return Projection({FILE: settings}, found.frame, found.stops, tuple(remarks))


def _teeth(gear: float) -> tuple[int, int]:
    """Return the teeth of the motor's and the spool's gear."""
    if abs(TEETH * gear - round(TEETH * gear)) < 1e-9:
        return TEETH, round(TEETH * gear)
    ratio = Fraction(gear).limit_denominator(200)
    return ratio.denominator, ratio.numerator


def _numbers(values: ArrayLike, digits: int) -> str:
    return ":".join(f"{v + 0.0:.{digits}f}" for v in np.asarray(values, float))


def _format_three(code: str, values: ArrayLike, digits: int) -> dict[str, str]:
    rows = zip("XYZ", np.asarray(values, float), strict=True)
    return {f"{code} {axis}": _numbers([value], digits) for axis, value in rows}
