"""Writes `bags/models/`, the models a user starts from: `python test/helpers/make_baselines.py`.

Each is what `parallel-cal new MECHANISM` gives, with the noise that the instruments' data sheets
state; the robots hidden in the recordings are not looked at.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

from parallel_cal.model.file.modelfile import write_model
from parallel_cal.model.model import Model, Noise, new_model

MODELS = Path(__file__).resolve().parents[2] / "bags" / "models"
ARCSEC = math.radians(1 / 3600)
THESIS = Noise(joint=25 * ARCSEC, position=10e-6, orientation=15 * ARCSEC)
GIMBAL = 2.7 * 60 / 12**0.5 * ARCSEC  # steps of 2.7 arcmin
BASELINES = {
    "delta24": ("delta24", THESIS),
    "delta54_fine": ("delta54", Noise(5 * ARCSEC, 2e-6, 3 * ARCSEC)),
    "argos9": ("argos9", Noise(joint=25 * ARCSEC, orientation=GIMBAL)),
    "stewart42": ("stewart42", replace(THESIS, joint=3e-6)),
}


def baseline(name: str) -> Model:
    """A baseline as a model."""
    mechanism, noise = BASELINES[name]
    return replace(new_model(mechanism), noise=noise)


if __name__ == "__main__":
    for name in BASELINES:
        write_model(baseline(name), MODELS / f"{name}.yaml")
