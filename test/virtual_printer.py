"""Delta printers that know their beds by touch only: towers or shoulders, rods, end-stops, a probe.

Like `virtual_robot`, this file shares nothing with the package.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from virtual_robot import Array

ROD, RADIUS, REACH = 0.25, 0.10, 0.06  # m: rod, tower to effector joint, of the bed that is used


@dataclass(frozen=True)
class Printer:
    """Three carriages on vertical towers, each with one rod (of a pair) to the nozzle.

    Of each tower: end-stop, radius and rod off (m), angle off (rad), pitch of its belt off (1),
    and the screw's wobble (m) once per `lead` (m); the bed's bowl (1/m), its tilt about x and y
    (rad), and where the probe sits beside the nozzle (m).
    """

    end_stop: Array
    radius: Array
    rod: Array
    angle: Array
    pitch: Array
    wobble: float = 0.0
    lead: float = 8e-3
    bowl: float = 0.0
    tilt: tuple[float, float] = (0.0, 0.0)
    probe: tuple[float, float] = (0.0, 0.0)

    def readings(self, r: Array) -> Array:
        """What the carriages' encoders read (N, 3) with the nozzle at r (N, 3)."""
        around = np.radians([0.0, 120.0, 240.0]) + self.angle
        out = RADIUS + self.radius
        towers = np.column_stack([out * np.cos(around), out * np.sin(around)])
        away = np.linalg.norm(r[:, None, :2] - towers, axis=2)
        height = r[:, 2:] + np.sqrt((ROD + self.rod) ** 2 - away**2)
        read = (height - self.end_stop) / (1 + self.pitch)
        phase = 2 * np.pi / self.lead * read + np.array([0.3, 1.9, -1.2])
        return read - self.wobble * np.sin(phase)

    def bed(self, xy: Array) -> Array:
        """Height (N,) of the bed."""
        x, y = xy.T
        return self.tilt[0] * y - self.tilt[1] * x + self.bowl * (x**2 + y**2)

    def touched(self, xy: Array) -> Array:
        """Readings where the probe, over (x, y) of the bed, touches it."""
        nozzle = xy - np.array(self.probe)
        return self.readings(np.column_stack([nozzle, self.bed(xy)]))


def drawn(seed: int, pitch: float = 0.0, **hidden: float) -> Printer:
    """A printer as people build one: half a millimetre here, a tenth of a degree there."""
    rng = np.random.default_rng([seed, 31])

    def three(sigma: float) -> Array:
        return sigma * rng.standard_normal(3)

    towers = three(0.5e-3), three(0.5e-3), three(0.3e-3), three(2e-3)
    x, y, rx, ry = rng.standard_normal(4)
    return Printer(
        *towers,
        pitch * np.array([1.0, -0.8, 0.6]),
        tilt=(3e-3 * rx, 3e-3 * ry),
        probe=(1e-3 * x, 1e-3 * y),
        **hidden,
    )


def places(n: int, seed: int) -> Array:
    """n places (n, 2) all over the round bed."""
    rng = np.random.default_rng([seed, 32])
    out, around = REACH * np.sqrt(rng.random(n)), rng.uniform(0, 2 * np.pi, n)
    return np.column_stack([out * np.cos(around), out * np.sin(around)])
