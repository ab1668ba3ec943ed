"""Parts: laws of one driver in several places, which together describe one error.

What heats up a robot makes its arms, its rods and its base grow. One law at a time, the search
finds the place that imitates all of these best, and what is left of each is too small to be seen.
Together, their places and coefficients are as well determined as the data allow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from parallel_cal.base.confidence import EQUAL_EVIDENCE
from parallel_cal.diagnosis.thresholds import MIN_COLUMN_REMAINDER
from parallel_cal.discovery.formula import Formula, build_columns
from parallel_cal.discovery.places import DEVICE
from parallel_cal.discovery.screening import Hypothesis, Targets, evidence

MAX_ROUNDS = 10  # of exchanges; each makes the data likelier, so that few are needed
MIN_EXCHANGE_EVIDENCE = 1.0  # log of how much likelier a place makes the data than the more usual


@dataclass(frozen=True)
class Part:
    """One of several laws of a driver. Its formula's evidence is what it gains beside the others;
    `equal` are the laws that describe the data as well in its stead."""

    formula: Formula
    equal: tuple[Formula, ...]


@dataclass(frozen=True)
class Parts:
    """Several laws of a driver, that with the largest share first, and the evidence of all."""

    laws: tuple[Part, ...]
    evidence: float


def find_parts(
    targets: Targets, start: Formula, hypotheses: Sequence[Hypothesis], limit: int
) -> Parts | None:
    """Find at most `limit` laws with the terms of a law of one driver, in places of `hypotheses`,
    that describe the first residual of the targets together; None if no further place makes the
    data clearly likelier.

    A place is added, and each place is exchanged for a clearly better one, as long as this makes
    the data likelier.
    """
    places = {start.hypothesis.key: start.hypothesis}
    for one in hypotheses:
        places.setdefault(one.key, replace(one, wave=start.hypothesis.wave))
    choice = _Choice(targets, start, list(places.values()))
    chosen, best = [0], choice.judge([0])
    while len(chosen) < limit:
        number, _ = choice.find_best(chosen)
        trial = choice.exchange([*chosen, number])
        gained = choice.judge(trial)
        if gained < best + EQUAL_EVIDENCE:
            break
        chosen, best = trial, gained
    return Parts(choice.list_parts(chosen), best) if len(chosen) > 1 else None


class _Choice:
    """A choice among places that err with one driver."""

    def __init__(self, targets: Targets, start: Formula, hypotheses: Sequence[Hypothesis]):
        self._targets, self._start, self._hypotheses = targets, start, hypotheses
        self._raw = [build_columns(one, start.terms) for one in hypotheses]
        self._residual = targets.residuals[:, 0]
        self._total = float(self._residual @ self._residual)
        Q = targets.directions
        self._scales = [1 / np.maximum(np.linalg.norm(own, axis=0), 1e-12) for own in self._raw]
        unit = [own * scale for own, scale in zip(self._raw, self._scales, strict=True)]
        self._projected = [own - Q @ (Q.T @ own) for own in unit]
        everything = np.hstack(self._projected)
        self._starts = np.r_[0, np.cumsum([own.shape[1] for own in unit])]
        self._gram = everything.T @ everything
        self._onto = everything.T @ self._residual

    def _columns_of(self, chosen: Sequence[int]) -> np.ndarray:
        return np.concatenate([np.arange(*self._starts[k : k + 2]) for k in chosen])

    def judge(self, chosen: Sequence[int]) -> float:
        """Evidence of some places together."""
        at = self._columns_of(chosen)
        squares, V = np.linalg.eigh(self._gram[np.ix_(at, at)])
        visible = squares > MIN_COLUMN_REMAINDER**2
        g = (V[:, visible].T @ self._onto[at]) / np.sqrt(squares[visible])
        rank = int(visible.sum()) + self._start.scanned
        explained = np.array(float(g @ g))
        return float(evidence(explained, np.array(self._total), np.array(rank), self._targets.dof))

    def find_best(self, others: Sequence[int]) -> tuple[int, float]:
        """The place of the robot that describes the data best beside others, and the evidence of
        all."""
        judged = [
            (self.judge([*others, k]), k)
            for k, one in enumerate(self._hypotheses)
            if k not in others and one.site.kind != DEVICE
        ]
        gained, number = max(judged, default=(-np.inf, 0))
        return number, gained

    def exchange(self, chosen: Sequence[int]) -> list[int]:
        """Exchange each place for a better one, as long as this makes the data likelier."""
        chosen, best = list(chosen), self.judge(chosen)
        for _ in range(MAX_ROUNDS):
            before = best
            for k in range(len(chosen)):
                others = [*chosen[:k], *chosen[k + 1 :]]
                number, gained = self.find_best(others)
                if gained > best + MIN_EXCHANGE_EVIDENCE:
                    chosen[k], best = number, gained
            if best == before:
                break
        return chosen

    def list_parts(self, chosen: Sequence[int]) -> tuple[Part, ...]:
        """The law of each place, that with the largest share first."""
        values, sigmas = self._solve(chosen)
        whole, parts = self.judge(chosen), list[Part]()
        for k, number in enumerate(chosen):
            others = [*chosen[:k], *chosen[k + 1 :]]
            formula = self._write(number, values[k], sigmas[k], whole - self.judge(others))
            equal = [
                self._write_beside(others, other)
                for other in range(len(self._hypotheses))
                if other not in chosen and self.judge([*others, other]) > whole - EQUAL_EVIDENCE
            ]
            equal.sort(key=lambda one: one.preference)
            parts.append(Part(formula, tuple(equal)))
        return tuple(sorted(parts, key=lambda one: -one.formula.evidence))

    def _solve(self, chosen: Sequence[int]) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """The coefficients of each place, fitted together, and their standard deviations."""
        at = self._columns_of(chosen)
        inverse = np.linalg.pinv(
            self._gram[np.ix_(at, at)], rcond=MIN_COLUMN_REMAINDER**2, hermitian=True
        )
        found = -inverse @ self._onto[at]  # the error cancels the residual
        rest = self._total + float(found @ self._onto[at])
        rest = max(rest, 1e-300) / max(self._targets.dof - len(at), 1)
        scale = np.concatenate([self._scales[k] for k in chosen])
        ends = np.cumsum([len(self._scales[k]) for k in chosen])[:-1]
        sigma = np.sqrt(np.diag(inverse) * rest) * scale
        return np.split(found * scale, ends), np.split(sigma, ends)

    def _write_beside(self, others: Sequence[int], number: int) -> Formula:
        """The law of a place, fitted together with others."""
        chosen = [*others, number]
        values, sigmas = self._solve(chosen)
        return self._write(number, values[-1], sigmas[-1], self.judge(chosen) - self.judge(others))

    def _write(self, number: int, values: np.ndarray, sigma: np.ndarray, gained: float) -> Formula:
        shape = len(self._start.terms), -1
        return Formula(
            self._hypotheses[number],
            self._start.terms,
            values.reshape(shape),
            sigma.reshape(shape),
            gained,
            self._raw[number],
        )
