"""The Argos from lines, pantograph bars and points in space (section 3.5, figures 3.14a and b).

Each chain is built like the real one: a motor axis, a pantograph hinged to the part that the motor
turns, and a ball at the long end of the pantograph's distal bar. The swing of the pantograph is an
unknown: there is no closure without passive joints.
SI units: the unit sphere of the thesis has the mock-up's radius, 110 mm.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from parallel_cal.virtual.robot import Array, Parameters, apply, solve, stack, turn
from parallel_cal.virtual.stewart import Assembly

SPHERE = 0.11
RIGHT = np.pi / 2
# Table 5.21: nominal angles (degrees) and lengths (mm) of the mock-up; eq. 3.27.
ANGLES = {
    **{"chain1.alpha0": -45, "chain2.alpha0": 45, "chain3.alpha0": -45},
    **{"chain2.Phi": 90, "chain2.phi": 90},
    **{"chain3.Omega": 90, "chain3.Phi": 90, "chain3.omega": 90, "chain3.phi": -90},
}
TABLE_5_21 = {name: float(np.radians(value)) for name, value in ANGLES.items()}
for _i in (1, 2, 3):
    TABLE_5_21 |= {f"chain{_i}.{name}": 0.0 for name in ("da", "dc", "dR")}
    TABLE_5_21 |= {f"chain{_i}.gamma": RIGHT, f"chain{_i}.R": SPHERE}
TABLE_5_21 |= {"chain2.dC": 0.0, "chain3.dA": 0.0, "chain3.dC": 0.0}
# Table 5.22: the nine angles as identified.
ANGLES_5_22 = {
    **{"chain1.alpha0": -44.02, "chain2.alpha0": 47.89, "chain3.alpha0": -42.17},
    **{"chain2.Phi": 91.27, "chain2.phi": 89.82},
    **{"chain3.Omega": 90.45, "chain3.Phi": 91.85, "chain3.omega": 91.18, "chain3.phi": -87.56},
}
TABLE_5_22 = TABLE_5_21 | {name: float(np.radians(v)) for name, v in ANGLES_5_22.items()}
# Table 5.25: model 27 as identified (degrees, mm). The third row of the nine angles is missing in
# the scan; they stay nominal.
_ROWS_5_25 = {
    "chain1": {"alpha0": -39.33, "da": 2.39, "dc": -3.20, "gamma": 94.85, "dR": -4.95, "R": 105.86},
    "chain2": {
        **{"alpha0": 44.17, "Phi": 89.57, "phi": 90.43, "dC": 1.00},
        **{"da": 4.65, "dc": -10.14, "gamma": 92.47, "dR": 13.56, "R": 98.31},
    },
    "chain3": {
        **{"dA": 0.32, "dC": -0.05, "da": 2.19, "dc": 1.79},
        **{"gamma": 91.89, "dR": -0.86, "R": 107.85},
    },
}
_ANGULAR = ("alpha0", "Phi", "phi", "gamma")
TABLE_5_25 = TABLE_5_21 | {
    f"{chain}.{name}": float(np.radians(value)) if name in _ANGULAR else value * 1e-3
    for chain, row in _ROWS_5_25.items()
    for name, value in row.items()
}


class Line(NamedTuple):
    """A line in space: a point on it, its direction and a perpendicular direction."""

    point: Array
    along: Array
    across: Array

    def next(self, turned: Array, slide: Array, step: Array, twist: Array) -> Line:
        """Go to the next line by the common normal (table 3.15, DH with x on the joint's axis).

        Turn `across` about this line, slide along the line, step along `across`, twist about it.
        """
        across = apply(turn(self.along * turned[..., None]), self.across)
        point = self.point + self.along * slide[..., None] + across * step[..., None]
        return Line(point, apply(turn(across * twist[..., None]), self.along), across)


X_AXIS = Line(np.zeros(3), np.array([1.0, 0, 0]), np.array([0, 0, 1.0]))


class Pantograph(NamedTuple):
    """Joints of three pantographs, each (..., 3 chains, 3): two on the motor's part, two on the
    distal bar, and the ball at that bar's long end."""

    near: Array
    far: Array
    near_end: Array
    far_end: Array
    ball: Array
    hinge: Array


class Argos(Assembly):
    """Three pantographs on motor lines that carry a platform by three balls (model 27)."""

    controls = "rx ry rz"
    home_turn = np.array([[1, -2, 2], [-2, 1, 2], [-2, -2, -1]]) / 3
    home_joints = (0.0, 0.0, 0.0)

    def __init__(self, parameters: Parameters) -> None:
        super().__init__(parameters)
        base = (self.values(name) for name in ("Omega", "dA", "dC", "Phi"))
        self.motors = X_AXIS.next(*base)
        zero = np.zeros(3)
        self.balls = (
            SPHERE * X_AXIS.next(self.values("omega"), zero, zero, self.values("phi")).along
        )
        self.offset, self.radius = self.values("alpha0"), self.values("R")

    def values(self, name: str) -> Array:
        """Return one parameter of each chain; zero if the choice of frames makes it zero."""
        return stack(self.parameters.get(f"chain{i}.{name}", 0.0) for i in (1, 2, 3))

    def hinges(self, q: Array) -> tuple[Array, Line]:
        """Compute centres of the balls' circles, and the axes of the pantographs' hinges."""
        arm = (self.values(name) for name in ("da", "dc", "gamma"))
        axis = self.motors.next(q + self.offset, *arm)
        return axis.point + axis.along * self.values("dR")[..., None], axis

    def pantographs(self, q: Array, swing: Array, size: float = 0.05) -> Pantograph:
        """Turn both bars on their hinges by `swing` from the arm's `across`.

        The distal bar is parallel to the line of the hinges on the motor's part. Its long end, with
        the ball, extends as far beyond the near bar as that bar's hinge is from the circle's
        centre.
        """
        centre, axis = self.hinges(q)
        base = np.cross(axis.along, axis.across)
        bar = apply(turn(axis.along * swing[..., None]), axis.across) * self.radius[..., None]
        near, far = centre - 2 * size * base, centre - 3 * size * base
        side = (near - far) / size
        return Pantograph(
            near, far, near + bar, far + bar, near + bar + 2 * size * side, axis.along
        )

    def hidden(self, q: Array, r: Array, R: Array) -> Array:
        """Estimate the swings at which the pantographs' balls are nearest to the platform's."""
        centre, axis = self.hinges(q)
        reach = self.sockets(r, R) - centre
        height = np.sum(reach * axis.across, -1)
        return np.arctan2(np.sum(np.cross(axis.across, reach) * axis.along, -1), height)

    def sockets(self, r: Array, R: Array) -> Array:
        """Compute the platform's sockets at pose (r, R), shape (..., 3 chains, 3)."""
        return r[..., None, :] + apply(R[..., None, :, :], self.balls)

    def gaps(self, q: Array, r: Array, R: Array, hidden: Array) -> Array:
        """Compute the vectors from pantograph balls to platform sockets, nine coordinates."""
        apart = self.sockets(r, R) - self.pantographs(q, hidden).ball
        return apart.reshape(*apart.shape[:-2], 9)

    def orientation_at_origin(self, q: ArrayLike, start: ArrayLike) -> Array:
        """Find the orientation with the centre at the origin, for models 9 and nominal (3.23).

        The balls cannot leave the sphere, so two gaps per chain remain. Three swings and three
        angles close them.
        """
        q, R0 = np.asarray(q, dtype=float), np.asarray(start, dtype=float)
        r = np.zeros(3)

        def gaps(u: Array) -> Array:
            R = turn(u[:3]) @ R0
            apart = self.gaps(q, r, R, u[3:]).reshape(3, 3)
            sockets = self.sockets(r, R)
            east = np.cross(sockets, sockets[[1, 2, 0]])
            north = np.cross(sockets, east)
            return np.concatenate([np.sum(apart * d, -1) / SPHERE**2 for d in (east, north)])

        u = solve(gaps, np.concatenate([np.zeros(3), self.hidden(q, r, R0)]))
        return turn(u[:3]) @ R0


def spherical(parameters: Parameters) -> Parameters:
    """Complete the parameters of model 9 or the nominal model by those of table 5.21."""
    return {**TABLE_5_21, **parameters}
