"""A plotter on four lines that never stops: its tables of joints and of a tracker, as two computers
with clocks of their own wrote them.

Nothing of it comes from the package: lengths are distances, every motor is behind its reading by a
time of its own, and a cell of the table is a number as printed.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from parallel_cal.virtual.robot import Array

DRAWN = ((-1.5, -1.1), (1.5, -1.1), (1.5, 1.1), (-1.5, 1.1))  # m, the anchors of the lines
REACH = (1.0, 0.7)  # m to each side


@dataclass(frozen=True)
class Plotter:
    """Where its anchors truly are (4, 2) m, by how much its lines are longer than read (4,) m, and
    how far each motor is behind its reading (4,) s."""

    anchors: ArrayLike
    offsets: ArrayLike
    lags: ArrayLike

    @classmethod
    def drawn(cls, seed: int, lags: ArrayLike = (6e-3, 11e-3, 8e-3, 14e-3)) -> Plotter:
        """Anchors some 10 mm and lengths some 3 mm from where they should be."""
        rng = np.random.default_rng([seed, 1])
        return cls(np.array(DRAWN) + rng.normal(0, 10e-3, (4, 2)), rng.normal(0, 3e-3, 4), lags)

    def readings(self, path: Path2D, time: Array) -> Array:
        """Readings (N, 4) m at a time (N,) s: each is ahead of its line."""
        late = [path.at(time + lag) for lag in np.asarray(self.lags)]
        return np.stack([self.readings_at(r)[:, i] for i, r in enumerate(late)], axis=1)

    def readings_at(self, r: Array) -> Array:
        """Readings (N, 4) m at rest at the places r (N, 2), zero in the middle of the drawing."""
        lengths = np.linalg.norm(r[:, None] - np.asarray(self.anchors), axis=2)
        return np.asarray(lengths - np.linalg.norm(DRAWN, axis=1) - np.asarray(self.offsets))


@dataclass(frozen=True)
class Path2D:
    """Four waves in x and in y, so large that the tip reaches `REACH` and so fast that it moves at
    `fastest` m/s at most."""

    seed: int
    fastest: float

    def at(self, time: Array) -> Array:
        """Places (N, 2) m."""
        return self._waves(time * self._speed())

    def _speed(self) -> float:
        t = np.linspace(0, 400, 40001)
        step = np.linalg.norm(np.diff(self._waves(t), axis=0), axis=1) / np.diff(t)
        return float(self.fastest / np.max(step))

    def _waves(self, time: Array) -> Array:
        rng = np.random.default_rng([self.seed, 2])
        rate, phase = rng.uniform(0.5, 1.6, (2, 4)), rng.uniform(-np.pi, np.pi, (2, 4))
        share = rng.uniform(0.5, 1.0, (2, 4))
        share *= np.array(REACH)[:, None] / share.sum(axis=1, keepdims=True)
        return np.stack(
            [np.sin(np.outer(time, f) + p) @ a for f, p, a in zip(rate, phase, share, strict=True)],
            axis=1,
        )


@dataclass(frozen=True)
class Clock:
    """A clock that shows `offset` + (1 + `drift`) * time, read with an error of `jitter` s."""

    offset: float = 0.0
    drift: float = 0.0
    jitter: float = 0.0


def write_tables(
    folder: Path,
    plotter: Plotter,
    path: Path2D,
    tracker: Clock,
    duration: float = 60.0,
    rate: float = 30.0,
    joint_noise: float = 50e-6,
    noise: float = 200e-6,
) -> None:
    """Write joints.csv (100 Hz, mm) and tracker.csv (`rate` Hz, mm; no height was measured)."""
    rng = np.random.default_rng([path.seed, 3])
    time = np.arange(0, duration, 1 / 100)
    q = plotter.readings(path, time) + rng.normal(0, joint_noise, (len(time), 4))
    _write(folder / "joints.csv", ["t", *(f"line{i}" for i in range(1, 5))], time, q)
    time = np.arange(0.3, duration, 1 / rate)
    r = path.at(time) + rng.normal(0, noise, (len(time), 2))
    stamp = tracker.offset + (1 + tracker.drift) * time + rng.normal(0, tracker.jitter, len(time))
    _write(folder / "tracker.csv", ["t", "x", "y"], stamp, r)


def _write(file: Path, header: list[str], time: Array, metres: Array) -> None:
    with file.open("w", newline="", encoding="utf-8") as out:
        table = csv.writer(out)
        table.writerow(header)
        for t, row in zip(time, 1e3 * metres, strict=True):
            table.writerow([f"{t:.6f}", *(f"{x:.4f}" for x in row)])
