"""A drive that winds up after each reversal before it follows: backlash with rounded corners."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import casadi as ca

from parallel_cal.effects._joints import shift_joints
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter

LAG = {"rad": (0.3e-3, 3e-3), "m": (10e-6, 0.1e-3)}  # tolerance and upper bound of real drives
WIDTH = {"rad": 20e-3, "m": 0.3e-3}  # travel after which most of the lag has built up


class Hysteresis(Effect):
    """q_ideal = q - lag * tanh(travel / width) for every joint, travel since its last reversal.

    `width` is known, or found by `scan`. For moves much longer than `width`, the lag cannot be
    distinguished from a backlash of 2 lag.
    """

    needs = ("travel",)
    fixed = ("*.width",)
    alike = ("*.lag",)
    physics = (
        "Friction winds up an elastic drive, so the drive lags behind after the joint has reversed."
    )
    remedy = "measure the joint behind the drive, or approach all poses along the same path"
    source = "harmonic drives: 0.3-0.6 mrad between the two directions"
    lookalikes = ("backlash", "latency")
    separated_by = "the same poses approached from both directions, by short and by long moves"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        joints = zip(mechanism.joints, mechanism.joint_units, strict=True)
        return [p for joint, unit in joints for p in _make_joint_parameters(joint, unit)]

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        def error(joint: str, q: Any) -> Any:
            return -e[joint].lag * ca.tanh(at["travel"][joint] / e[joint].width)

        return shift_joints(seen, mechanism, mechanism.joints, error)

    def absurd(self, e: Named, mechanism: Mechanism) -> str:
        for joint in mechanism.joints:
            lag, width = float(e[joint].lag), float(e[joint].width)
            if lag > width:
                return (
                    f"hysteresis.{joint}.lag would have to be {lag:.3g}, built up in {width:.3g}: "
                    "the joint would turn back while its drive continues"
                )
        return ""

    def scan(
        self, mechanism: Mechanism, recorded: Mapping[str, Any]
    ) -> Iterator[Mapping[str, float]]:
        """Return widths in steps of a factor of 3: closer widths have nearly the same shape."""
        joints = list(zip(mechanism.joints, mechanism.joint_units, strict=True))
        for factor in (1, 1 / 3, 1 / 9):
            yield {f"{joint}.width": factor * WIDTH[unit] for joint, unit in joints}


def _make_joint_parameters(joint: str, unit: str) -> list[Parameter]:
    tolerance, highest = LAG[unit]
    width = WIDTH[unit]
    return [
        Parameter(f"{joint}.lag", unit, 0.0, tolerance, low=0.0, high=highest),
        Parameter(
            f"{joint}.width",
            unit,
            width,
            width / 10,
            low=width / 9,
            label="travel over which it builds up",
        ),
    ]
