"""Encoder disc tilted or out of round: a joint error twice per turn."""

from __future__ import annotations

from parallel_cal.effects._joints import Harmonic


class EncoderSecondHarmonic(Harmonic):
    """q_ideal = q + sin * sin 2q + cos * cos 2q for every joint that turns (rad)."""

    physics = "An encoder disc or magnet that is tilted or oval misreads twice per turn."
    remedy = "align the disc or magnet at right angles to its axis, or read it with two heads"
    source = "tilt of 1-2 degrees (tan(tilt)^2 / 4) or a pole ring oval by 20 um: 0.1-0.5 mrad"
    lookalikes = ("encoder_eccentricity", "encoder_harmonic", "encoder_gain")
    order, tolerance = 2, 0.5e-3
