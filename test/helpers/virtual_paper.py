"""The paper's mechanisms from joint points and rods: Savoure et al., ICRA 2006."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from parallel_cal.virtual.robot import Array, Parameters, apply, axis_rotation, stack, turn
from parallel_cal.virtual.stewart import Assembly, column, numbered, vectors

# Table 2, millimetres: nominal parameters and the errors that the paper planted (q0 in degrees).
_NOMINAL = {"q0": 0, "a1_x": 125, "a2_x": 125, "a2_y": 0, "b1_x": 125, "b2_x": 125, "b2_y": 0}
_NOMINAL |= {"l1": 950, "l2": 950, "h": 100}
_ERRORS = {"q0": 0.01, "a1_x": 1, "a2_y": 3, "b2_x": -2, "l1": 1, "l2": -1}


def _si(name: str, printed: float) -> float:
    return printed * (np.pi / 180 if name == "q0" else 1e-3)


TABLE_2 = {name: _si(name, value) for name, value in _NOMINAL.items()}
TABLE_2_ERRORS = {name: _si(name, value) for name, value in _ERRORS.items()}
TABLE_2_STRAYED = {name: value + TABLE_2_ERRORS.get(name, 0.0) for name, value in TABLE_2.items()}


class Parallelogram(Assembly):
    """A platform hung on two rods in a plane, the first driven (figure 3, section III-A-2).

    Base hinges A1 = (-a1_x, 0), A2 = (a2_x, a2_y); platform hinges B1 = (-b1_x, 0) and
    B2 = (b2_x, b2_y) and tool C = (0, -h) about O_p. The pose is that of the tool; at
    q + q0 = 0 the first rod hangs straight down, and positive angles swing it to +x (eq. 61).
    """

    moves = "x y rz"
    controls = "x"
    home = (0.0, -1.05, 0.0)
    home_joints = (0.0,)

    def hinges(self, q: Array, r: Array, R: Array) -> tuple[Array, Array, Array, Array]:
        """A1, A2, B1 and B2 in the base, and of them B from the platform's pose."""
        p = self.parameters
        one, other = stack([-p["a1_x"], 0.0, 0.0]), stack([p["a2_x"], p["a2_y"], 0.0])
        tool = stack([0.0, -p["h"], 0.0])
        first, second = stack([-p["b1_x"], 0.0, 0.0]), stack([p["b2_x"], p["b2_y"], 0.0])
        return one, other, r + apply(R, first - tool), r + apply(R, second - tool)

    def rod(self, q: Array) -> Array:
        """The driven rod's hinge B1 as it stands on the arm."""
        angle = q[..., 0] + self.parameters["q0"]
        hinge = stack([-self.parameters["a1_x"], 0.0, 0.0])
        return hinge + self.parameters["l1"] * stack([np.sin(angle), -np.cos(angle), 0.0])

    def gaps(self, q: Array, r: Array, R: Array, hidden: Array) -> Array:
        """The driven rod's end against the platform's hinge, and the second rod's length."""
        _, other, first, second = self.hinges(q, r, R)
        length = np.linalg.norm(second - other, axis=-1, keepdims=True) - self.parameters["l2"]
        return np.concatenate([(first - self.rod(q))[..., :2], length], -1)


class SimpleParallelogram(Assembly):
    """One bar hinged at the base, carrying the tool without turning it (eq. 34)."""

    moves = "x y"
    controls = "x"
    home = (0.0, -1.05, 0.0)
    home_joints = (0.0,)

    def gaps(self, q: Array, r: Array, R: Array, hidden: Array) -> Array:
        """The bar's end against the tool."""
        angle, (l, h) = q[..., 0] + self.parameters["q0"], (self.parameters[k] for k in "lh")
        return r[..., :2] - stack([l * np.sin(angle), -l * np.cos(angle) - h])


class Delta51(Assembly):
    """Three arms, six rods; each joint point has its own coordinates (figure 1, eqs 2 and 6 to 11).

    An arm hinges at P about a horizontal axis u at angle theta; its points are given at reading
    zero in (u, v, z). `beta` turns the whole arm about the base's axes through P (eq. 8), as a
    rotation vector. Joint points of the platform are given in the platform.
    """

    controls = "x y z"
    home = (0.0, 0.0, 0.2)
    home_joints = (0.535, 0.535, 0.535)
    thetas: Sequence[float] = tuple(np.radians([-90.0, 30.0, 150.0]))

    def __init__(self, parameters: Parameters) -> None:
        super().__init__(parameters)
        chains = numbered("chain", 3)
        self.sides = [[f"rod{i}{j}" for i in (1, 2, 3)] for j in (1, 2)]
        self.hub = vectors(parameters, ["p_x", "p_y", "p_z"], chains)
        self.lean = turn(vectors(parameters, ["beta_x", "beta_y", "beta_z"], chains))
        self.rods = np.concatenate([column(parameters, "l", side) for side in self.sides], -1)

    def ends(self, q: Array, r: Array, R: Array) -> tuple[Array, Array]:
        """The rods' ends A on the arms and B on the platform, shape (..., 6 rods, 3) each."""
        axes = axis_rotation("z", np.array(self.thetas))
        held = axes @ axis_rotation("x", q)
        arms, platform = [], []
        for side in self.sides:
            arm = vectors(self.parameters, ["a_x", "a_y", "a_z"], side)
            ball = vectors(self.parameters, ["b_x", "b_y", "b_z"], side)
            arms.append(self.hub + apply(self.lean, apply(held, arm)))
            platform.append(r[..., None, :] + apply(R[..., None, :, :], ball))
        return np.concatenate(arms, -2), np.concatenate(platform, -2)

    def gaps(self, q: Array, r: Array, R: Array, hidden: Array) -> Array:
        """How far each rod is too short to reach from joint to joint (eq. 2)."""
        arm, platform = self.ends(q, r, R)
        return np.linalg.norm(platform - arm, axis=-1) - self.rods
