"""Measuring set-ups of chapter 4 on virtual Deltas: tips on plates and rods, no package code.

The truth is the robot of points and rods; where a tip is tied to a plate or a hole, the poses are
chosen there and the robot's joints are found by root finding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parallel_cal.virtual import robot as vr

# 1 sigma of a real robot (mm, degrees), as a workshop would state it.
SPREAD = {
    **{"D_x": 1, "D_y": 1, "D_z": 1, "theta": 0.5, "alpha": 0.5},
    **{"La_x": 0.5, "La_y": 1, "Lb": 0.5},
}


def random_delta(seed, factor=1.0):
    """A Delta with perfect parallelograms, each dimension off by `factor` times its spread."""
    rng = np.random.default_rng([seed, 24])
    parameters = dict(vr.TABLE_5_12)
    for i in (1, 2, 3):
        for name, sigma in SPREAD.items():
            unit = np.pi / 180 if name in vr.ANGLES else 1e-3
            parameters[f"chain{i}.{name}"] += factor * rng.normal() * sigma * unit
    return vr.Delta(parameters)


@dataclass(frozen=True)
class Plate:
    """A plate at z = height (m) with holes, ball-bars, and the errors of plate and encoders."""

    height: float = 0.23
    holes: tuple[tuple[float, float], ...] = ((-0.03, 0.0), (0.03, 0.0))
    bar: float = 0.07
    sigma: float = 15e-6
    joint: float = 25 * vr.ARCSEC
    reach: float = 0.09

    @property
    def names(self):
        return ("plane", *(f"sphere{i + 1}" for i in range(len(self.holes))))

    def points(self, name, n, rng):
        """Tips spread as a person who knows leverage would: along the plate's rim and a smaller
        square; along a ball-bar's rim, half way up and near its top, as far as the robot reaches.
        """
        level = np.arange(n) % 4
        if name == "plane":
            side = self.reach * np.where(level == 0, 0.4, 1.0)
            along, across = rng.uniform(-1, 1, n), rng.choice([-1, 1], n)
            flat = np.where((rng.random(n) < 0.5)[:, None], [[1, 0]], [[0, 1]])
            square = along[:, None] * flat + across[:, None] * (1 - flat)
            return np.column_stack([side[:, None] * square, self._height(n, rng)])
        centre = np.array([*self.holes[int(name[-1]) - 1], self.height])
        rise = np.radians(np.array([10, 10, 45, 80])[level])
        length = self.bar + rng.normal(0, self.sigma, n)
        return centre + length[:, None] * np.array([self._up(centre, angle, rng) for angle in rise])

    def _height(self, n, rng):
        return self.height + rng.normal(0, self.sigma, n)

    def _up(self, centre, rise, rng):
        """A direction off the plate (the robot is on its low-z side), its end within reach."""
        while True:
            around = rng.uniform(0, 2 * np.pi)
            flat = np.cos(rise) * np.array([np.cos(around), np.sin(around)])
            if (np.abs(centre[:2] + self.bar * flat) <= self.reach).all():
                return np.array([*flat, -np.sin(rise)])

    def session(self, robot, n, seed):
        """n poses of each kind: encoder readings (3 n, 3) and the tie's name of each."""
        rng = np.random.default_rng([seed, 6])
        ties = [name for name in self.names for _ in range(n)]
        points = np.concatenate([self.points(name, n, rng) for name in self.names])
        joints, R = robot.inverse(points)
        assert np.abs(R - np.eye(3)).max() < 1e-9
        return joints + rng.normal(0, self.joint, joints.shape), np.array(ties)


def workspace(robot, n=200, seed=1):
    """Joints and positions of a robot all over its workspace, not on the plate only."""
    r = np.random.default_rng(seed).uniform((-0.06, -0.06, 0.14), (0.06, 0.06, 0.26), (n, 3))
    return robot.inverse(r)[0], r


@dataclass(frozen=True)
class Device:
    """A pose device that stands anywhere (frame) and looks at a target put anywhere: (m, 3) m
    and rotation vectors; its gimbal's three encoders (x, y, z) have zeros of their own."""

    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    target_shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    target_turn: np.ndarray | None = None
    zeros: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def shows(self, r, R):
        """Position and rotation of the target as seen by the device, for poses of {P} in {B}."""
        F = vr.turn(self.turn)
        T = np.eye(3) if self.target_turn is None else self.target_turn
        seen = (r + R @ np.array(self.target_shift) - np.array(self.shift)) @ F
        return seen, gimbal(angles(F.T @ R @ T) - np.array(self.zeros))


def gimbal(angles):
    """Three rings in series, the outermost first: turned about x, then its y, then its z."""
    a, b, c = np.moveaxis(np.asarray(angles), -1, 0)
    return vr.axis_rotation("x", a) @ vr.axis_rotation("y", b) @ vr.axis_rotation("z", c)


def angles(R):
    """The rings' angles, the middle one within a quarter turn; checked by turning them."""
    across = np.hypot(R[..., 0, 0], R[..., 0, 1])
    found = np.stack(
        [
            np.arctan2(-R[..., 1, 2], R[..., 2, 2]),
            np.arctan2(R[..., 0, 2], across),
            np.arctan2(-R[..., 0, 1], R[..., 0, 0]),
        ],
        -1,
    )
    assert np.abs(gimbal(found) - R).max() < 1e-12
    return found


@dataclass(frozen=True)
class Gauge:
    """A length gauge on the platform: how far its stem goes from `tip` until it meets the plate.

    The plate's height over (x, y) is `height` and a polynomial, {(i, j): coefficient of x^i y^j};
    `slant` turns the stem from the platform's z by so much about x and y.
    """

    height: float
    tip: tuple[float, float, float] = (0.0, 0.0, 0.0)
    slant: tuple[float, float] = (0.0, 0.0)
    shape: tuple[tuple[int, int, float], ...] = ()

    def surface(self, x, y):
        return self.height + sum(c * x**i * y**j for i, j, c in self.shape)

    def reads(self, r, R):
        start = r + vr.apply(R, np.array(self.tip))
        stem = R @ vr.turn([*self.slant, 0.0]) @ [0.0, 0.0, 1.0]
        length = np.zeros(len(r))
        for _ in range(20):  # a plate is nearly flat: the next guess is a thousand times better
            at = start - length[:, None] * stem
            length += (at[:, 2] - self.surface(at[:, 0], at[:, 1])) / stem[:, 2]
        return length
