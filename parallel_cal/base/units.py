"""Units: their names and SI factors, and the units in which people read a quantity.

Files and messages hold SI units. Other units come from tables and controllers, and go to screens.
"""

from __future__ import annotations

import math
from typing import Any, Literal

Length = Literal["m", "cm", "mm", "um", "nm", "in", "ft", "mil"]
Angle = Literal["rad", "mrad", "deg", "arcmin", "arcsec", "gon", "rev"]

# name -> m
LENGTHS: dict[str, float] = {
    "m": 1.0,
    "cm": 1e-2,
    "mm": 1e-3,
    "um": 1e-6,
    "nm": 1e-9,
    "in": 0.0254,
    "ft": 0.3048,
    "mil": 25.4e-6,
}
# name -> rad
ANGLES: dict[str, float] = {
    "rad": 1.0,
    "mrad": 1e-3,
    "deg": math.pi / 180,
    "arcmin": math.pi / 10_800,
    "arcsec": math.pi / 648_000,
    "gon": math.pi / 200,
    "rev": 2 * math.pi,
}
UNITS = ANGLES | LENGTHS
PIXEL = "px"  # of readings in an image: no length
UNIT_ALIASES = {
    "°": "deg",
    "degree": "deg",
    "degrees": "deg",
    "radian": "rad",
    "radians": "rad",
    "revolutions": "rev",
    "turns": "rev",
    "grad": "gon",
    "µm": "um",
    "μm": "um",
    "micrometers": "um",
    "micrometres": "um",
    "microns": "um",
    "micron": "um",
    "inch": "in",
    "inches": "in",
    "feet": "ft",
    "foot": "ft",
    "mils": "mil",
    "thou": "mil",
    "millimeters": "mm",
    "millimetres": "mm",
    "millimeter": "mm",
    "millimetre": "mm",
    "centimeters": "cm",
    "centimetres": "cm",
    "meters": "m",
    "metres": "m",
    "meter": "m",
    "metre": "m",
}
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
MAX_TIME_S = 1e11  # from 1970 to the year 5138; times of clocks in ms, us or ns are larger
# SI unit of a condition -> unit in a table -> factor and offset to SI.
CONDITION_UNITS: dict[str, dict[str, tuple[float, float]]] = {
    "s": {
        **{unit: (seconds, 0.0) for unit, seconds in SECONDS.items()},
        "min": (60.0, 0.0),
        "h": (3600.0, 0.0),
    },
    "degC": {"degC": (1.0, 0.0), "K": (1.0, -273.15), "degF": (5 / 9, -160 / 9)},
    "kg": {"kg": (1.0, 0.0), "g": (1e-3, 0.0), "lb": (0.45359237, 0.0)},
}
CONDITION_UNIT_ALIASES = {
    "°c": "degC",
    "c": "degC",
    "celsius": "degC",
    "degc": "degC",
    "k": "K",
    "kelvin": "K",
    "°f": "degF",
    "f": "degF",
    "degf": "degF",
    "fahrenheit": "degF",
    "sec": "s",
    "seconds": "s",
    "msec": "ms",
    "minutes": "min",
    "hours": "h",
    "grams": "g",
    "lbs": "lb",
}
MM = LENGTHS["mm"]
DEGREE, ARCMIN, ARCSEC = ANGLES["deg"], ANGLES["arcmin"], ANGLES["arcsec"]

# SI unit -> (unit, factor from SI) in which people read errors, and values such as lengths.
SMALL_UNITS = {
    "m": ("um", 1 / UNITS["um"]),
    "rad": ("arcmin", 1 / UNITS["arcmin"]),
    "px": ("px", 1.0),
}
LARGE_UNITS = {"m": ("mm", 1 / UNITS["mm"]), "rad": ("deg", 1 / UNITS["deg"])}

ERROR_SI_UNITS = {"position": "m", "orientation": "rad", "reading": "m", "pixel": "px"}
ERROR_UNITS = {kind: SMALL_UNITS[unit] for kind, unit in ERROR_SI_UNITS.items()}


def si_factor(name: str) -> float:
    """Return what one of a unit is in m or rad; KeyError for an unknown name."""
    return UNITS[UNIT_ALIASES.get(name, name)]


def find_clock_unit(times: Any) -> str:
    """Return the unit (s, ms, us or ns) of a clock's times since 1970, which follows from their
    usual size; s for smaller times."""
    import numpy as np  # commands that read no table need not wait for it

    size = float(np.median(np.abs(times))) if np.size(times) else 0.0
    fits = (unit for unit, seconds in SECONDS.items() if size * seconds < MAX_TIME_S)
    return next(fits, "ns")
