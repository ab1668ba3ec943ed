"""Formulas: a sum of terms that describes an error, and its columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import reduce

import numpy as np

from parallel_cal.discovery.drivers import NEXT, PREVIOUS, READING, Driver
from parallel_cal.discovery.places import BASE, DEVICE, JOINT, PARAMETER, PLATFORM, ROD, Site
from parallel_cal.discovery.screening import DriverSet, Hypothesis

PLACE_KINDS = (
    JOINT,
    PLATFORM,
    BASE,
    ROD,
    PARAMETER,
    DEVICE,
)  # the more usual place of an error first
POWERS = {1: "linear", 2: "quadratic", 3: "cubic"}


@dataclass(frozen=True)
class Factor:
    """A function of one driver: `power`, `absolute`, `sign`, `sin`, `cos`, `saturating`,
    `settling`, `bump` or `step`; `constants` are the power, the angular frequency, the scale, or
    centre and width."""

    kind: str
    constants: tuple[float, ...] = ()

    def value(self, x: np.ndarray) -> np.ndarray:
        c = self.constants
        functions = {
            "power": lambda: x ** int(c[0]),
            "absolute": lambda: np.abs(x),
            "sign": lambda: np.sign(x),
            "sin": lambda: np.sin(c[0] * x),
            "cos": lambda: np.cos(c[0] * x),
            "saturating": lambda: np.tanh(x / c[0]),
            "settling": lambda: 1 - np.exp(-x / c[0]),
            "bump": lambda: np.exp(-(((x - c[0]) / c[1]) ** 2) / 2),
            "step": lambda: np.tanh((x - c[0]) / c[1]),
        }
        return np.asarray(functions[self.kind]())

    @property
    def dimension(self) -> int:
        """The power of the driver's unit that the factor has."""
        return {"power": int(self.constants[0]) if self.constants else 1, "absolute": 1}.get(
            self.kind, 0
        )

    @property
    def constant_names(self) -> tuple[str, ...]:
        """Names of the constants that a scan found, which an effect keeps as fixed parameters."""
        return {
            "sin": ("frequency",),
            "cos": ("frequency",),
            "saturating": ("scale",),
            "settling": ("time_constant",),
            "bump": ("centre", "width"),
            "step": ("centre", "width"),
        }.get(self.kind, ())

    def write(self, x: str, constants: Sequence[str], prefix: str = "") -> str:
        """The factor as an expression of `x` and its scanned constants; `prefix` is `ca.` in code
        of an effect."""
        c = list(constants)
        p = prefix
        if self.kind == "power":
            power = int(self.constants[0])
            return x if power == 1 else f"{x} ** {power}" if p else f"{x}^{power}"
        if self.kind == "absolute":
            return f"{p}fabs({x})" if p else f"|{x}|"
        if self.kind == "bump":
            square = f"(({x} - {c[0]}) / {c[1]}) ** 2"
            return f"{p}exp(-({square}) / 2)" if p else f"exp(-(({x} - {c[0]}) / {c[1]})^2 / 2)"
        if self.kind == "step":
            return f"{p}tanh(({x} - {c[0]}) / {c[1]})"
        if self.kind == "settling":
            return f"(1 - {p}exp(-{x} / {c[0]}))"
        if self.kind == "saturating":
            return f"{p}tanh({x} / {c[0]})"
        if self.kind == "sign":
            return f"{p}sign({x})"
        return f"{p}{self.kind}({c[0]} * {x})"

    @property
    def word(self) -> str:
        if self.kind == "power":
            return POWERS[int(self.constants[0])]
        return self.kind


@dataclass(frozen=True)
class Term:
    """A product of factors, each of one driver of the hypothesis, by its number."""

    factors: tuple[tuple[int, Factor], ...]

    def value(self, drivers: Sequence[np.ndarray]) -> np.ndarray:
        """The term (N,) at driver values (N,) each."""
        values = [factor.value(drivers[number]) for number, factor in self.factors]
        return np.asarray(reduce(np.multiply, values))

    @property
    def word(self) -> str:
        """A short name of its coefficient: `cubic`, or `linear_quadratic` of a product."""
        return "_".join(factor.word for _, factor in self.factors)


@dataclass(frozen=True)
class Formula:
    """The terms chosen for a hypothesis, their coefficients (terms, members or 1) with sigma, and
    the evidence that they gain."""

    hypothesis: Hypothesis
    terms: tuple[Term, ...]
    coefficients: np.ndarray
    sigma: np.ndarray
    evidence: float
    columns: np.ndarray = field(repr=False)

    @property
    def quantities(self) -> tuple[int, int, bool]:
        """What makes one of two equally good formulas preferable: fewer readings of other joints,
        fewer drivers, and a joint as the place if a reading is a driver."""
        site, drivers = self.hypothesis.site, self._drivers
        foreign = sum(_is_of_other_joint(site, own) for own in drivers)
        # Encoders and gears err with the angle of a joint; lengths and offsets hardly do.
        unusual = site.kind != JOINT and any(is_reading(own) for own in drivers)
        return foreign, len(drivers), unusual

    @property
    def complexity(self) -> tuple[int, int, int]:
        """What makes a formula of the same quantities preferable: fewer coefficients and scanned
        constants, the more usual place, more plausible drivers."""
        plausible = sum(own[0].rank for own in self._drivers)
        return self.numbers, PLACE_KINDS.index(self.hypothesis.site.kind), plausible

    @property
    def numbers(self) -> int:
        """The number of coefficients and of scanned constants."""
        return self.coefficients.size + self.scanned

    @property
    def preference(self) -> tuple[float, ...]:
        """What equally good formulas are sorted by, the preferred one first."""
        return *self.quantities, *self.complexity, -self.evidence

    @property
    def _drivers(self) -> list[DriverSet]:
        return [self.hypothesis.drivers[number] for number in self.used_drivers]

    @property
    def scanned(self) -> int:
        """The number of constants that were searched for; sine and cosine share one."""
        constants = {
            (number, name, value)
            for term in self.terms
            for number, factor in term.factors
            for name, value in zip(factor.constant_names, factor.constants, strict=False)
        }
        return len(constants) + self.hypothesis.scanned

    @property
    def used_drivers(self) -> tuple[int, ...]:
        """Numbers of the hypothesis' drivers that the formula depends on."""
        return tuple(sorted({number for term in self.terms for number, _ in term.factors}))


def is_reading(own: Sequence[Driver]) -> bool:
    return own[0].family in (READING, NEXT, PREVIOUS)


def _is_of_other_joint(site: Site, own: Sequence[Driver]) -> bool:
    """Whether joints, or parts of their chains, err with the readings of other joints: rarer than
    with their own."""
    if not is_reading(own):
        return False
    joints = [place.joint for place in site.members]
    return any(joint not in (None, one.joint) for one, joint in zip(own, joints, strict=True))


def build_columns(hypothesis: Hypothesis, terms: Sequence[Term]) -> np.ndarray:
    """d residual/d(coefficients of the terms) (n, k), by term, then by member if each has its
    own."""
    site = hypothesis.site
    out = []
    for term in terms:
        own = [
            place.columns * term.value([d[m].values for d in hypothesis.drivers])[:, None]
            for m, place in enumerate(site.members)
        ]
        out += [column.ravel() for column in (own if site.each else [sum(own)])]
    return np.stack(out, axis=1)
