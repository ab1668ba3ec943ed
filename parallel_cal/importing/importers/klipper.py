"""Klipper: `printer.cfg` of linear and rotary Deltas, with what DELTA_CALIBRATE stored in it.

A stored position counts a motor's steps from its end-stop, so it stays true where the
configuration changed; a height is that of the nozzle above the bed there. Sources: Klipper
documentation, "Configuration reference", "Delta calibration", "Rotation distance".
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import count
from pathlib import Path

import numpy as np

from parallel_cal.importing import deltas
from parallel_cal.importing.deltas import DEGREE, MM, Delta, Shoulders, Towers
from parallel_cal.importing.door import Configured
from parallel_cal.importing.stated import Place, Stated, lines
from parallel_cal.importing.touched import of_joints
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.recording import Array

CONFIGURATION = (".cfg",)
SAVED = "#*#"  # before every line of what SAVE_CONFIG wrote
TOUCHES = "[delta_calibrate]"
STEPPERS = [f"[stepper_{a}]" for a in "abc"]
KINDS = "delta or rotary_delta"
UNUSED = "distances between touches are not used, a sample being one pose: the size stays unknown"


def samples(paths: Sequence[Path]) -> Dataset:
    """The heights of [delta_calibrate]; its distances and, beside an offset probe, its manual
    heights are not used, which the warnings say."""
    stated = settings(paths)
    delta = _delta(stated)
    step, top = _steps(stated), end_stops(stated, delta)
    beside = bool(np.any(_probe(stated)))
    found, heights, warnings = [], [], []
    for name in ("height", "manual_height"):
        if name == "manual_height" and beside and f"{TOUCHES} manual_height0" in stated:
            warnings.append("manual heights are the nozzle's, not those of the probe: not used")
            continue
        for k in count():
            if f"{TOUCHES} {name}{k}" not in stated:
                break
            height = stated.number(
                f"{TOUCHES} {name}{k}", "the nozzle's height in mm", None, -50, 50
            )
            heights.append(height * MM)
            found.append(top - step * _position(stated, f"{TOUCHES} {name}{k}_pos"))
    if not found:
        stated.text(f"{TOUCHES} height0", "what DELTA_CALIBRATE and SAVE_CONFIG store")
    if distances := sum(f"{TOUCHES} distance{k}" in stated for k in range(999)):
        warnings.append(f"{distances} {UNUSED}")
    return of_joints(np.array(found), np.array(heights), paths, step, warnings=warnings)


def configured(paths: Sequence[Path]) -> Configured:
    """The printer as its configuration has it."""
    stated = settings(paths)
    return deltas.configured(_delta(stated), _probe(stated))


def settings(paths: Sequence[Path]) -> Stated:
    """The values in files of sections by `[section] key`; what SAVE_CONFIG wrote counts last."""
    texts: dict[str, tuple[str, Place]] = {}
    for path in paths:
        section, saved = "", False
        for place, line in lines(path):
            if line.startswith(SAVED) and not saved:
                section, saved = "", True
            own = line.removeprefix(SAVED).removeprefix(" ") if saved else line
            plain = re.split(r"(?:^|\s)[#;]", own, maxsplit=1)[0]
            if not plain.strip() or plain[0].isspace():  # a macro's lines among them
                continue
            if header := re.fullmatch(r"\[([^\]]+)\]", plain.strip()):
                section = header[1].strip()
                continue
            if saved and not section:  # what introduces the block
                continue
            pair = re.fullmatch(r"([^:=]+)[:=](.*)", plain)
            if not pair or not section:
                raise place.error("the line", line.strip(), "[section] or key: value")
            texts[f"[{section}] {pair[1].strip()}"] = (pair[2].strip(), place)
    return Stated(texts, paths)


def end_stops(stated: Stated, delta: Delta) -> Array:
    """Joints (3,) at the end-stops: where the nozzle in the middle is believed at their height."""
    heights = _each(stated, "position_endstop", "the nozzle's height in mm")
    at = np.column_stack([np.zeros((3, 2)), heights * MM])
    return np.diag(delta.joints(at)).copy()


def _position(stated: Stated, field: str) -> Array:
    text, place = stated.text(field, "steps of motors a, b, c from their end-stops")
    words = text.split(",")
    if len(words) != 3:
        raise place.error(field, text, "three numbers of steps")
    return np.array([place.number(field, word, "three numbers of steps") for word in words])


def _probe(stated: Stated) -> Array:
    """The probe's tip beside the nozzle (3,) m; stored heights are the nozzle's."""
    kind = next((k for k in ("[probe]", "[bltouch]") if f"{k} z_offset" in stated), "[probe]")
    beside = [stated.number(f"{kind} {a}_offset", "mm", 0.0) * MM for a in "xy"]
    return np.array([*beside, 0.0])


def _each(
    stated: Stated,
    key: str,
    expected: str,
    defaults: Sequence[float] | None = None,
    low: float = -1e4,
) -> Array:
    """A key of the three steppers (3,): b and c without it have that of a, or `defaults`."""
    values: list[float] = []
    for i, stepper in enumerate(STEPPERS):
        default = defaults[i] if defaults else values[0] if values else None
        values.append(stated.number(f"{stepper} {key}", expected, default, low))
    return np.array(values)


def _steps(stated: Stated) -> Array:
    """m or rad of a microstep (3,)."""
    found = []
    for stepper in STEPPERS:
        turn = 2 * np.pi
        if _kind(stated) == "delta":
            field = f"{stepper} rotation_distance"
            turn = stated.number(field, "mm a turn", low=1e-3) * MM
        full = stated.number(f"{stepper} full_steps_per_rotation", "steps", 200.0, 1)
        micro = stated.number(f"{stepper} microsteps", "microsteps a step", low=1)
        found.append(turn / (full * micro * _gear(stated, f"{stepper} gear_ratio")))
    return np.array(found)


def _gear(stated: Stated, field: str) -> float:
    """`57:11, 2:1`: the product of the ratios."""
    if field not in stated:
        return 1.0
    text, place = stated.text(field, "")
    ratio = 1.0
    for pair in text.split(","):
        teeth = pair.split(":")
        if len(teeth) != 2:
            raise place.error(field, text, "ratios such as 57:11, 2:1")
        driven, driving = (place.number(field, t, "ratios such as 57:11, 2:1", 1e-6) for t in teeth)
        ratio *= driven / driving
    return ratio


def _kind(stated: Stated) -> str:
    text, place = stated.text("[printer] kinematics", KINDS)
    if text not in ("delta", "rotary_delta"):
        raise place.error("[printer] kinematics", text, KINDS)
    return text


def _delta(stated: Stated) -> Delta:
    return _towers(stated) if _kind(stated) == "delta" else _shoulders(stated)


def _towers(stated: Stated) -> Towers:
    radius = stated.number("[printer] delta_radius", "mm", low=1.0)
    rods = _each(stated, "arm_length", "mm, longer than the delta radius", low=radius) * MM
    angles = _each(stated, "angle", "degrees", (210.0, 330.0, 90.0))
    stops = _each(stated, "position_endstop", "the nozzle's height in mm") * MM
    return Towers(
        np.full(3, radius) * MM,
        rods,
        (angles - np.array([210.0, 330.0, 90.0])) * DEGREE,
        end_stops=stops + np.sqrt(rods**2 - (radius * MM) ** 2),
        reach=stated.number("[printer] print_radius", "mm", 0.6 * radius, 1.0) * MM,
    )


def _shoulders(stated: Stated) -> Shoulders:
    height = stated.number("[printer] shoulder_height", "mm", low=1.0) * MM
    return Shoulders(
        stated.number("[printer] shoulder_radius", "mm", low=1e-3) * MM,
        np.full(3, height),
        _each(stated, "upper_arm_length", "mm", low=1.0) * MM,
        _each(stated, "lower_arm_length", "mm", low=1.0) * MM,
        _each(stated, "angle", "degrees", (30.0, 150.0, 270.0)) * DEGREE,
    )
