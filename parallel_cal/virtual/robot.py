"""Ground truth: robots built from points and rods, solved by plain root finding.

This room is independent of the others: no closure, no analytic derivative, no CasADi. A robot is
the positions of its balls and the lengths of its rods. An effect is physics between the encoder
reading and the measured pose. All units are SI. Every function takes a batch: arrays (..., 3).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Parameters = Mapping[str, ArrayLike]

ARCSEC = np.pi / 180 / 3600

# ---------------------------------------------------------------------------------------------
# The thesis' tables, as printed: millimetres and degrees

COLUMNS = [
    *("D_x", "D_y", "D_z", "theta", "alpha", "La_x", "La_y", "Lb"),
    *("d_z", "dalpha", "dbeta", "dC_x", "dC_y", "dC_z", "dLb", "b_x", "b_y", "b_z"),
]
ANGLES = {"theta", "alpha", "dalpha", "dbeta"}


def table(*chains: str) -> dict[str, float]:
    """Convert three printed rows (mm, degrees) to named SI parameters."""
    unit = {name: np.pi / 180 if name in ANGLES else 1e-3 for name in COLUMNS}
    rows = [zip(COLUMNS, map(float, row.split()), strict=True) for row in chains]
    return {f"chain{i}.{k}": v * unit[k] for i, row in enumerate(rows, 1) for k, v in row}


# Table 5.12: the nominal mock-up, which the controller assumes. D_x is illegible in the scan; with
# 76 mm, tables 5.12 and 5.18 give the errors that table 5.15 measured.
TABLE_5_12 = table(
    "76 -16.5 0   0 90 119.963 -3 240   20 0 0  0 0 0 0  24 0 0",
    "76 -16.5 0 120 90 119.963 -3 240   20 0 0  0 0 0 0  24 0 0",
    "76 -16.5 0 240 90 119.963 -3 240   20 0 0  0 0 0 0  24 0 0",
)
# Table 5.18: the mock-up as identified, which is the virtual robot.
TABLE_5_18 = table(
    "75.902 -16.318 -0.642  -0.517 89.513 119.967 -3.693 240.074"
    "   20  0.343 0.582 -0.023 -0.005 -0.006  0.092  24 0 0",
    "76.116 -16.716 -0.793 119.372 90.263 119.943 -3.236 240.108"
    "   20 -0.235 0.610 -0.049  0.069  0.023  0.009  24 0 0",
    "76.063 -16.792 -0.658 239.573 90.093 119.976 -2.673 240.009"
    "   20 -0.080 0.404 -0.049  0.076 -0.012 -0.062  24 0 0",
)

# ---------------------------------------------------------------------------------------------
# Geometry


def turn(w: ArrayLike) -> Array:
    """Compute the rotation about `w` by its length (Rodrigues), exact at w = 0."""
    w = np.asarray(w, dtype=float)
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    zero = np.zeros_like(w[..., 0])
    x, y, z = w[..., 0], w[..., 1], w[..., 2]
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*w.shape, 3)
    half = np.sinc(angle / 2 / np.pi)
    return np.eye(3) + np.sinc(angle / np.pi) * cross + half**2 / 2 * (cross @ cross)


def axis_rotation(axis: str, angle: ArrayLike) -> Array:
    """Compute the rotation about the coordinate axis `x`, `y` or `z`."""
    return turn(np.asarray(angle)[..., None] * np.eye(3)["xyz".index(axis)])


def apply(rotation: Array, vector: Array) -> Array:
    """Rotate a batch of vectors."""
    return (rotation @ vector[..., None])[..., 0]


def stack(values: Iterable[ArrayLike]) -> Array:
    """Stack numbers, or equal batches of them, along a new last axis."""
    return np.stack(np.broadcast_arrays(*[np.asarray(v, float) for v in values]), -1)


def solve(
    gap: Callable[[Array], Array], u: Array, step: float = 1e-6, at_once: bool = False
) -> Array:
    """Find a root of `gap` near `u` by Newton's method with central differences.

    Near the root, the slopes are kept as long as every step is a tenth of the last one or less.
    With `at_once`, all differences are taken in one call of `gap`, which must then accept values
    with one more axis in front: for one sample this takes half the time.
    """
    inverse: Array | None = None
    last = np.inf
    for _ in range(50):
        if inverse is None:
            inverse = np.asarray(np.linalg.inv(_compute_slopes(gap, u, step, at_once)), float)
        move = apply(inverse, -gap(u))
        sizes = np.linalg.norm(move, axis=-1, keepdims=True)
        u = u + move * np.minimum(1, 0.1 / np.maximum(sizes, 1e-300))
        size = np.max(sizes, initial=0)
        if size < 1e-12:
            return u
        if not size < min(0.01, 0.1 * last):
            inverse = None
        last = size
    raise ValueError("the robot cannot be assembled there: its rods do not meet")


def _compute_slopes(gap: Callable[[Array], Array], u: Array, step: float, at_once: bool) -> Array:
    """Compute d gap / d u (..., gaps, n) at `u` (..., n) by central differences."""
    ends = [u + side * e for side in (1, -1) for e in step * np.eye(u.shape[-1])]
    gaps = gap(np.stack(ends)) if at_once else [gap(end) for end in ends]
    n = u.shape[-1]
    return np.stack([(gaps[i] - gaps[n + i]) / (2 * step) for i in range(n)], -1)


class RodRobot:
    """A platform on six rods; subclasses define the positions of balls and lengths of rods."""

    home = np.array([0.0, 0.0, 0.2])
    home_joints: Array

    def __init__(self, parameters: Parameters) -> None:
        self.parameters = parameters

    def joint_points(self, q: ArrayLike) -> Array:
        """Compute ball centres on the driven side, shape (..., rods, 3)."""
        raise NotImplementedError

    def platform_points(self, r: ArrayLike, R: ArrayLike) -> Array:
        """Compute ball centres on the platform at pose (r, R), shape (..., rods, 3)."""
        raise NotImplementedError

    def lengths(self, q: ArrayLike) -> Array:
        """Return rod lengths, shape (..., rods)."""
        raise NotImplementedError

    def gaps(self, q: ArrayLike, r: ArrayLike, R: ArrayLike) -> Array:
        """Compute by how much each rod is too short to reach from ball to ball, m."""
        return self._gaps(self.joint_points(q), self.lengths(q), r, R)

    def _gaps(self, driven: Array, lengths: Array, r: ArrayLike, R: ArrayLike) -> Array:
        """Compute the gaps of rods of these lengths from these balls on the driven side, m."""
        return np.linalg.norm(self.platform_points(r, R) - driven, axis=-1) - lengths

    def forward(
        self, q: ArrayLike, start: tuple[Array, Array] | None = None
    ) -> tuple[Array, Array]:
        """Find the pose (r, R) of the joints `q` that is nearest to `start`."""
        q = np.asarray(q, dtype=float)
        r0, R0 = start or (self.home, np.eye(3))
        u = np.zeros((*q.shape[:-1], 6))
        u[..., :3] = r0
        driven, lengths = self.joint_points(q), self.lengths(q)

        def gaps(u: Array) -> Array:
            return self._gaps(driven, lengths, u[..., :3], turn(u[..., 3:]) @ R0)

        u = solve(gaps, u, at_once=True)
        return u[..., :3], turn(u[..., 3:]) @ R0

    def inverse(
        self, r: ArrayLike, start: tuple[Array, Array] | None = None
    ) -> tuple[Array, Array]:
        """Find the joints that place the platform at `r`, and the resulting orientation R."""
        r = np.asarray(r, dtype=float)
        q0, R0 = start or (self.home_joints, np.eye(3))
        u = np.zeros((*r.shape[:-1], 6))
        u[..., :3] = q0
        u = solve(lambda u: self.gaps(u[..., :3], r, turn(u[..., 3:]) @ R0), u, at_once=True)
        return u[..., :3], turn(u[..., 3:]) @ R0


class Delta(RodRobot):
    """Three motor-driven arms, each carrying the platform by two rods (figure 3.9, table 3.10).

    An arm is one rigid body with two balls, hinged on its motor's axis. A parameter may be an array
    with one value per sample, if the geometry changes with time.
    """

    home_joints = np.full(3, np.radians(30.65))

    def __init__(self, parameters: Parameters) -> None:
        super().__init__(parameters)

        def value(name: str) -> Array:
            return stack(parameters[f"chain{i}.{name}"] if name else 0.0 for i in (1, 2, 3))

        def vector(*names: str) -> Array:
            return stack(value(name) for name in names)

        frame = axis_rotation("z", value("theta")) @ axis_rotation("x", value("alpha"))
        motor = frame @ axis_rotation("x", value("dalpha")) @ axis_rotation("y", value("dbeta"))
        ball, half = vector("b_x", "b_y", "b_z"), vector("", "", "d_z")
        arm, error = vector("La_x", "La_y", ""), vector("dC_x", "dC_y", "dC_z")
        self.hub = apply(frame, ball + vector("D_x", "D_y", "D_z"))
        self.axis = motor[..., :, 2]
        # Ball centres at q = 0 relative to the hub; first and second ball of each chain.
        self.arms = [apply(motor, arm + s * (half + error)) for s in (1, -1)]
        self.balls = [apply(frame, ball + s * half) for s in (1, -1)]
        self.rods = np.concatenate([value("Lb") + s * value("dLb") for s in (1, -1)], -1)

    def joint_points(self, q: ArrayLike) -> Array:
        """Compute C_11 C_21 C_31 C_12 C_22 C_32: the arms' balls, turned by q."""
        swing = turn(self.axis * np.asarray(q)[..., None])
        return np.concatenate([self.hub + apply(swing, arm) for arm in self.arms], -2)

    def platform_points(self, r: ArrayLike, R: ArrayLike) -> Array:
        """Compute B_11 B_21 B_31 B_12 B_22 B_32: the platform's balls at pose (r, R)."""
        turned = [apply(np.asarray(R)[..., None, :, :], ball) for ball in self.balls]
        return np.asarray(r)[..., None, :] + np.concatenate(turned, -2)

    def lengths(self, q: ArrayLike) -> Array:
        """Return Lb + dLb of the first rods, then Lb - dLb of the second."""
        return self.rods


NOMINAL, MOCK_UP = Delta(TABLE_5_12), Delta(TABLE_5_18)

# ---------------------------------------------------------------------------------------------
# Hidden physics: one class per effect


@dataclass(frozen=True)
class SampleConditions:
    """Conditions of each sample: s, degC, kg, and the direction of each joint's last motion."""

    time: Array
    temperature: Array
    payload: Array
    direction: Array


@dataclass(frozen=True)
class Effect:
    """Base class of effects; a subclass overrides the stage of the measurement in which it acts."""

    def geometry(self, parameters: Parameters, at: SampleConditions) -> Parameters:
        """Return the dimensions of the robot under these conditions."""
        return parameters

    def arm(self, reading: Array, robot: RodRobot, at: SampleConditions) -> Array:
        """Return the angle of the arm if its encoder shows `reading`."""
        return reading

    def loaded_robot(self, robot: Any, angle: Array, at: SampleConditions) -> Any:
        """Return the robot with its rods under load."""
        return robot

    def device(self, r: Array, R: Array, at: SampleConditions) -> tuple[Array, Array]:
        """Return the pose that the measuring device shows for the true pose."""
        return r, R

    def taken(self, stamp: Array) -> Array:
        """Return when the poses were taken that the measuring device stamps `stamp`."""
        return stamp


@dataclass(frozen=True)
class EncoderEccentricity(Effect):
    """An encoder disc mounted off-centre: the reading leads and lags once per turn."""

    sin: tuple[float, ...]
    cos: tuple[float, ...]

    def arm(self, reading: Array, robot: RodRobot, at: SampleConditions) -> Array:
        return reading + np.array(self.sin) * np.sin(reading) + np.array(self.cos) * np.cos(reading)


@dataclass(frozen=True)
class Backlash(Effect):
    """Backlash of a gear: the encoder, on the motor side, leads the arm by half the width."""

    width: tuple[float, ...]

    def arm(self, reading: Array, robot: RodRobot, at: SampleConditions) -> Array:
        return reading - np.array(self.width) / 2 * at.direction


def truth(
    robot: Any,
    effects: Sequence[Effect],
    reading: Array,
    at: SampleConditions,
    start: tuple[Array, Array] | None = None,
) -> tuple[Array, Array, Array]:
    """Compute (arm angles, position, rotation) that a perfect device shows at encoder readings."""
    angle, r, R = solve_true_pose(robot, effects, reading, at, start)
    return angle, *apply_device_effects(effects, r, R, at)


def solve_true_pose(
    robot: Any,
    effects: Sequence[Effect],
    reading: Array,
    at: SampleConditions,
    start: tuple[Array, Array] | None = None,
) -> tuple[Array, Array, Array]:
    """Compute true (arm angles, position, rotation) at encoder readings.

    The pose is the one nearest to `start`, by default to the robot's home.
    """
    parameters, angle = robot.parameters, reading
    for effect in effects:
        parameters = effect.geometry(parameters, at)
    robot = type(robot)(parameters)
    for effect in effects:
        angle = effect.arm(angle, robot, at)
    for effect in effects:
        robot = effect.loaded_robot(robot, angle, at)
    return angle, *robot.forward(angle, start)


def apply_device_effects(
    effects: Sequence[Effect], r: Array, R: Array, at: SampleConditions
) -> tuple[Array, Array]:
    """Compute the pose that a perfect device shows for the true pose."""
    for effect in effects:
        r, R = effect.device(r, R, at)
    return r, R


# ---------------------------------------------------------------------------------------------
# The session at the measuring machine


@dataclass(frozen=True)
class Noise:
    """Instruments of section 4.2, 1 sigma: one error per dwell, and `jitter` of it per message."""

    joint: float = 25 * ARCSEC
    position: float = 10e-6
    orientation: float = 15 * ARCSEC
    jitter: float = 0.2

    def draw(self, rng: np.random.Generator, n: int, joints: int = 3) -> tuple[Array, Array, Array]:
        """Draw errors of n readings: joints, position, rotation vector about the base's axes."""
        q, r, w = (rng.normal(size=(n, size)) for size in (joints, 3, 3))
        return q * self.joint, r * self.position, w * self.orientation


THESIS_NOISE = Noise()
