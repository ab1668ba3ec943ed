"""Presets of the Argos mock-up, two Stewart platforms and a cable robot, for make_presets.py.

Argos tables as printed in P. Vischer, Improving the Accuracy of Parallel Robots, EPFL thesis
1570 (1996): mm and degrees, one row a chain, "-" where a chain has no such parameter.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from decimal import Decimal
from typing import Any

import numpy as np

from parallel_cal.mechanisms.stewart42 import leg_parameters
from parallel_cal.model.mechanism import Home, Mechanism
from parallel_cal.model.model import Model, Noise, new_model
from parallel_cal.model.shelf import load_mechanism

THESIS = "P. Vischer, Improving the Accuracy of Parallel Robots, EPFL 1996"
HP4 = "github.com/tobbelobb/auto-calibration-simulation-for-hangprinter, commit 00be0787"

# Sections 2.3.2, 2.4.2 and 4.3: encoders 25 arcsec; probes 1.9 um; gimbal steps of 2.7 arcmin.
ARGOS_NOISE = Noise(
    joint=math.radians(25 / 3600),
    position=1.9e-6,
    orientation=math.radians(2.7 / 60) / math.sqrt(12),
)
# A millimetre of the camera; 0.35 rad let out a millimetre of line A, B or C: lines, not encoders.
HP4_NOISE = Noise(joint=0.35, position=1e-3, assumed=True)
SPHERICAL, SPATIAL = "alpha0 Omega Phi omega phi", "dA dC da dc gamma dR R"
LENGTHS = {"dA", "dC", "da", "dc", "dR", "R"}

TABLE_5_21 = (
    "-45  -  -  -   -",
    " 45  - 90  -  90",
    "-45 90 90 90 -90",
)
TABLE_5_22 = (
    "-44.02     -     -     -      -",
    " 47.89     - 91.27     -  89.82",
    "-42.17 90.45 91.85 91.18 -87.56",
)
# The angles of chain 3 are missing in the scan: here they are the nominal ones of table 5.21.
TABLE_5_25 = (
    "-39.33     -     -     -      -      -     -  2.39  -3.20 94.85 -4.95 105.86",
    " 44.17     - 89.57     -  90.43      -  1.00  4.65 -10.14 92.47 13.56  98.31",
    "-45       90    90    90 -90      0.32 -0.05  2.19   1.79 91.89 -0.86 107.85",
)

# A Stewart platform without symmetry, balls out of plane (mm): base and platform, leg by leg.
GENERAL_BASE = "262 -38 12; 238 61 -25; -72 251 31; -181 170 -8; -149 -213 22; -95 -228 -34"
GENERAL_PLATFORM = "88 -121 9; 110 102 -16; 61 149 21; -139 34 -12; -158 -25 18; 43 -133 -7"


def models() -> dict[str, Model]:
    """The presets by file name."""
    return {
        "argos_mockup_nominal": _argos(
            "argos_nominal",
            "alpha0",
            [row.split()[0] for row in TABLE_5_21],
            "table 5.21",
            "Argos mock-up as designed: everything at right angles",
        ),
        "argos9_mockup_identified": _argos(
            "argos9",
            SPHERICAL,
            TABLE_5_22,
            "table 5.22",
            "Argos mock-up as identified with model 9 from 47 orientations",
        ),
        "argos27_mockup_identified": _argos(
            "argos27",
            f"{SPHERICAL} {SPATIAL}",
            TABLE_5_25,
            "table 5.25",
            "Argos mock-up as identified with model 27 from 47 full poses; alpha0, Omega, Phi, "
            "omega and phi of chain 3 are illegible in our copy and nominal here (table 5.21)",
        ),
        "stewart_planar": _described(
            new_model("stewart42"), "Stewart platform with two flat hexagons, a common design"
        ),
        "stewart_general": _described(
            new_model(_general_stewart()), "Stewart platform without symmetry, balls out of plane"
        ),
        "hangprinter_hp4": _described(
            replace(new_model(_hangprinter()), noise=HP4_NOISE),
            "Hangprinter HP4: rough values as its maker gives them; nobody measured the noise",
            HP4,
        ),
    }


def _argos(name: str, names: str, rows: Any, table: str, about: str) -> Model:
    model = new_model(name, _table(names, rows))
    return _described(replace(model, noise=ARGOS_NOISE), about, f"{THESIS}, {table}")


def _table(names: str, rows: Any) -> dict[str, float]:
    """Printed rows in SI units under the package's names."""
    return {
        f"chain{i}.{name}": _si(name, number)
        for i, row in enumerate(rows, start=1)
        for name, number in zip(names.split(), row.split(), strict=True)
        if number != "-"
    }


def _si(name: str, number: str) -> float:
    # Decimal: 2.39 mm is 0.00239 m, not the nearest number to a product.
    return float(Decimal(number).scaleb(-3)) if name in LENGTHS else math.radians(float(number))


def _general_stewart() -> Mechanism:
    base, platform = (_points(text) for text in (GENERAL_BASE, GENERAL_PLATFORM))
    mechanism = load_mechanism("stewart42")
    retracted, height = 0.25, 0.3
    legs = np.linalg.norm(platform + [0, 0, height] - base, axis=1)
    mechanism.parameters = leg_parameters(platform, base, retracted)
    # Rounded: this is where solvers start, not a measured fact.
    joints = tuple(float(v) for v in np.round(legs - retracted, 6))
    mechanism.home = Home(joints=joints, position=(0.0, 0.0, height))
    return mechanism


def _points(text: str) -> np.ndarray:
    return np.array([[float(v) / 1e3 for v in point.split()] for point in text.split(";")])


def _hangprinter() -> Mechanism:
    mechanism = load_mechanism("cable")
    mechanism.joints = ("motorA", "motorB", "motorC", "motorD")
    return mechanism


def _described(model: Model, about: str, source: str = "") -> Model:
    step: Mapping[str, str] = {
        "step": "published" if source else "designed",
        **({"source": source} if source else {}),
        "description": about,
    }
    return replace(model, history=(dict(step),))
