"""Joints that are coupled: a controller reads one of them relative to another, or two motors move
two joints together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

Factors = tuple[tuple[int, float], ...]  # of the readings in the columns of joints


@dataclass(frozen=True)
class Coupling:
    """Joints whose readings are sums of the readings in two columns."""

    sums: tuple[tuple[int, Factors], ...]

    def apply(self, q: np.ndarray) -> np.ndarray:
        """Return the readings (N, nq) of the joints."""
        meant = q.copy()
        for joint, terms in self.sums:
            meant[:, joint] = sum(factor * q[:, k] for k, factor in terms)
        return meant

    def describe(self, names: Sequence[str]) -> str:
        """`joint2 and joint3 are coupled: joint3 = J3 + J2, where J2 and J3 are ...`"""
        coupled = sorted({k for _, terms in self.sums for k, _ in terms})
        formulas = []
        for joint, terms in self.sums:
            signed = " ".join(f"{'-' if factor < 0 else '+'} J{k + 1}" for k, factor in terms)
            words = signed.removeprefix("+ ")
            formulas.append(f"{names[joint]} = {words if terms[0][1] == 1 else f'({words}) / 2'}")
        joints = " and ".join(names[k] for k in coupled)
        columns = " and ".join(f"J{k + 1}" for k in coupled)
        entries = "; ".join(
            f"{names[joint]}: {{{', '.join(f'J{k + 1}: {factor:g}' for k, factor in terms)}}}"
            for joint, terms in self.sums
        )
        return (
            f"{joints} are coupled: {', '.join(formulas)}, where {columns} are the readings in the "
            f"columns of {joints} (column map: {entries}, with the names of these columns)"
        )


def list_couplings(units: Sequence[str]) -> Iterator[Coupling]:
    """List what couples two joints of one unit: a joint that moves with another one, such as the
    forearm on a parallelogram, and two motors that together move two joints, as those of a
    differential wrist or of two belts."""
    for i, k in combinations(range(len(units)), 2):
        if units[i] != units[k]:
            continue
        for sign in (1.0, -1.0):
            yield Coupling(((i, ((i, 1.0), (k, sign))),))
            yield Coupling(((k, ((k, 1.0), (i, sign))),))
        half, difference = ((i, 0.5), (k, 0.5)), ((i, 0.5), (k, -0.5))
        for other in (difference, ((k, 0.5), (i, -0.5))):
            yield Coupling(((i, half), (k, other)))
            yield Coupling(((i, other), (k, half)))
