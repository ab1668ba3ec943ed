"""The linear Delta from rails, points and rods; it uses no other room."""

from __future__ import annotations

import numpy as np

from parallel_cal.virtual.robot import Array, Parameters, apply, axis_rotation
from parallel_cal.virtual.stewart import Assembly, column, numbered, vectors


class LinearDelta(Assembly):
    """Three carriages on rails, six rods to the platform: 3[P(2S/2S)] of table 3.1, 48 parameters.

    Like in the Delta (table 3.10), D is the vector from the middle of the platform's balls, moved
    to the base, to the carriage at reading zero. A rail is vertical (or leans outwards by
    `inclination`) except for small turns alpha about x, then beta about y. Chains are 120 degrees
    apart. Platform balls are at b +- d, carriage balls at +- (d + dC), rods Lb +- dLb long.
    """

    controls = "x y z"
    home = (0.0, 0.0, 0.1)
    home_joints = (0.33, 0.33, 0.33)

    def __init__(self, parameters: Parameters, inclination: float = 0.0) -> None:
        super().__init__(parameters)
        chains = numbered("chain", 3)

        def vector(name: str) -> Array:
            return vectors(parameters, [f"{name}_x", f"{name}_y", f"{name}_z"], chains)

        frame = axis_rotation("z", np.arange(3) * 2 * np.pi / 3)
        lean = axis_rotation("y", np.full(3, inclination))
        small = [
            axis_rotation(axis, column(parameters, n, chains))
            for axis, n in (("x", "alpha"), ("y", "beta"))
        ]
        self.rail = (frame @ lean @ small[0] @ small[1])[..., 2]
        middle, half, error = vector("b") + vector("D"), vector("d"), vector("dC")
        lengths = [
            column(parameters, "Lb", chains) + s * column(parameters, "dLb", chains)
            for s in (1, -1)
        ]
        self.carriages = [apply(frame, middle + s * (half + error)) for s in (1, -1)]
        self.balls = [apply(frame, vector("b") + s * half) for s in (1, -1)]
        self.rods = np.concatenate(lengths, -1)

    def ends(self, q: Array, r: Array, R: Array) -> tuple[Array, Array]:
        """Compute the rods' ends on carriages and platform, shape (..., 6 rods, 3) each."""
        slid = self.rail * q[..., None]
        platform = [r[..., None, :] + apply(R[..., None, :, :], ball) for ball in self.balls]
        return np.concatenate([c + slid for c in self.carriages], -2), np.concatenate(platform, -2)

    def gaps(self, q: Array, r: Array, R: Array, hidden: Array) -> Array:
        """Compute by how much each rod is too short to reach from ball to ball."""
        carriage, platform = self.ends(q, r, R)
        return np.linalg.norm(platform - carriage, axis=-1) - self.rods
