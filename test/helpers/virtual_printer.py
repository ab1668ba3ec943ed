"""Delta printers that know their beds by touch only: towers or shoulders, rods, end-stops, a probe.

Like `parallel_cal.virtual`, this file shares nothing with the rest of the package.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from parallel_cal.virtual.robot import Array

ROD, RADIUS, REACH = 0.25, 0.10, 0.06  # m: rod, tower to effector joint, of the bed that is used


@dataclass(frozen=True)
class Printer:
    """Three carriages on vertical towers, each with one rod (of a pair) to the nozzle.

    Of each tower: end-stop, radius and rod off (m), angle off (rad), pitch of its belt off (1),
    and the screw's wobble (m) once per `lead` (m); how far it leans towards x and y (1); the bed's
    bowl (1/m), its tilt about x and y (rad), and where the probe sits beside the nozzle (m), which
    tilts with the effector, about x and y by `nod` (rad) at the bed's rim, by a square less inside.
    """

    end_stop: Array
    radius: Array
    rod: Array
    angle: Array
    pitch: Array
    wobble: float = 0.0
    lead: float = 8e-3
    lean: Array | float = 0.0
    bowl: float = 0.0
    tilt: tuple[float, float] = (0.0, 0.0)
    probe: tuple[float, float] = (0.0, 0.0)
    nod: tuple[float, float] = (0.0, 0.0)

    def readings(self, r: Array) -> Array:
        """What the carriages' encoders read (N, 3) with the nozzle at r (N, 3)."""
        around = np.radians([0.0, 120.0, 240.0]) + self.angle
        out = RADIUS + self.radius
        towers = np.column_stack([out * np.cos(around), out * np.sin(around)])
        rail = np.column_stack([np.broadcast_to(self.lean, (3, 2)), np.ones(3)])
        rail /= np.linalg.norm(rail, axis=1)[:, None]
        away = r[:, None] - np.column_stack([towers, np.zeros(3)])
        along = (away * rail).sum(axis=2)
        aside = (away**2).sum(axis=2) - along**2
        height = along + np.sqrt((ROD + self.rod) ** 2 - aside)
        read = (height - self.end_stop) / (1 + self.pitch)
        phase = 2 * np.pi / self.lead * read + np.array([0.3, 1.9, -1.2])
        return read - self.wobble * np.sin(phase)

    def bed(self, xy: Array) -> Array:
        """Height (N,) of the bed."""
        x, y = xy.T
        return self.tilt[0] * y - self.tilt[1] * x + self.bowl * (x**2 + y**2)

    def touched(self, xy: Array) -> Array:
        """Readings where the probe, over (x, y) of the bed, touches it."""
        return self.readings(self.nozzle(xy - np.array(self.probe)))

    def nozzle(self, xy: Array) -> Array:
        """Where the nozzle (N, 3) is, over (x, y), as its probe touches the bed."""
        (x, y), out = self.probe, (xy**2).sum(axis=1) / REACH**2
        lower = (self.nod[1] * x - self.nod[0] * y) * out
        return np.column_stack([xy, self.bed(xy + np.array(self.probe)) + lower])


def drawn(
    seed: int,
    pitch: float = 0.0,
    lean: float = 0.0,
    beside: tuple[float, float] = (0.0, 0.0),
    **hidden: Any,
) -> Printer:
    """A printer as people build one: half a millimetre here, a tenth of a degree there; towers that
    lean by `lean`, 1 sigma; a probe that is a millimetre off its place `beside` the nozzle (m)."""
    rng = np.random.default_rng([seed, 31])

    def three(sigma: float) -> Array:
        return sigma * rng.standard_normal(3)

    towers = three(0.5e-3), three(0.5e-3), three(0.3e-3), three(2e-3)
    x, y, rx, ry = rng.standard_normal(4)
    leans = lean * rng.standard_normal((3, 2))
    return Printer(
        *towers,
        pitch * np.array([1.0, -0.8, 0.6]),
        lean=leans,
        tilt=(3e-3 * rx, 3e-3 * ry),
        probe=(beside[0] + 1e-3 * x, beside[1] + 1e-3 * y),
        **hidden,
    )


def places(n: int, seed: int) -> Array:
    """n places (n, 2) all over the round bed."""
    rng = np.random.default_rng([seed, 32])
    out, around = REACH * np.sqrt(rng.random(n)), rng.uniform(0, 2 * np.pi, n)
    return np.column_stack([out * np.cos(around), out * np.sin(around)])


CONFIG = """\
; config.g of a small delta printer, as its kit's manual has it
M92 X160 Y160 Z160            ; steps a mm
M665 L250 R100 H300 B65       ; rods, delta radius, homed height, printable radius (mm)
M666 X0 Y0 Z0                 ; end-stops (mm)
G31 P500 X0 Y0 Z0.1           ; the nozzle probes, trigger height 0.1 mm
"""


def believed(r: Array) -> Array:
    """Carriage heights (N, 3) of the firmware with CONFIG for the nozzle at r (N, 3)."""
    around = np.radians([210.0, 330.0, 90.0])
    towers = 0.1 * np.column_stack([np.cos(around), np.sin(around)])
    away = np.linalg.norm(r[:, None, :2] - towers, axis=2)
    return r[:, 2:] + np.sqrt(0.25**2 - away**2)


def heights(printer: Printer, xy: Array, believed: Callable[[Array], Array] = believed) -> Array:
    """Believed heights (N,) at which the nozzle touches the bed on its way down at believed xy."""
    return touching(printer, xy, believed)[:, 2]


def touching(printer: Printer, xy: Array, believed: Callable[[Array], Array] = believed) -> Array:
    """Where the nozzle really is, u and v, and the believed height (N, 3), as it touches the bed at
    believed xy: its carriages are where the firmware wants them."""
    turned = replace(printer, angle=printer.angle + np.radians(210.0))
    unknown = np.column_stack([xy, np.zeros(len(xy))])  # u, v, believed height

    def missed(unknown: Array) -> Array:
        real = printer.nozzle(unknown[:, :2])
        return turned.readings(real) - believed(np.column_stack([xy, unknown[:, 2]]))

    for _ in range(20):
        now, J = missed(unknown), np.empty((len(xy), 3, 3))
        for k, step in enumerate(1e-7 * np.eye(3)):
            J[:, :, k] = (missed(unknown + step) - now) / 1e-7
        unknown = unknown - np.linalg.solve(J, now[:, :, None])[:, :, 0]
    return unknown


def height_map(
    printer: Printer,
    seed: int,
    step: float,
    noise: float = 5e-6,
    beside: tuple[float, float] = (0.0, 0.0),
) -> str:
    """heightmap.csv of a grid of `step` m over the round bed, touched with some noise (m) by a
    probe that is configured to be `beside` the nozzle (m)."""
    n = int(2 * REACH / step + 1e-9) + 1
    line = step * (np.arange(n) - (n - 1) / 2)
    x, y = (each.ravel() for each in np.meshgrid(line, line))
    on_bed = np.hypot(x, y) < REACH
    found = np.zeros(n * n)
    found[on_bed] = heights(printer, np.column_stack([x, y])[on_bed] - beside)
    found += noise * np.random.default_rng([seed, 34]).standard_normal(n * n)
    cells = [f"{1e3 * h:7.3f}" if on else "      0" for h, on in zip(found, on_bed, strict=True)]
    low, high, apart = (f"{1e3 * length:.2f}" for length in (line[0], line[-1], step))
    rows = [",".join(cells[k * n : (k + 1) * n]) for k in range(n)]
    return "\n".join(
        [
            "RepRapFirmware height map file v2 generated at 2026-11-22 10:00, "
            "min error 0, max error 0",
            "axis0,axis1,min0,max0,min1,max1,radius,spacing0,spacing1,num0,num1",
            f"X,Y,{low},{high},{low},{high},{1e3 * REACH:.1f},{apart},{apart},{n},{n}",
            *rows,
            "",
        ]
    )
