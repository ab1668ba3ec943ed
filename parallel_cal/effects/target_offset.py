"""A measured point that is not the platform's origin: it moves when the platform rotates."""

from __future__ import annotations

import casadi as ca

from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter

AXES = "xyz"


class TargetOffset(Effect):
    """r_shown = r + R o: the device shows the point o (m) of {P} instead of its origin.

    Free parameters for points of the platform cannot be distinguished from o: keep them fixed. An
    offset along the only axis of rotation is a constant shift and has no effect.
    """

    of_device = True
    physics = (
        "A reflector or stylus is never mounted exactly at the model's origin of the platform."
    )
    remedy = "enter where the target is mounted; the robot is not the cause"
    source = "0.01-1 mm, as the target's mount was made or measured"
    lookalikes = ("encoder_crosstalk", "parallelogram_errors")
    separated_by = "one position in several orientations that differ as far as the robot can turn"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        turns = {c[1] for c in mechanism.moves if c.startswith("r")}
        return [
            Parameter(f"o_{a}", "m", 0.0, 0.5e-3, low=-5e-3, high=5e-3) for a in AXES if turns - {a}
        ]

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        offset = ca.vertcat(*[e.get(f"o_{a}", 0) for a in AXES])
        return seen.with_pose(seen.r - seen.R @ offset, seen.R)

    def applies(self, mechanism: Mechanism) -> str:
        turns = [c for c in mechanism.moves if c.startswith("r")]
        if not turns:
            return "the platform does not rotate"
        return "" if len(turns) < len(mechanism.moves) else "the platform only rotates"
