"""A cable robot whose spools grow with the line on them and whose lines give under load.

Nothing of it comes from the package: line is wound off in small steps, the platform hangs where
springs and weight balance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from virtual_small import Cable

from parallel_cal.virtual.robot import Array, Parameters, solve
from parallel_cal.virtual.stewart import column, numbered

STEPS = 400
FALL = (0.0, 0.0, -9.81)  # m/s^2


@dataclass(frozen=True)
class Line:
    """Line of a cross-section on spools of a width (m), with a stiffness EA (N)."""

    section: float = 0.0  # m^2
    width: float = 5e-3
    EA: float = np.inf


class WoundCable(Cable):
    """The cable robot of virtual_small with real line on its spools."""

    def __init__(
        self,
        parameters: Parameters,
        line: Line,
        spools: tuple[int, ...] = (1, 1, 1, 2),
        fall: ArrayLike = FALL,
    ) -> None:
        super().__init__(parameters, spools)
        self.line, self.fall = line, np.asarray(fall, float)
        names = numbered("line", len(spools))
        self.gear = column(parameters, "gear", names)
        self.strands = column(parameters, "advantage", names)
        self.bare = np.array([parameters[f"spool{spool}.R"] for spool in spools])

    def motors(self, r: ArrayLike) -> Array:
        """Motor angles (N, lines) that let out what reaches r (N, 3): the sum of small turns.

        What is wound off leaves the spool's volume, pi radius^2 width; a step of line turns the
        spool by step / radius.
        """
        way = np.linalg.norm(np.asarray(r, float)[:, None, :] - self.anchors, axis=-1)
        off = (way - np.linalg.norm(self.anchors, axis=-1) - self.offset) * self.strands
        middle = (np.arange(STEPS) + 0.5) / STEPS
        gone = off[..., None] * middle * self.line.section
        radius = np.sqrt(self.bare[:, None] ** 2 - gone / (np.pi * self.line.width))
        return self.gear * np.mean(off[..., None] / radius, axis=-1)

    def hangs(self, r: ArrayLike, mass: ArrayLike) -> Array:
        """Where (N, 3) the platform of that mass hangs if weightless it would be at r (N, 3).

        Lines are taut there (pretension); a strand pulls with EA times its strain.
        """
        r = np.asarray(r, float)
        if np.isinf(self.line.EA):
            return r
        free = np.linalg.norm(r[:, None, :] - self.anchors, axis=-1)
        weight = np.asarray(mass)[:, None] * self.fall

        def unbalanced(sag: Array) -> Array:
            to_anchor = self.anchors - (r + sag)[:, None, :]
            length = np.linalg.norm(to_anchor, axis=-1)
            pull = self.strands * self.line.EA * (length / free - 1) / length
            return (np.sum(pull[..., None] * to_anchor, axis=1) + weight) / self.line.EA

        return r + solve(unbalanced, np.zeros(r.shape))
