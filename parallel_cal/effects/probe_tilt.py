"""A length gauge that is not perpendicular to the platform: it measures along a tilted line."""

from __future__ import annotations

from typing import Any

import casadi as ca

from parallel_cal.base.rotation import cayley
from parallel_cal.effects._touches import Touch, explain_no_tilt
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter
from parallel_cal.model.sensor import point_on_platform


class ProbeTilt(Touch):
    """R_ideal = R exp(tilt) about the tip: tilt of the stem about x and y of {P}, rad.

    For a gauge that is mounted on the platform (option of the sensor `probe`). If the platform does
    not tilt, the distance to the plate grows only by tilt^2 / 2, which cannot be identified.
    """

    reads = ("probe",)
    physics = (
        "A gauge whose stem is tilted meets the plate later: a cosine error that changes "
        "with the pose."
    )
    remedy = "clamp the gauge perpendicular to the plate; the robot is not the cause"
    source = "5-20 mrad as clamped: 10 mm at 0.1 rad of platform tilt are 5-20 um"
    lookalikes = ("probe_offset", "bed_shape")
    separated_by = "the same tilts of the platform, high and low, over one point of the plate"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return [Parameter(f"tilt_{a}", "rad", 0.0, 10e-3, low=-0.1, high=0.1) for a in "xy"]

    def applies(self, mechanism: Mechanism) -> str:
        return explain_no_tilt(mechanism)

    def at_sensor(self, r: Any, R: Any, s: Named, e: Named) -> tuple[Any, Any]:
        slanted = R @ cayley(ca.vertcat(e.tilt_x, e.tilt_y, 0))
        return point_on_platform(r, R, s) - slanted @ s.vector("tip.x", "tip.y", "tip.z"), slanted
