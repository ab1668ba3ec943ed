"""A frame that deflects: robot and base sag under the payload."""

from __future__ import annotations

import casadi as ca

from parallel_cal.base.rotation import cayley
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter


class PayloadSag(Effect):
    """r_shown = W r + settle * F, R_shown = W R, W = exp(tilt * (r x F)), F = payload * g.

    `settle` (m/N): the frame sinks. `tilt` (rad/(N m)): it tilts by the moment of the weight about
    the origin of {B}. The device sees this if it stands on the floor, not on the frame.
    """

    needs = ("payload",)
    physics = "A frame on legs sinks under the payload, and tilts if the payload is off its centre."
    remedy = "stiffen the frame, or enter the payload in the model"
    source = "frames of machines 1e-8..1e-6 m/N and 1e-7..1e-5 rad/(N m)"
    lookalikes = (
        "joint_compliance",
        "rod_compliance",
        "ball_joint_clearance",
        "line_stretch",
        "base_compliance",
    )
    separated_by = "a second target on the frame, measured under several payloads"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return [
            Parameter("settle", "m/N", 0.0, 1e-6, low=0.0, high=1e-5),
            Parameter("tilt", "rad/(N m)", 0.0, 1e-5, low=0.0, high=1e-4),
        ]

    def applies(self, mechanism: Mechanism) -> str:
        falls = [a for a, g in zip("xyz", mechanism.gravity, strict=True) if g]
        return "" if {*falls} & {*mechanism.moves} else "the platform does not move along gravity"

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        weight = at["payload"] * ca.DM(mechanism.gravity)
        back = cayley(e.tilt * ca.cross(seen.r, weight)).T
        return seen.with_pose(back @ (seen.r - e.settle * weight), back @ seen.R)
