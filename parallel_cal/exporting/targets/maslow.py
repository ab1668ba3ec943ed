"""Maslow (up to version 3): the sizes in GroundControl's groundcontrol.ini, or in the list of `$$`.

Its motors are level and alike beside the middle of the sheet. Chains that point to the bit have a
rotation radius, and each a tolerance in percent; those that end at two mounts have neither, but the
sizes of the sled, which is symmetrical. The meaning of the numbers and their source are in the
importer.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import rotation_matrix
from parallel_cal.base.units import MM
from parallel_cal.exporting.editing import format_number
from parallel_cal.exporting.projection import (
    MAX_EQUAL_DIFFERENCE_M,
    Array,
    Firmware,
    Frame,
    Machine,
    Projection,
    fit_numbers,
)
from parallel_cal.importing.importers import maslow
from parallel_cal.importing.importers.maslow import FIELDS, is_of_firmware, read_number
from parallel_cal.importing.settings import Settings
from parallel_cal.importing.sled_chains import Quadrilateral, SledChains, Triangular
from parallel_cal.model.model import Model

HOLDS = ("hanging_sled",)
INI, LIST = "groundcontrol.ini", "settings.txt"
DECIMALS = 4  # of mm, and of percent
SIDES, SAG = ("left", "right"), "line_sag"
UNITS = {"left": 0.01, "right": 0.01, "sag": maslow.SAG_UNIT}  # percent; others are in mm
LONGER = (
    "it has no number for the length of {} at reading zero: they are {:+.2f} (left) and {:+.2f} mm "
    "(right) longer than it takes them. Shorten them by this, or compare the error at held-out "
    "marks with that of fit --fix 'left.L0' --fix 'right.L0'"
)
NOT_ALIKE = (
    "the mounts of the sled are not symmetrical to the line through bit and centre of gravity, but "
    "the firmware takes them so: the loss states what that costs"
)


def settings(paths: Sequence[Path]) -> Settings:
    return maslow.settings(paths)


def firmware(stated: Settings) -> Firmware:
    return maslow.chains(stated)


def project(model: Model, stated: Settings | None = None) -> Projection:
    sled: Any = model.mechanism
    if sled.on_sled or model.value("sled.standoff"):
        raise ModelError(
            "maslow: the wheels of this sled are on it, or its lines leave the plane: expected "
            "sprockets on the frame (options wheels and standoff of hanging_sled)"
        )
    if sled.tilts and not sled.over:
        raise ModelError(
            "maslow: chains that leave their sprockets at the bottom and end at two mounts: the "
            "firmware computes only chains over the top for such a sled"
        )
    motors = _frame(model, 0.0, 0.0)[1]
    radius = model.value("wheels.radius")
    if stated is not None:
        radius = read_number(stated, "turn") * MM / (2 * np.pi)
    base = SledChains(float(np.ptp(motors[:, 0])), float(motors[0, 1]), radius)
    chains: Triangular | Quadrilateral
    chains, names, remarks = (_on_mounts if sled.tilts else _on_ring)(model, base)

    def machine(v: Array) -> Machine:
        sizes: dict[str, Any] = dict(zip(names, map(float, v[:-2]), strict=True))
        return Machine(replace(chains, **sizes), _frame(model, *v[-2:])[0], np.zeros(2))

    start = np.array([*(getattr(chains, name) for name in names), 0.0, 0.0])
    *sizes, shift, turn = fit_numbers(model, start, machine)
    found: dict[str, float] = {"sag": 0.0} if not sled.tilts else {}
    found |= dict(zip(names, sizes, strict=True))
    sheet = FIELDS["sheet"].default if stated is None else read_number(stated, "sheet")
    numbers = {
        name: value / UNITS.get(name, MM) - sheet / 2 * (name == "height")
        for name, value in found.items()
    }
    numbers["kind"] = 1.0 if sled.tilts else 2.0
    if not sled.tilts:
        numbers["over"] = 1.0 if sled.over else 2.0
    if stated is None:
        numbers["turn"] = radius * 2 * np.pi / MM
    frame = _frame(model, shift, turn)[0]
    expressed = () if sled.tilts else (SAG, "encoder_gain")
    return Projection(
        _write(numbers, stated), frame, np.zeros(2), tuple(remarks), expressed=expressed
    )


def _on_mounts(model: Model, base: SledChains) -> tuple[Quadrilateral, Sequence[str], list[str]]:
    """Return a sled on two mounts like the model's, its numbers to fit, and what they lack."""
    mounts = np.array([[model.value(f"{side}.B_{axis}") for axis in "xy"] for side in SIDES])
    sizes = float(np.ptp(mounts[:, 0])), float(mounts[:, 1].mean()), -model.value("sled.G_y")
    remarks = []
    longer = np.array([model.value(f"{side}.L0") for side in SIDES])
    if np.abs(longer).max() > MAX_EQUAL_DIFFERENCE_M:
        remarks.append(LONGER.format("a chain", *longer / MM))
    skew = mounts[:, 0].sum() - 2 * model.value("sled.G_x"), np.ptp(mounts[:, 1])
    if np.abs(skew).max() > MAX_EQUAL_DIFFERENCE_M:
        remarks.append(NOT_ALIKE)
    names = ("spacing", "height", "width", "above", "below")
    return Quadrilateral(**vars(base), **dict(zip(names[2:], sizes, strict=True))), names, remarks


def _on_ring(model: Model, base: SledChains) -> tuple[Triangular, Sequence[str], list[str]]:
    """Return a sled whose chains point to the bit, its numbers to fit, and what they lack."""
    lengths = np.array([model.value(f"{side}.L0") for side in SIDES])
    sled = model.mechanism
    ring = Triangular(**vars(base), rotation=float(np.mean(lengths)), over=sled.over)  # type: ignore[attr-defined]
    remarks = []
    if np.ptp(lengths) > MAX_EQUAL_DIFFERENCE_M:
        remarks.append(LONGER.format("one chain", *(lengths - np.mean(lengths)) / MM))
    sags = ("sag",) * model.has_effect(SAG)
    return ring, ("spacing", "height", "rotation", *SIDES, *sags), remarks


def _frame(model: Model, shift: float, turn: float) -> tuple[Frame, Array]:
    """Return the frame of the firmware, and the motors (2, 2) m in it.

    Its x axis is parallel to their line, and its origin under their middle, as far from this line
    as that of {B}; then it is shifted (m) along this line and turned (rad). No number states where
    the sheet is, so that it may be where an asymmetrical sled is moved best.
    """
    anchors = np.array([[model.value(f"{side}.A_{axis}") for axis in "xy"] for side in SIDES])
    along = anchors[1] - anchors[0]
    x = along / np.linalg.norm(along)
    up = np.array([-x[1], x[0]])
    middle = anchors.mean(axis=0)
    origin = middle - (middle @ up) * up + shift * x
    axes = np.eye(3)
    axes[:2, :2] = np.column_stack([x, up])
    axes = axes @ rotation_matrix(np.array([0.0, 0.0, turn]))
    frame = Frame((0, 1), np.ones(2), np.array([*origin, 0.0]), axes, axes)
    return frame, (anchors - origin) @ axes[:2, :2]


def _write(numbers: Mapping[str, float], stated: Settings | None) -> dict[str, dict[str, str]]:
    """Return numbers by file and field."""
    listed = stated is not None and is_of_firmware(stated)
    whole = ("kind", "over")
    written = {
        (FIELDS[name].setting if listed else FIELDS[name].ini): (
            f"{value:.0f}" if name in whole else format_number(value, DECIMALS)
        )
        for name, value in numbers.items()
    }
    return {LIST if listed else INI: written}
