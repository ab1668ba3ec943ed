"""Base or measuring device that creeps during the session: the whole picture moves with time."""

from __future__ import annotations

from typing import Any

import casadi as ca

from parallel_cal.base.rotation import cayley
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter

AXES = "xyz"


class BaseDrift(Effect):
    """r_shown = r + (v + w x r) t, R_shown = exp(w t) R, t (s) since the recording began.

    v (m/s) and w (rad/s) of {B} as the device sees it, about axes of {B}; only what moves the
    platform along or about a coordinate that it has.
    """

    needs = ("time",)
    of_device = True
    physics = "A stand, tripod or frame creeps against the device as it settles and warms up."
    source = "tens of um in a session of some hours, up to 0.1 um/s while warming up"
    lookalikes = ("thermal_expansion", "zero_shift")
    separated_by = "a temperature that is not monotone in time; first poses measured again at last"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        moves = mechanism.moves
        turns = [a for a in AXES if f"r{a}" in moves or {*AXES} - {a} <= {*moves}]
        return [
            *[
                Parameter(f"v_{a}", "m/s", 0.0, 1e-7, low=-1e-6, high=1e-6)
                for a in AXES
                if a in moves
            ],
            *[Parameter(f"w_{a}", "rad/s", 0.0, 3e-7, low=-3e-6, high=3e-6) for a in turns],
        ]

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        v, w = (_vector(e, name) for name in "vw")
        turn = cayley(w * at.time)
        return seen.with_pose(turn.T @ (seen.r - v * at.time), turn.T @ seen.R)


def _vector(e: Named, name: str) -> Any:
    return ca.vertcat(*[e.get(f"{name}_{a}", 0) for a in AXES])
