"""A tip at another point of the platform than in the model: tilting moves it up or down."""

from __future__ import annotations

from typing import Any

from parallel_cal.effects._touches import Touch, explain_no_tilt
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter


class ProbeOffset(Touch):
    """r_ideal = r + R o, o (m) of {P} from the tip as stated to the one that touches.

    Points of the platform that are free
    parameters move along with o and hide it: keep them fixed.
    """

    reads = ("probe", "plane", "sphere*")
    physics = (
        "A probe beside the nozzle, or a changed stylus, touches at another point than the "
        "stated tip."
    )
    remedy = "measure where the tip is, and enter its position; the robot is not the cause"
    source = "0.1-1 mm as mounted; styli are qualified to 2 um on a sphere"
    lookalikes = ("bed_shape", "probe_tilt")
    separated_by = "one point of the plate touched with the platform tilted to all sides"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return [Parameter(f"o_{a}", "m", 0.0, 0.5e-3, low=-5e-3, high=5e-3) for a in "xyz"]

    def applies(self, mechanism: Mechanism) -> str:
        return explain_no_tilt(mechanism)

    def at_sensor(self, r: Any, R: Any, s: Named, e: Named) -> tuple[Any, Any]:
        return r + R @ e.vector("o_x", "o_y", "o_z"), R
