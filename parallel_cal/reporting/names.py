"""The names of effects for people: `gain of the drives` for `encoder_gain`.

The command line and files use the names of the catalogue; the page shows these. It needs neither
NumPy nor CasADi, so that the page can use it.
"""

from __future__ import annotations

import re
from collections.abc import Collection

TITLES = {
    "acceleration_lag": "lag with the acceleration",
    "ball_joint_clearance": "clearance of the ball joints",
    "base_compliance": "flexible base",
    "base_drift": "drift of the base",
    "bed_shape": "shape of the bed",
    "device_axes": "axes of the device",
    "device_bump": "bump of the device",
    "device_field": "field of the device",
    "encoder_crosstalk": "crosstalk of the encoders",
    "encoder_eccentricity": "eccentric encoders",
    "encoder_gain": "gain of the drives",
    "encoder_harmonic": "harmonic of the encoders",
    "encoder_interpolation": "interpolation of the encoders",
    "encoder_second_harmonic": "second harmonic of the encoders",
    "gear_transmission_error": "ripple of the gears",
    "joint_compliance": "flexible joints",
    "line_creep": "creep of the lines",
    "line_flex": "flexible lines",
    "line_sag": "sag of the lines",
    "line_stretch": "stretch of the lines",
    "load_friction": "friction with the load",
    "own_weight_sag": "sag by its own weight",
    "parallelogram_errors": "unequal parallelograms",
    "payload_sag": "sag by the payload",
    "probe_offset": "offset of the probe",
    "probe_tilt": "tilt of the probe",
    "pulley_radius": "radius of the pulleys",
    "rod_compliance": "flexible rods",
    "screw_pitch_error": "uneven screws, drums or pulleys",
    "servo_lag": "lag of the servos",
    "spool_buildup": "build-up on the spools",
    "strain_wave_compliance": "flexible strain-wave gears",
    "strain_wave_ripple": "ripple of the strain-wave gears",
    "strut_rotation": "rotation of the struts",
    "target_offset": "offset of the target",
    "thermal_expansion": "thermal expansion",
    "thermal_expansion_by_part": "thermal expansion by part",
    "universal_joint_offset": "offset of the universal joints",
    "zero_shift": "shift of the zeros",
}
# The settings with which an effect begins, such as "backlash:*.width=0.0003".
_SETTINGS = re.compile(r"(?<=\w):\S+=\S+")
_NAMES = re.compile(rf"\b({'|'.join(sorted(TITLES, key=len, reverse=True))})\b(?!\.)")


def title_of(effect: str) -> str:
    """Name an effect for people; one that is not in the catalogue keeps its words."""
    return TITLES.get(effect, effect.replace("_", " "))


def name_effects(text: str) -> str:
    """Replace the names of effects in a text by those for people."""
    return _NAMES.sub(lambda match: TITLES[match[1]], text)


def name_step(step: str) -> str:
    """Name a step of a session for people: without the settings with which an effect began."""
    return name_effects(_SETTINGS.sub("", step))


def name_setting(key: str, beside: Collection[str] = ()) -> str:
    """Name a number of an effect for people: `ratio of joint2` for `joint2.ratio`, `ratio` for what
    all joints have, and `ratio of the others` `beside` such a number."""
    joint, _, name = key.rpartition(".")
    others = any(one.endswith(f".{key}") for one in beside)
    return f"{name} of {joint}" if joint else f"{name} of the others" if others else name
