"""Legs that swing in a plane: a hinge, a rod, and a ball on the platform (3-PRS, 3-RRS)."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import casadi as ca

from parallel_cal.base.rotation import rot_x, rot_z
from parallel_cal.base.units import DEGREE
from parallel_cal.mechanisms._controller import read_switches
from parallel_cal.model.drawing import Line, axis
from parallel_cal.model.drawing import ring as closed
from parallel_cal.model.mechanism import POSE, Mechanism, Workspace
from parallel_cal.model.parameters import Named, Parameter

CHAINS = ("chain1", "chain2", "chain3")
TOLERANCES = {"m": 0.5e-3, "rad": 0.5 * DEGREE}
# In the chain's frame: x outwards, y along the hinge, z up. name: unit, label.
HINGE = {
    "gamma": ("rad", "hinge's turn about z"),
    "delta": ("rad", "hinge's tilt"),
    "rod": ("m", "rod length"),
    "B_x": ("m", "platform joint's x"),
    "B_y": ("m", "platform joint's y"),
    "B_z": ("m", "platform joint's z"),
}


def chain_tables(
    drive: Mapping[str, tuple[str, str]], nominal: Mapping[str, float]
) -> list[Parameter]:
    """Make the parameters of three equal chains: those of the drive, then those of the hinge."""
    return [
        Parameter(f"{chain}.{name}", unit, nominal.get(name, 0.0), TOLERANCES[unit], label=label)
        for chain in CHAINS
        for name, (unit, label) in {**drive, **HINGE}.items()
    ]


class SwingLegs(Mechanism):
    """Three rods, each on a hinge E with the axis n that the drive moves, and a ball B."""

    joints = ("joint1", "joint2", "joint3")
    moves = POSE
    controls = ("z", "rx", "ry")
    parts: tuple[str, ...] = ("rod",)
    direction = 0.0

    def set_up(self, height: float, turn: float, rise: float, switches: Any) -> None:
        """Set the workspace, +- rise (m) and turn (rad) about home, and the switches."""
        self.workspace = Workspace((height - rise, -turn, -turn), (height + rise, turn, turn))
        self.switches = read_switches(switches, 3)

    @abstractmethod
    def hinge(self, i: int, q: Any, c: Named) -> tuple[Any, Any]:
        """Return a point E of the hinge's axis (3, 1) and its direction n, in the chain's frame."""

    @abstractmethod
    def drawn_drive(self, i: int, q: Any, p: Named) -> list[Line]:
        """Draw the drive of one chain."""

    def closure(self, q: Any, r: Any, R: Any, p: Named) -> Any:
        """Compute the length errors (|B - E|^2 - rod^2) / (2 rod) of the rods, then the distances
        n . (B - E) of the balls from the planes in which the rods swing, in metres."""
        lengths, planes = [], []
        for chain, (E, n, B) in zip(CHAINS, self.hinges(q, r, R, p), strict=True):
            rod = p[chain].rod
            lengths.append((ca.sumsqr(B - E) - rod**2) / (2 * rod))
            planes.append(ca.dot(n, B - E))
        return ca.vertcat(*lengths, *planes)

    def hinges(self, q: Any, r: Any, R: Any, p: Named) -> list[tuple[Any, Any, Any]]:
        """Return E, n and the ball B of each chain in {B}, (3, 1) each."""
        found = []
        for i, chain in enumerate(CHAINS):
            T, c = self.frame(i), p[chain]
            E, n = self.hinge(i, q[i], c)
            found.append((T @ E, T @ n, r + R @ T @ c.vector("B_x", "B_y", "B_z")))
        return found

    def frame(self, i: int) -> Any:
        """Rotation from a chain's frame to {B}; the platform's parts are turned likewise."""
        return rot_z(self.direction + i * 120 * DEGREE)

    def rod_lengths(self, p: Named) -> list[Any]:
        return [p[chain].rod for chain in CHAINS]

    def centres(self, q: Any, r: Any, R: Any, p: Named) -> Mapping[str, list[Any]]:
        """Return the middles of the rods."""
        return {"rod": [(E + B) / 2 for E, _, B in self.hinges(q, r, R, p)]}

    def drawing(self, q: Any, r: Any, R: Any, p: Named) -> list[Line]:
        """Draw drives, hinges, rods and the platform."""
        lines = []
        parts = self.hinges(q, r, R, p)
        for i, (chain, (E, n, B)) in enumerate(zip(CHAINS, parts, strict=True)):
            lines += [
                *self.drawn_drive(i, q, p),
                axis(E, n, 0.15 * self.length, f"{chain}.gamma", f"{chain}.delta"),
                Line("rod", (E, B), (f"{chain}.rod",)),
            ]
        return [*lines, closed("platform", [B for _, _, B in parts], "*.B_?")]


def hinge_axis(c: Named) -> Any:
    """Return the axis of a hinge, parallel to y but for its errors: Rz(gamma) Rx(delta) y."""
    return rot_z(c.gamma) @ rot_x(c.delta)[:, 1]
