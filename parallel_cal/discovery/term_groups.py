"""The terms that may describe an error, in groups that are chosen together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from parallel_cal.discovery.basis import frequencies
from parallel_cal.discovery.drivers import TIME, Driver
from parallel_cal.discovery.formula import POWERS, Factor, Term, is_reading
from parallel_cal.discovery.screening import Hypothesis

CENTRES = 24  # of a bump or a step, over the range of its driver
WIDTHS = (0.02, 0.04, 0.08, 0.15, 0.3)  # of a bump or a step, as shares of the range
# In which a law saturates or settles, as shares of the largest value: so close that a refinement
# does not change which of the two describes the data better.
SCALES = (0.05, 0.07, 0.1, 0.14, 0.2, 0.28, 0.4, 0.56, 0.8)


@dataclass(frozen=True)
class Group:
    """Terms that are chosen together, such as sine and cosine; `scanned` is the number of constants
    that were searched for, each of which counts like a coefficient."""

    terms: tuple[Term, ...]
    scanned: int = 0


def iterate_groups(hypothesis: Hypothesis, n_samples: int) -> Iterator[Group]:
    """Iterate over the groups of terms that may describe a hypothesis."""
    numbers = range(len(hypothesis.drivers))
    for number in numbers:
        own = hypothesis.drivers[number]
        for factor in _plain_factors(own):
            yield Group((Term(((number, factor),)),))
        yield from _scanned_groups(number, own)
    if len(hypothesis.drivers) < 2:
        return
    one, other = (list(_plain_factors(own)) for own in hypothesis.drivers)
    for a, b in product(one, other):
        if a.dimension + b.dimension <= 4:
            yield Group((Term(((0, a), (1, b))),))


def _plain_factors(own: Sequence[Driver]) -> Iterator[Factor]:
    values = np.unique(np.concatenate([one.values for one in own]))
    few = len(values)
    for power in POWERS:
        if power < few:
            yield Factor("power", (float(power),))
    # A reading or a place has no zero of its own at which an error could have a corner.
    if few > 2 and values[0] < 0 < values[-1] and own[0].zero == 0:
        yield Factor("absolute")
        if few > 3:
            yield Factor("sign")


def _scanned_groups(number: int, own: Sequence[Driver]) -> Iterator[Group]:
    """Terms with a constant that is scanned: none for a driver of few values."""
    if own[0].few_values:
        return
    values = np.concatenate([one.values for one in own])
    low, span, largest = float(values.min()), float(np.ptp(values)), float(np.abs(values).max())

    def term(kind: str, *constants: float) -> Term:
        return Term(((number, Factor(kind, constants)),))

    if is_reading(own):
        at = list(frequencies(values))
        if own[0].unit == "rad":  # whole harmonics of a turn, which the scan does not meet
            at += [float(k) for k in range(1, 5)]
        for w in at:
            yield Group((term("sin", w), term("cos", w)), 1)
    for share in SCALES:
        # A reading or a place has no zero of its own from which an error could saturate.
        if low < 0 or own[0].zero == 0:
            yield Group((term("saturating", share * largest),), 1)
        if own[0].family == TIME:  # what warms up or creeps after the start: a first-order lag
            yield Group((term("settling", share * largest),), 1)
    for centre in low + span * (np.arange(CENTRES) + 0.5) / CENTRES:
        for share in WIDTHS:
            for kind in ("bump", "step"):
                yield Group((term(kind, float(centre), share * span),), 2)


def scan_steps(own: Sequence[Driver], factor: Factor) -> np.ndarray:
    """Distances from scanned constants to their neighbours in the scan."""
    span = float(np.ptp(np.concatenate([one.values for one in own])))
    half = factor.constants[0] / 2
    first = {"sin": np.pi / (2 * span), "saturating": half, "settling": half}
    steps = [first.get(factor.kind, span / CENTRES), *(c / 2 for c in factor.constants[1:])]
    return np.array(steps)


def with_constants(group: Group, constants: np.ndarray) -> Group:
    """A group of terms with other scanned constants, which all its terms share."""
    values = tuple(float(value) for value in constants)
    terms = tuple(
        Term(tuple((number, Factor(one.kind, values)) for number, one in term.factors))
        for term in group.terms
    )
    return Group(terms, group.scanned)
