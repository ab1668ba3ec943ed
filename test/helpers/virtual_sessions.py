"""Other days at the measuring machine: warm ones, loaded ones, without a stop, other robots.

Like `parallel_cal.virtual`, this file shares nothing with the rest of the package.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from virtual_day import Day, Session, plan, targets, visit

from parallel_cal.virtual.argos import TABLE_5_22, Argos
from parallel_cal.virtual.machines import hexapod
from parallel_cal.virtual.robot import NOMINAL, Array, RodRobot, turn
from parallel_cal.virtual.stewart import Stewart

# ---------------------------------------------------------------------------------------------
# The temperature of the air, degC


def wandering(time: Array) -> Array:
    """Doors that open and close: up and down by 8 K within a quarter of an hour."""
    t = 2 * np.pi * np.asarray(time)
    return 22 + 5.5 * np.sin(t / 540 + 0.4) + 2.5 * np.sin(t / 233 + 2)


def steady(time: Array) -> Array:
    """An air-conditioned room: it holds its temperature to a twentieth of a degree."""
    return 22 + 0.05 * np.sin(2 * np.pi * np.asarray(time) / 131)


def warming(time: Array) -> Array:
    """A hall in the morning: it warms up by 7 K in a quarter of an hour, nearly evenly."""
    return 18 + 32 * (1 - np.exp(-np.asarray(time) / 4000))


# ---------------------------------------------------------------------------------------------
# The Delta robot's days


def brisk(seed: int) -> Session:
    """The session of `record`."""
    return plan(seed=seed)


def slow(air: Callable[[Array], Array], n_poses: int = 74) -> Callable[[int], Session]:
    """Sessions with ten seconds at each pose, long enough to warm up or to creep."""
    return lambda seed: plan(n_poses, seed=seed, dwell=10.0, air=air)


def wide(seed: int) -> Session:
    """A session in a cube of 0.16 m, the largest that the robot reaches."""
    reading, _ = NOMINAL.inverse(targets(90, seed, side=0.16))
    return visit(reading, NOMINAL.inverse(NOMINAL.home)[0], 20, seed)


def loaded(seed: int) -> Session:
    """A session with 0.2 and 1.2 kg in turn, four times a quarter of it."""
    visits = 74 + 30
    masses = np.where(np.arange(visits) * 4 // visits % 2, 1.2, 0.2)
    return plan(74, 30, seed, payload=masses)


@dataclass(frozen=True)
class Sweep(Day):
    """A Lissajous path (radians on it against time), driven without a stop, slower and faster.

    The speed goes from a quarter of the fastest to the fastest and back, so many `times`.
    """

    seed: int = 0
    end: float = 120.0
    times: int = 3
    controller: RodRobot = NOMINAL
    air: Callable[[Array], Array] = steady
    payload: float = 0.2
    arrive = leave = np.zeros(0)
    pose_index = np.zeros(0, np.int64)
    ways = np.zeros((0, 3))

    def joints(self, time: Array) -> Array:
        return self.controller.inverse(self.path(np.asarray(time)))[0]

    def path(self, time: Array) -> Array:
        """Positions that fill the cube of 0.12 m at (0, 0, 0.2) m."""
        period = self.end / self.times
        phase = 1.2 * (time - 0.6 * period / (2 * np.pi) * np.sin(2 * np.pi * time / period))
        angle = np.multiply.outer(phase, [1.0, 1.23, 1.61]) + [self.seed, 2 * self.seed, 1.0]
        return np.array([0, 0, 0.2]) + 0.06 * np.sin(angle)

    def direction(self, time: Array) -> Array:
        return np.sign(self.joints(time + 1e-4) - self.joints(time - 1e-4))

    def load(self, time: Array) -> Array:
        return np.full(len(time), self.payload)

    def held(self, time: Array, errors: Array) -> Array:
        return np.zeros((len(time), errors.shape[1]))


# ---------------------------------------------------------------------------------------------
# Argos: table 5.22's mock-up, turned to all sides

ARGOS = Argos(TABLE_5_22)


def turning(seed: int) -> Session:
    """Joint angles of up to 30 degrees to either side."""
    reading = targets(74, seed, side=np.pi / 3) - [0, 0, 0.2]
    return visit(reading, np.zeros(3), 20, seed)


# ---------------------------------------------------------------------------------------------
# Stewart: a hexapod 0.3 m high, on which each ball is set to half a millimetre


HEXAPOD, DESIGNED = Stewart(hexapod(0.5e-3)), Stewart(hexapod(0.0))


def climbing(seed: int) -> Session:
    """Poses of the hexapod within 40 mm and 10 degrees of its home."""
    rng = np.random.default_rng(seed)
    move = rng.uniform(-1, 1, (90, 6)) * ([0.04, 0.04, 0.03] + [np.radians(10)] * 3)
    r, R = np.asarray(DESIGNED.home) + move[:, :3], turn(move[:, 3:])
    return visit(DESIGNED.leg_lengths(r, R) - DESIGNED.offset, DESIGNED.home_joints, 20, seed)
