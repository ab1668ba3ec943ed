"""Smoothieware: the keys of its linear and rotary Deltas and of Morgan's SCARA in `config`, and the
same commands.

Where `config-override` states a value, this one counts, and both are written. Of a rotary Delta,
only the difference of the sides delta_f and delta_e counts, and the motors' height above z = 0:
delta_e, delta_ee_offs and delta_tool_offset stay as they are. Their meaning and their source are in
the importer.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.units import DEGREE, MM
from parallel_cal.exporting import deltas
from parallel_cal.exporting.deltas import TOWERS, complete_towers, express_gain, fit_equal_shoulders
from parallel_cal.exporting.editing import format_number
from parallel_cal.exporting.projection import (
    Firmware,
    Frame,
    Machine,
    Projection,
    Refinement,
    fit_numbers,
)
from parallel_cal.importing.deltas import HANGING_ANGLES, SIDE
from parallel_cal.importing.gcode import HOME_OFFSETS
from parallel_cal.importing.importers import smoothieware
from parallel_cal.importing.importers.smoothieware import (
    ANGLES,
    ARMS,
    AXES,
    DEPTHS,
    HOMING,
    LINEAR,
    MORGAN,
    OFFSETS,
    PLACE,
    ROTARY,
    SIDES,
    SOLUTION,
    STEPS,
    TRIMS,
)
from parallel_cal.importing.morgan import MorganArms
from parallel_cal.importing.settings import Settings
from parallel_cal.model.model import Model

HOLDS = (*deltas.LINEAR, *deltas.ROTARY, "five_bar")
FILE = "config"
DECIMALS = 5  # of mm, degrees and steps per mm
CLEARED = HOME_OFFSETS  # they are added to the homing positions
STORED = (
    "M500 stores values in config-override, which count before those of config: if the printer has "
    "one, change it with --into config --into config-override, or delete it"
)
KIND = (SOLUTION, *HOMING.values(), *(f"{axis}_homing_direction" for axis in AXES))


def settings(paths: Sequence[Path]) -> Settings:
    return smoothieware.settings(paths)


def firmware(stated: Settings) -> Firmware:
    return smoothieware.kinematics(stated)


def complete(read: Firmware, model: Model) -> Firmware:
    return complete_towers(read, model, TOWERS)


def project(
    model: Model, present: Refinement | None = None, stated: Settings | None = None
) -> Projection:
    if model.mechanism.name in deltas.LINEAR:
        return _linear(model, present, stated)
    if model.mechanism.name == "five_bar":
        return _morgan(model, stated)
    return _rotary(model, present, stated)


def _linear(model: Model, present: Refinement | None, stated: Settings | None) -> Projection:
    has_scale = stated is not None and smoothieware.scale(stated) is not None
    delta, c = deltas.towers(
        model,
        TOWERS,
        tilted=False,
        present=present,
        equal_rods=True,
        has_scale=has_scale,
        equal_radii=False,
    )
    # Of all ways to state the same, the one with the file's own radius and with trims of 0 or less.
    own = 0.0 if stated is None else smoothieware.radius_offsets(stated).mean()
    radius, height = delta.radius.mean() - own, delta.heights.min()
    found = {"arm_length": delta.rods[0] / MM, "arm_radius": radius / MM}
    found |= dict(zip(OFFSETS, (delta.radius - radius) / MM, strict=True))
    found |= dict(zip(ANGLES, delta.trim / DEGREE, strict=True))
    found |= {"alpha_max": 0.0, "beta_max": 0.0, "gamma_max": height / MM}
    found |= dict(zip(TRIMS, (height - delta.heights) / MM, strict=True))
    if delta.scale is not None:
        found |= dict(zip(STEPS, delta.scale * MM, strict=True))
    made = Projection({FILE: _write(LINEAR, found)}, c.frame, c.stops, (STORED,))
    return express_gain(model, made, delta.scale, STEPS[0])


def _rotary(model: Model, present: Refinement | None, stated: Settings | None) -> Projection:
    places = HANGING_ANGLES if stated is None else smoothieware.motor_angles(stated)
    delta, found = fit_equal_shoulders(
        model, places, one_stop=False, present=present, above_bed=True
    )
    sides = (0.0, delta.radius / SIDE, delta.rods[0], delta.arms[0])
    numbers = dict(zip(SIDES, np.array(sides) / MM, strict=True))
    numbers |= dict(zip(DEPTHS, np.array([delta.heights[0], 0.0, 0.0]) / MM, strict=True))
    numbers |= {f"{axis}_max": -top / DEGREE for axis, top in zip(AXES, delta.homed, strict=True)}
    return Projection({FILE: _write(ROTARY, numbers)}, found.frame, found.stops, (STORED,))


def _morgan(model: Model, stated: Settings | None) -> Projection:
    """Fit the arms, the place of their axis and the angles at which they are homed."""
    bars: Any = model.mechanism
    if not bars.has_tool:
        raise ModelError(
            "smoothieware: the rods meet at the end point, expected two arms on one axis whose "
            "forearm has a tool beyond its rods (Morgan's SCARA); the target rrf has a five-bar"
        )
    upper, other = bars.carrier, bars.other
    order = (0, 1) if upper == "left" else (1, 0)
    frame, stops = Frame(order, np.ones(2)), np.array(bars.switches)
    q0 = np.array([model.value(f"{side}.q0") for side in (upper, other)])
    homed = frame.motors(stops) + q0 - [0.0, np.pi]

    def arms(v: np.ndarray) -> MorganArms:
        return MorganArms(v[:2], v[2:4], v[4:], (1.0, -1.0))

    def machine(v: np.ndarray) -> Machine:
        return Machine(arms(v), frame, stops)

    reach = np.hypot(model.value(f"{upper}.rod") + model.value("tool.x"), model.value("tool.y"))
    place = [model.value(f"{upper}.{axis}") for axis in "xy"]
    start = np.array([model.value(f"{upper}.crank"), reach, *place, *homed])
    found = arms(fit_numbers(model, start, machine))
    at = [coordinate / MM for coordinate in model.mechanism.home.position[:2]]
    if stated is not None:
        at = [stated.number(smoothieware.stop_field(stated, axis), "mm") for axis in (0, 1)]
    trims = smoothieware.home_angles(found, at) - found.homed
    numbers = dict(zip((*ARMS, *PLACE), [*found.arms / MM, *found.origin / MM], strict=True))
    numbers |= dict(zip(TRIMS[:2], trims / DEGREE, strict=True))
    numbers |= {f"{axis}_max": mm for axis, mm in zip(AXES, at, strict=False)}
    return Projection({FILE: _write(MORGAN, numbers)}, frame, stops, (STORED,))


def _write(kind: tuple[str, ...], numbers: Mapping[str, float]) -> dict[str, str]:
    written = {SOLUTION: kind[0], HOMING[kind]: "true"}
    written |= {f"{axis}_homing_direction": "home_to_max" for axis in AXES}
    return written | {key: format_number(number, DECIMALS) for key, number in numbers.items()}


def adapt(stated: Settings, numbers: Mapping[str, str]) -> dict[str, str]:
    """Return settings by the names of the files: keys, commands, or both."""
    kind, found = smoothieware.kind(stated), dict[str, str]()
    numbers = {key: text for key, text in numbers.items() if key not in KIND}
    if kind is ROTARY:  # the file's own sizes of the effector and the tool stay
        for size, others in ((SIDES[1], SIDES[:1]), (DEPTHS[0], DEPTHS[1:])):
            own = [stated.number(smoothieware.where(stated, key), "mm") for key in others]
            numbers[size] = f"{float(numbers[size]) + sum(own):.{DECIMALS}f}"
            numbers = {key: text for key, text in numbers.items() if key not in others}
    stops = [f"{axis}_max" for axis in AXES]
    for key, text in numbers.items():
        if key in stops:
            found[smoothieware.stop_field(stated, stops.index(key))] = text
            continue
        command = smoothieware.COMMANDS[kind].get(key, key)
        fields = [field for field in (key, command) if field in stated]
        if fields or float(text):  # zeros are what the firmware has without the key
            found |= dict.fromkeys(fields or [_place(stated, key, command)], text)
    return found


def _place(stated: Settings, key: str, command: str) -> str:
    """Return the field for a value that no file states: a word if its command is in a file."""
    return command if any(f.split()[0] == command.split()[0] for f in stated.texts) else key
