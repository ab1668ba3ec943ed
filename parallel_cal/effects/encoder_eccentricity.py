"""Encoder disc mounted off its axis: a joint error once per turn."""

from __future__ import annotations

from parallel_cal.effects._joints import Harmonic


class EncoderEccentricity(Harmonic):
    """q_ideal = q + sin * sin q + cos * cos q for every joint that turns (rad)."""

    physics = (
        "An encoder disc whose centre is off the axis by e misreads by e/r once per turn, "
        "at radius r."
    )
    remedy = "centre the disc, or read it with two opposite heads"
    source = "encoder mounting tolerance: 10-40 um on a 25 mm radius is 0.4-1.6 mrad"
    lookalikes = ("encoder_second_harmonic", "encoder_harmonic", "encoder_gain")
    order, tolerance = 1, 1e-3
