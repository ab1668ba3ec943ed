"""The robots of a virtual cell: as drawn, as built, with their drives and instruments."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from parallel_cal.virtual.argos import TABLE_5_21, Argos
from parallel_cal.virtual.drive import Limits
from parallel_cal.virtual.linear_delta import LinearDelta
from parallel_cal.virtual.robot import ARCSEC, TABLE_5_12, Array, Delta, Noise, Parameters
from parallel_cal.virtual.stewart import Stewart

MM, DEGREE = 1e-3, np.pi / 180


@dataclass(frozen=True, eq=False)
class Machine:
    """A kind of robot: nominal dimensions, and how far manufacturing deviates from them.

    `spread` is 1 sigma of a dimension (m, rad), by its name without the chain; a dimension without
    entry is exact. `lever` (m per unit of a joint) converts errors of revolute joints to those of
    sliding ones.
    """

    kind: Callable[[Parameters], Any]
    nominal: Mapping[str, float]
    spread: Mapping[str, float]
    joints: tuple[str, ...]
    limits: Limits
    noise: Noise = field(default_factory=Noise)
    lever: float = 1.0
    sees_position: bool = True

    def make_nominal(self) -> Any:
        """Make the robot with nominal dimensions, as its controller assumes."""
        return self.kind(self.nominal)

    def make_built(self, seed: int) -> Any:
        """Make a robot with random errors in all dimensions."""
        rng = np.random.default_rng([seed, 41])
        built = {
            name: value + self.spread.get(name.split(".")[1], 0.0) * rng.standard_normal()
            for name, value in self.nominal.items()
        }
        return self.kind(built)


def ring(radius: float, degrees: ArrayLike) -> Array:
    """Place points on a circle in the plane z = 0."""
    angle = np.radians(degrees)
    return radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))], -1)


def hexapod(error: float, seed: int = 0) -> dict[str, float]:
    """Make balls in pairs on circles of 0.15 and 0.25 m, and legs of 0.25 m, with errors (m)."""
    rng = np.random.default_rng(seed)
    rows = {
        "B": ring(0.15, [-50, 50, 70, 170, 190, 290]),
        "C": ring(0.25, [-10, 10, 110, 130, 230, 250]),
    }
    parameters = {
        f"leg{i + 1}.{name}_{axis}": round(float(value + error * rng.normal()), 12)
        for name, points in rows.items()
        for i, point in enumerate(points)
        for axis, value in zip("xyz", point, strict=True)
    }
    return parameters | {f"leg{i}.L0": round(0.25 + error * rng.normal(), 12) for i in range(1, 7)}


RAIL = dict.fromkeys("D_y D_z alpha beta dC_x dC_y dC_z dLb d_x d_z b_y b_z".split(), 0.0)
RAIL |= {"D_x": 0.1, "Lb": 0.25, "d_y": 0.025, "b_x": 0.03}
RAILS = {f"chain{i}.{name}": value for i in (1, 2, 3) for name, value in RAIL.items()}

PLACED = dict.fromkeys(("D_x", "D_y", "D_z"), 0.4 * MM)
PAIRED = dict.fromkeys(("dC_x", "dC_y", "dC_z", "dLb"), 0.05 * MM)
TURNED = dict.fromkeys(("theta", "alpha", "dalpha", "dbeta"), 0.2 * DEGREE)
THREE = ("joint1", "joint2", "joint3")

MACHINES = {
    "delta": Machine(
        Delta,
        TABLE_5_12,
        PLACED | PAIRED | TURNED | {"La_x": 0.2 * MM, "La_y": 0.4 * MM, "Lb": 0.2 * MM},
        THREE,
        Limits(2.0, 40.0, 80.0, -30 * DEGREE, 135 * DEGREE, 200.0, 0.1),
    ),
    "stewart": Machine(
        Stewart,
        hexapod(0.0),
        dict.fromkeys(("B_x", "B_y", "B_z", "C_x", "C_y", "C_z", "L0"), 0.4 * MM),
        tuple(Stewart.legs),
        Limits(0.15, 3.0, 6.0, 0.0, 0.2, 200.0, 5e-3),
        Noise(joint=5e-6),
        lever=0.12,
    ),
    "argos": Machine(
        Argos,
        TABLE_5_21,
        dict.fromkeys(("alpha0", "Omega", "Phi", "omega", "phi"), 1.0 * DEGREE),
        THREE,
        Limits(2.0, 40.0, 80.0, -80 * DEGREE, 80 * DEGREE, 200.0, 0.1),
        # Section 2.4.2: a gimbal with steps of 2.7 arcmin, which measures no position
        Noise(orientation=2.7 * 60 / 12**0.5 * ARCSEC),
        sees_position=False,
    ),
    "linear_delta": Machine(
        LinearDelta,
        RAILS,
        PLACED | PAIRED | {"alpha": 0.2 * DEGREE, "beta": 0.2 * DEGREE, "Lb": 0.2 * MM},
        THREE,
        Limits(0.15, 3.0, 6.0, 0.0, 0.6, 200.0, 5e-3),
        Noise(joint=5e-6),
        lever=0.12,
    ),
}
