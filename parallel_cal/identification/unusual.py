"""Parameters that are larger than usual: knowledge about machines, not about this one."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from parallel_cal.model.parameters import Parameter

CAUSE = "a fault, or another effect"
MM_FROM_M = 1e-3  # m: from here lengths are shown in mm


@dataclass(frozen=True)
class UnusualSize:
    """A parameter outside the range that is usual for the machine's class, all in `unit` (SI)."""

    parameter: str
    value: float
    low: float
    high: float
    unit: str
    shown_name: str = ""

    @classmethod
    def of(cls, p: Parameter, value: float) -> UnusualSize:
        low, high = p.plausible_range()
        return cls(p.name, value, low, high, p.unit, p.shown_name)

    @property
    def effect(self) -> str:
        return self.parameter.partition(".")[0]

    @property
    def description(self) -> str:
        """`backlash.joint1.width is larger than usual (34 mrad; usual up to 3): a fault, ...`"""
        name, factor = _unit_for_people(self.unit, self.value)
        value, low, high = (f"{v * factor:.3g}" for v in (self.value, self.low, self.high))
        usual = f"{low} to {high}" if self.low not in (0.0, -self.high) else f"up to {high}"
        return (
            f"{self.shown_name or self.parameter} is larger than usual "
            f"({f'{value} {name}'.rstrip()}; usual {usual}): {CAUSE}"
        )

    def document(self) -> dict[str, Any]:
        return {
            "parameter": self.parameter,
            "value": self.value,
            "unit": self.unit,
            "usual": [self.low, self.high],
            "text": self.description,
        }


def describe_by_effect(sizes: Iterable[UnusualSize]) -> dict[str, str]:
    """Describe what is unusual in one sentence for each effect: the parameter furthest outside its
    range, and how many more there are."""
    by_effect: dict[str, list[UnusualSize]] = {}
    for one in sizes:
        by_effect.setdefault(one.effect, []).append(one)
    words = dict[str, str]()
    for effect, found in by_effect.items():
        worst = max(found, key=_excess)
        others = len(found) - 1
        more = f" ({others} more of its parameters are, too)" if others else ""
        words[effect] = worst.description + more
    return words


def _excess(one: UnusualSize) -> float:
    """How many times its range a value is away from the middle of the range."""
    half = (one.high - one.low) / 2 or 1.0
    return abs(one.value - (one.low + one.high) / 2) / half


def _unit_for_people(unit: str, value: float) -> tuple[str, float]:
    """Return (name, factor): mrad for rad, um or mm for m, also in compound units such as m/N."""
    head, slash, rest = unit.partition("/")
    if head == "rad":
        return f"mrad{slash}{rest}", 1e3
    if head == "m":
        in_mm = not slash and abs(value) >= MM_FROM_M
        return ("mm", 1e3) if in_mm else (f"um{slash}{rest}", 1e6)
    return ("", 1.0) if unit == "1" else (unit, 1.0)
