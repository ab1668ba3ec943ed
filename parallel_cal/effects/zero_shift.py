"""Joints that were homed again between two recordings: their zeros have shifted."""

from __future__ import annotations

from typing import Any

from parallel_cal.effects._joints import shift_joints, sizes
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter

LATER_SESSIONS = (1, 2, 3)  # may begin with a shift; the zero of session 0 is in the geometry
SIZE = {"rad": (0.5e-3, 5e-3), "m": (50e-6, 0.5e-3)}  # tolerance and upper bound of homing errors


class ZeroShift(Effect):
    """q_ideal = q + sum of since_k over the sessions k = 1, 2, 3 that have begun, for every joint.

    `since1` shifts the second session and those after it. Free `since2` and `since3` if there are a
    third and a fourth session: a shift that affects no sample cannot be identified.
    """

    needs = ("session",)
    fixed = tuple(f"*.since{k}" for k in LATER_SESSIONS[1:])
    physics = "Homing reproduces a joint's zero only as well as its switch repeats."
    remedy = (
        "home against an index mark or a better switch; after homing, fit the zeros again "
        "from a few poses"
    )
    source = "reference switches repeat within 10-100 um"
    lookalikes = ("base_drift", "thermal_expansion", "device_bump")
    separated_by = "some poses measured both at the beginning and at the end of every session"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return [
            Parameter(f"{joint}.since{k}", unit, 0.0, tolerance, low=-most, high=most)
            for joint, unit, (tolerance, most) in sizes(mechanism, SIZE)
            for k in LATER_SESSIONS
        ]

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        def error(joint: str, q: Any) -> Any:
            return sum(e[joint][f"since{k}"] * (at.session >= k) for k in LATER_SESSIONS)

        return shift_joints(seen, mechanism, mechanism.joints, error)
