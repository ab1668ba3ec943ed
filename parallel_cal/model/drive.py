"""The drive of a joint: a motor that moves the joint by a spool, a screw or a belt."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from parallel_cal.base.documents import make_plain


@dataclass(frozen=True)
class Spool:
    """A spool that winds a line, as the effects see it; the numbers may be CasADi expressions.

    Parameters
    ----------
    radius : float
        Radius of the line on the spool at reading zero, m.
    turn : float
        Angle (rad) by which the spool turns per unit of the joint's reading; positive if it lets
        out line.
    """

    radius: Any
    turn: Any


@dataclass(frozen=True)
class Drive:
    """The drive of a joint whose readings are lengths, as the model file states it.

    Parameters
    ----------
    kind : str
        `spool`, `screw` or `belt`.
    per_rev : float, optional
        Travel of the joint per turn of the motor, m; negative if the joint moves backwards.
    radius : float, optional
        Radius of the spool or pulley at reading zero, m, in place of `per_rev`.
    gear : float
        Turns of the motor per turn of the spool, screw or pulley. Default 1.
    advantage : float
        Line on the spool per travel of the joint, as by the blocks of a hoist. Default 1.
    line : str
        Whether a growing reading lets line `out` of the spool or winds it `in`. Default `out`.
    """

    kind: str
    per_rev: float | None = None
    radius: float | None = None
    gear: float = 1.0
    advantage: float = 1.0
    line: str = "out"

    def __post_init__(self) -> None:
        make_plain(self)

    @property
    def travel(self) -> float:
        """Travel of the joint (m) per radian of the motor."""
        if self.per_rev is not None:
            return self.per_rev / (2 * math.pi)
        return (self.radius or 0.0) / (self.gear * self.advantage)

    @property
    def lead(self) -> float:
        """Travel of the joint (m) per turn of the spool, screw or pulley."""
        return 2 * math.pi * abs(self.travel) * self.gear

    @property
    def spool(self) -> Spool | None:
        """The spool; None if the drive has none."""
        if self.kind != "spool":
            return None
        radius = abs(self.travel) * self.gear * self.advantage
        return Spool(radius, (1 if self.line == "out" else -1) * self.advantage / radius)
