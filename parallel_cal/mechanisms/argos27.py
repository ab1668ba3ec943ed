"""Argos with perfect pantographs, complete calibration model with 27 parameters (section 3.5.3)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca

from parallel_cal.base.rotation import rot_x, rot_z
from parallel_cal.base.units import DEGREE, MM
from parallel_cal.mechanisms._argos import RADIUS, Argos, pantographs
from parallel_cal.model.drawing import Line
from parallel_cal.model.mechanism import POSE
from parallel_cal.model.parameters import Named, Parameter, ParameterTable

# Table 5.21, chain by chain. A parameter that a chain lacks is zero by the choice of frames:
# {b} has its x-axis on motor axis 1 and its z-axis on the common normal to motor axis 2;
# {p} has B1 on its x-axis and B2 in its xy-plane.
ANGLES: tuple[dict[str, float], ...] = (
    {"alpha0": -45.0},
    {"alpha0": 45.0, "Phi": 90.0, "phi": 90.0},
    {"alpha0": -45.0, "Omega": 90.0, "Phi": 90.0, "omega": 90.0, "phi": -90.0},
)
MOTOR_SHIFTS: tuple[tuple[str, ...], ...] = ((), ("dC",), ("dA", "dC"))
LABELS = {
    "alpha0": "encoder offset",
    "Omega": "motor axis' angle out of the base plane",
    "Phi": "motor axis' direction in the base plane",
    "omega": "ball's direction out of the platform plane",
    "phi": "ball's direction in the platform plane",
    "dA": "motor axis' shift along motor axis 1",
    "dC": "motor axis' distance from motor axis 1",
    "da": "pantograph's shift along the motor axis",
    "dc": "pantograph's distance from the motor axis",
    "gamma": "angle from the motor axis to the normal of the ball's circle",
    "dR": "shift of the ball's circle along its normal",
    "R": "radius of the ball's circle",
}
CHAIN = tuple(LABELS)


def angle_parameters(chain: int) -> list[Parameter]:
    """Make the angles of one chain, the only parameters of model 9 (table 3.16)."""
    return [
        Parameter(
            f"chain{chain + 1}.{name}",
            "rad",
            value * DEGREE,
            (2 if name == "alpha0" else 1) * DEGREE,
            "spherical",
            label=LABELS[name],
        )
        for name, value in ANGLES[chain].items()
    ]


def shift_parameters(chain: int, radius: float) -> list[Parameter]:
    """Make the parameters by which one chain deviates from the common sphere."""
    lengths = {**dict.fromkeys((*MOTOR_SHIFTS[chain], "da", "dc", "dR"), 0.0), "R": radius}
    name = f"chain{chain + 1}."
    return [
        *[
            Parameter(name + k, "m", v, 2 * MM, "spatial", label=LABELS[k])
            for k, v in lengths.items()
        ],
        Parameter(name + "gamma", "rad", 90 * DEGREE, 1 * DEGREE, "spatial", label=LABELS["gamma"]),
    ]


def chain_of(p: Named, chain: int) -> Named:
    """Return all entries of `CHAIN` for one chain (0..2); those that a chain lacks are zero."""
    own = p[f"chain{chain + 1}"]
    has = {*ANGLES[chain], *MOTOR_SHIFTS[chain], "da", "dc", "gamma", "dR", "R"}
    return Named(CHAIN, [own[name] if name in has else 0.0 for name in CHAIN])


BODIES = {"pantographs": ("*.R", "*.dR", "*.da", "*.dc")}


class Argos27(Argos):
    """Spherical robot Argos: three motors rotate a platform through three ideal pantographs.

    Its axes need not meet in one point, so the centre of the platform moves a little.

    A pantograph keeps its ball b on a circle about c with the unit normal u. Each chain gives two
    equations, `u . (r + R b - c) = 0` and `|r + R b - c| = rho`. rho is the parameter `R` of the
    chain. A parameter that a chain lacks is zero.

    - `W = Rx(Omega)`, `S = W Rz(Phi)`: the motor axis passes through `W (dA, 0, dC)` and is
      parallel to `S (1, 0, 0)`. The axis of motor 1 is the x axis of {B}. The z axis of {B} is the
      common normal of the axes of motors 1 and 2.
    - `Q = Rx(q + alpha0)`: the motor turns the pantograph, `u = S Q (cos gamma, sin gamma, 0)` and
      `c = W (dA, 0, dC) + S Q (da, 0, dc) + dR u`.
    - `b = radius Rx(omega) (cos phi, sin phi, 0)`, in {P}: ball 1 is on the x axis of {P}, and ball
      2 in the plane of x and y.

    The option `radius` (m) is the distance of the balls from the origin of {P}, and the nominal
    value of the parameters `R`. The thesis states all lengths as multiples of it.
    """

    moves = POSE
    bodies = BODIES

    def __init__(self, radius: float = RADIUS):
        super().__init__(radius)
        self.parameters = ParameterTable(
            p for i in range(3) for p in (*angle_parameters(i), *shift_parameters(i, self.length))
        )

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Compute G1 and G2 of eq. 3.22, three rows each, in metres.

        G1 is the distance of each ball from its pantograph's plane, G2 its distance from the
        circle (divided by 2 R).
        """
        plane, circle = [], []
        for C, u, radius, B in zip(*self.circles(q, p), strict=True):
            CB = r + R @ B - C
            plane.append(ca.dot(u, CB))
            circle.append((ca.dot(CB, CB) - radius**2) / (2 * radius))
        return ca.vertcat(*plane, *circle)

    def circles(self, q: Any, p: Named) -> list[tuple[Any, ...]]:
        """Return the circles of the balls, one per chain: centres C and unit normals u in {b},
        radii, and the balls' positions B in {p}."""
        return list(zip(*[self.circle(q[i], chain_of(p, i)) for i in range(3)], strict=True))

    def drawing(self, q: Any, r: Any, R: Any, p: Named) -> list[Line]:
        """Draw the pantographs' circles, the balls on them and the platform."""
        return pantographs(list(zip(*self.circles(q, p), strict=True)), r, R)

    def circle(self, angle: Any, c: Named) -> tuple[Any, Any, Any, Any]:
        """Compute one chain's circle and ball (eqs 3.17-3.21, transformations of table 3.15)."""
        W, Q, G = rot_x(c.Omega), rot_x(angle + c.alpha0), rot_z(c.gamma)
        S = W @ rot_z(c.Phi)
        u = S @ Q @ G[:, 0]
        C = W @ ca.vertcat(c.dA, 0, c.dC) + S @ Q @ (ca.vertcat(c.da, 0, c.dc) + G[:, 0] * c.dR)
        v = rot_x(c.omega) @ rot_z(c.phi)[:, 0]
        return C, u, c.R, v * self.length


def widen_spherical(values: Mapping[str, float], radius: float) -> dict[str, float]:
    """Widen a spherical Argos to model 27 (eqs 3.24, 3.25): nominal shifts, the given angles."""
    shifts = [p for i in range(3) for p in shift_parameters(i, radius)]
    return {**values, **{p.name: p.nominal for p in shifts}}
