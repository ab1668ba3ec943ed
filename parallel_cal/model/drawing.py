"""Drawings of mechanisms: lines through the points of the closure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

KINDS = ("base", "axis", "driven", "rod", "platform")


@dataclass(frozen=True)
class Line:
    """A line of one of KINDS through points (3, 1) m in {B}; `shows` are patterns of the
    parameters that it makes visible."""

    kind: str
    points: tuple[Any, ...]
    shows: tuple[str, ...] = ()


def ring(kind: str, points: Sequence[Any], *shows: str) -> Line:
    """Draw a closed line."""
    return Line(kind, (*points, points[0]), shows)


def axis(point: Any, direction: Any, half: float, *shows: str) -> Line:
    """Draw a joint's axis, `half` (m) to both sides of a point on it."""
    return Line("axis", (point - half * direction, point + half * direction), shows)
