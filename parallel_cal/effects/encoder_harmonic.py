"""Encoder ring pulled out of round by its screws or read by several heads: n times per turn."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from parallel_cal.effects._joints import Harmonic
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Parameter

ORDERS = range(3, 9)  # 1 and 2 are effects of their own; higher orders are poles and gears


class EncoderHarmonic(Harmonic):
    """q_ideal = q + sin * sin(order q) + cos * cos(order q) for every revolute joint (rad).

    One integer `order` for all joints: known (the number of screws or pole pairs), or found by
    `scan`. The ripple of a gear does not have to repeat once per turn of the joint, and it has
    harmonics: that is `gear_transmission_error`.
    """

    fixed = ("order",)
    refines = False
    physics = (
        "A ring that n screws deform, or a magnet with n pole pairs, misreads n times per turn."
    )
    remedy = (
        "loosen the ring's screws and tighten them crosswise, or keep the correction in the model"
    )
    source = "ring encoders on 3-8 screws and magnet rings: 0.05-0.3 mrad"
    lookalikes = ("encoder_second_harmonic", "encoder_eccentricity", "gear_transmission_error")
    order, tolerance = 3, 0.3e-3

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        order = Parameter(
            "order", "1", self.order, 20.0, low=1.0, high=200.0, label="waves per turn"
        )
        return [order, *super().parameters(mechanism)]

    def scan(
        self, mechanism: Mechanism, recorded: Mapping[str, Any]
    ) -> Iterator[Mapping[str, float]]:
        """Return every order that mountings cause."""
        return ({"order": float(order)} for order in ORDERS)

    def period(self, setting: Mapping[str, float]) -> float:
        return 2 * np.pi / setting["order"]
