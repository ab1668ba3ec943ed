"""A pose device whose base frame and target are not aligned with the robot's (5.5.1)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.rotation import (
    cayley,
    matrix_to_quaternion,
    quaternion_to_matrix,
    rot_x,
    rot_y,
    rot_z,
)
from parallel_cal.model.mechanism import POSE, Mechanism
from parallel_cal.model.parameters import Named, Parameter
from parallel_cal.model.sensor import Sensor

NO_TURN = (0.0, 0.0, 0.0, 1.0)
TOLERANCE = {"m": 2e-3, "rad": 0.035}


@dataclass(frozen=True)
class DeviceFrame(Sensor):
    """{B} -> {device} and {P} -> {target}, six numbers each around nominal frames, and the
    zeros of a gimbal x-y-z that measures the orientation: the nine of 5.5.1 for the Argos.

    Only coordinates that the mechanism moves have parameters, and {P} -> {target} only if the
    platform rotates: otherwise its shift equals the frame's shift. `gimbal` adds the three zeros.
    """

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quaternion: tuple[float, float, float, float] = NO_TURN
    target_position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    target_quaternion: tuple[float, float, float, float] = NO_TURN
    gimbal: bool = False
    fixed: tuple[str, ...] = ()

    physics = "measuring devices cannot be referenced perfectly to the robot's frames"
    source = "thesis 5.5.1 (nine additional parameters)"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        moves = [c for c in POSE if c in mechanism.moves]
        turns = any(c.startswith("r") for c in moves)
        # The frame rotates even if the platform does not; a platform at rest needs no shift.
        frame = POSE if {"x", "y", "z"} & {*moves} else POSE[3:]
        target = moves if turns else []
        names = [*(f"frame.{c}" for c in frame), *(f"target.{c}" for c in target)]
        names += [f"zero.{c}" for c in POSE[3:]] if self.gimbal else []
        units = {name: "rad" if name[-2] == "r" else "m" for name in names}
        return [Parameter(name, unit, 0.0, TOLERANCE[unit]) for name, unit in units.items()]

    def placed(
        self, f: np.ndarray, F: np.ndarray, t: np.ndarray, T: np.ndarray, R: np.ndarray
    ) -> DeviceFrame:
        return replace(
            self,
            position=tuple(f.tolist()),
            quaternion=tuple(matrix_to_quaternion(F).tolist()),
            target_position=tuple(t.tolist()),
            target_quaternion=tuple(matrix_to_quaternion(T).tolist()),
        )

    def pose(self, r: Any, R: Any, s: Named) -> tuple[Any, Any]:
        """{B}<-{P} = {B}<-{device} ({device}<-{target}) {target}<-{P}."""
        (f, F), (t, T) = self.frames(s)
        turned = F @ self._gimbal(R, s, +1) @ T.T
        return f + F @ r - turned @ t, turned

    def shown(self, r: Any, R: Any, s: Named) -> tuple[Any, Any]:
        (f, F), (t, T) = self.frames(s)
        return F.T @ (r + R @ t - f), self._gimbal(F.T @ R @ T, s, -1)

    def frames(self, s: Named) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
        """{B} -> {device} and {P} -> {target}: each a position (3,) and a rotation (3, 3)."""
        frame = _frame(s, "frame", self.position, self.quaternion)
        return frame, _frame(s, "target", self.target_position, self.target_quaternion)

    def _gimbal(self, R: Any, s: Named, sign: int) -> Any:
        """Add the zeros of the three encoders to the x-y-z angles of a rotation."""
        if not self.gimbal:
            return R
        angles = (
            ca.atan2(-R[1, 2], R[2, 2]),
            ca.atan2(R[0, 2], ca.sqrt(R[0, 0] ** 2 + R[0, 1] ** 2)),
            ca.atan2(-R[0, 1], R[0, 0]),
        )
        zeros = s.vector("zero.rx", "zero.ry", "zero.rz")
        a, b, c = (angle + sign * zeros[i] for i, angle in enumerate(angles))
        return rot_x(a) @ rot_y(b) @ rot_z(c)


def _frame(s: Named, name: str, position: Any, quaternion: Any) -> tuple[Any, Any]:
    """Return the nominal frame, shifted and rotated by its parameters; missing ones are zero."""

    def part(coordinates: tuple[str, ...]) -> Any:
        return ca.vertcat(*[s.get(f"{name}.{c}", 0) for c in coordinates])

    turn = cayley(part(POSE[3:])) @ ca.DM(quaternion_to_matrix(quaternion))
    return ca.DM(position) + part(POSE[:3]), turn
