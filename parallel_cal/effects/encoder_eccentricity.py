"""Encoder disc mounted off its axis: a joint error once per turn."""

from __future__ import annotations

from parallel_cal.effects._joints import Harmonic


class EncoderEccentricity(Harmonic):
    """q_ideal = q + sin * sin q + cos * cos q for every joint that turns (rad)."""

    physics = "An encoder disc off its axis by e at radius r misreads e/r once per turn."
    remedy = "centre the disc, or read it by two heads opposite each other"
    source = "encoder mounting tolerance: 10-40 um on a 25 mm radius is 0.4-1.6 mrad"
    lookalikes = ("encoder_second_harmonic", "encoder_harmonic", "encoder_gain")
    order, tolerance = 1, 1e-3
