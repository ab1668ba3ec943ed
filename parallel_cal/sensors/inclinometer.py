"""An inclinometer or IMU on the platform: roll and pitch against gravity, never the heading."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.rotation import cayley, rotation_matrix
from parallel_cal.base.units import DEGREE
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter
from parallel_cal.model.sensor import Sensor

STEEPEST_PITCH = 70 * DEGREE  # beyond it, roll is hardly determined
FURTHEST_ROLL = 170 * DEGREE  # beyond it, the reading may jump by a turn


@dataclass(frozen=True)
class Inclinometer(Sensor):
    """Roll and pitch (rad) of the sensor against the vertical, in the axes of REP 103.

    u is the upward direction in the sensor: roll = atan2(u_y, u_z), pitch = -atan2(u_x,
    |(u_y, u_z)|). `rotation` (rad) is the rough rotation vector of the sensor in {P}: mount it so
    that |roll| stays below 170 and |pitch| below 70 degrees. Its mounting, and the tilt of {B}
    against the vertical, are identified.
    """

    rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sigma: float | None = 0.5e-3
    name: str = "inclinometer"
    fixed: tuple[str, ...] = ("up.*",)

    physics = "two axes of an inclinometer, or the mean acceleration of an IMU at rest"
    source = "MEMS inclinometers 0.01-0.1 degrees (Murata SCL3300); IMUs of robots 1-5 mrad"
    guessed_sigma = 1e-3
    unit = "rad"
    reads_always = True

    @property
    def channels(self) -> tuple[str, ...]:
        return f"{self.name}.roll", f"{self.name}.pitch"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        size = float(np.linalg.norm(mechanism.gravity))
        if not size:
            raise ModelError(f"{self.name}: the model file states no gravity to measure")
        up = -np.array(mechanism.gravity) / size
        across = [k for k in range(3) if abs(up[k]) < 0.9]
        return [
            *[Parameter(f"up.{a}", "1", float(v), 0.01) for a, v in zip("xyz", up, strict=True)],
            *[Parameter(f"base.r{'xyz'[k]}", "rad", 0.0, 0.5 * DEGREE) for k in across[:2]],
            *[Parameter(f"mount.r{a}", "rad", 0.0, 1 * DEGREE) for a in "xyz"],
        ]

    def readings(self, r: Any, R: Any, s: Named) -> Any:
        base = ca.vertcat(*(s.get(f"base.r{a}", 0.0) for a in "xyz"))
        mount = ca.vertcat(*(s[f"mount.r{a}"] for a in "xyz"))
        R_sensor = R @ ca.DM(rotation_matrix(np.array(self.rotation))) @ cayley(mount)
        u = R_sensor.T @ cayley(base) @ s.vector("up.x", "up.y", "up.z")
        level = ca.norm_2(ca.vertcat(u[1], u[2]))
        return ca.vertcat(ca.atan2(u[1], u[2]), -ca.atan2(u[0], level))

    def find_visible(self, readings: np.ndarray) -> np.ndarray:
        roll, pitch = np.abs(readings).T
        seen = (roll < FURTHEST_ROLL) & (pitch < STEEPEST_PITCH)
        return np.repeat(seen[:, None], 2, axis=1)
