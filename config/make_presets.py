"""Writes the presets in this folder: `python config/make_presets.py [--check]`.

The numbers are those of P. Vischer, Improving the Accuracy of Parallel Robots, EPFL thesis 1570
(1996), typed as printed there: mm and degrees, one row a chain.
"""

from __future__ import annotations

import math
import re
import sys
from dataclasses import replace
from decimal import Decimal
from pathlib import Path

from presets_argos_stewart import models as others

from parallel_cal.base.files import write_atomically
from parallel_cal.model.file.modelfile import dump_model
from parallel_cal.model.model import Model, Noise, new_model

HERE = Path(__file__).resolve().parent
ARCSEC = math.radians(1 / 3600)
# Sections 2.3.2 and 4.2: encoders 25 arcsec, device 10 um and 15 arcsec.
NOISE = Noise(joint=25 * ARCSEC, position=10e-6, orientation=15 * ARCSEC)

POSITION = "D_x D_y D_z theta alpha La_x La_y Lb"
COMPLETE = f"{POSITION} d_z dalpha dbeta dC_x dC_y dC_z dLb b_x b_y b_z"
ANGLES = {"theta", "alpha", "dalpha", "dbeta"}

# D_x is illegible in the scan; with 76 mm the tables give the errors that table 5.15 measured.
TABLE_5_12 = (
    "76 -16.5 0   0 90 119.963 -3 240   20 0 0  0 0 0 0  24 0 0",
    "76 -16.5 0 120 90 119.963 -3 240   20 0 0  0 0 0 0  24 0 0",
    "76 -16.5 0 240 90 119.963 -3 240   20 0 0  0 0 0 0  24 0 0",
)
TABLE_5_13 = (
    "75.949 -16.41  0.404   0.064 89.881 119.960 -3.702 240.130",
    "76.141 -16.709 0.182 120.008 90.044 119.933 -3.204 240.067",
    "76.023 -16.624 0.062 239.998 90.010 119.990 -2.672 239.949",
)
TABLE_5_18 = (
    "75.902 -16.318 -0.642  -0.517 89.513 119.967 -3.693 240.074"
    "   20  0.343 0.582 -0.023 -0.005 -0.006  0.092  24 0 0",
    "76.116 -16.716 -0.793 119.372 90.263 119.943 -3.236 240.108"
    "   20 -0.235 0.610 -0.049  0.069  0.023  0.009  24 0 0",
    "76.063 -16.792 -0.658 239.573 90.093 119.976 -2.673 240.009"
    "   20 -0.080 0.404 -0.049  0.076 -0.012 -0.062  24 0 0",
)
PRESETS = {
    "delta_mockup_nominal": (
        "delta54",
        COMPLETE,
        TABLE_5_12,
        "table 5.12",
        "Delta mock-up as designed, which is what its controller believes",
    ),
    "delta_mockup_identified": (
        "delta54",
        COMPLETE,
        TABLE_5_18,
        "table 5.18",
        "Delta mock-up as identified with model 54 from 74 full poses",
    ),
    "delta24_mockup_identified": (
        "delta24",
        POSITION,
        TABLE_5_13,
        "table 5.13",
        "Delta mock-up as identified with model 24 from 74 positions",
    ),
}


def values_of(names: str, rows: tuple[str, ...]) -> dict[str, float]:
    """A table in SI units under the package's names."""
    return {
        f"chain{i}.{name}": _si(name, number)
        for i, row in enumerate(rows, start=1)
        for name, number in zip(names.split(), row.split(), strict=True)
    }


def _si(name: str, number: str) -> float:
    # Decimal: 0.116 mm is 0.000116 m and not 0.00011600000000000001 m.
    return math.radians(float(number)) if name in ANGLES else float(Decimal(number).scaleb(-3))


def preset(name: str) -> Model:
    """One preset as a model, its origin in its history."""
    mechanism, names, rows, table, about = PRESETS[name]
    step = {
        "step": "published",
        "source": f"P. Vischer, Improving the Accuracy of Parallel Robots, EPFL 1996, {table}",
        "description": about,
    }
    return replace(new_model(mechanism, values_of(names, rows)), noise=NOISE, history=(step,))


def main(arguments: list[str]) -> int:
    """Write the presets, or with --check say which differ from what would be written."""
    different = 0
    for name, model in {**{name: preset(name) for name in PRESETS}, **others()}.items():
        path, text = HERE / f"{name}.yaml", dump_model(model)
        if "--check" not in arguments:
            write_atomically(path, text)
        elif not path.exists() or _rounded(path.read_text(encoding="utf-8")) != _rounded(text):
            different += 1
            sys.stderr.write(f"{path} differs\n")
    return int(different > 0)


def _rounded(text: str) -> str:
    """A model file with its numbers to twelve digits: a sine's last bit differs by machine."""
    return re.sub(r"-?\d+\.\d+(e-?\d+)?", lambda number: f"{float(number[0]):.12g}", text)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
