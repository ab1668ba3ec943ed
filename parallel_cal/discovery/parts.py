"""Parts: laws of one driver in several places, which together describe one error.

What heats up a robot makes its arms, its rods and its base grow. One law at a time, the search
finds the place that imitates all of these best, and what is left of each is too small to be seen.
Together, their places and coefficients are as well determined as the data allow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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
        places.setdefault(one.key, one)
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
        self._columns = np.hstack(
            [own * scale for own, scale in zip(self._raw, self._scales, strict=True)]
        )
        self._columns -= Q @ (Q.T @ self._columns)
        self._starts = np.r_[0, np.cumsum([own.shape[1] for own in self._raw])]
        self._onto = self._columns.T @ self._residual
        self._products: dict[int, np.ndarray] = {}
        each = [self._columns[:, self._columns_of([k])] for k in range(len(hypotheses))]
        self._own = [own.T @ own for own in each]
        widths = np.array([own.shape[1] for own in each])
        self._alike = [np.flatnonzero(widths == width).tolist() for width in np.unique(widths)]

    def _multiply(self, number: int) -> np.ndarray:
        """Products of all columns with those of one place, computed once."""
        if number not in self._products:
            own = self._columns[:, self._columns_of([number])]
            self._products[number] = self._columns.T @ own
        return self._products[number]

    def _grams(self, others: Sequence[int], numbers: Sequence[int]) -> np.ndarray:
        """Products (c, k, k) of the columns of other places and of each one of c places with
        equally many columns."""
        beside = [np.zeros((len(self._onto), 0)), *(self._multiply(k) for k in others)]
        left, at = np.hstack(beside), np.array([self._columns_of([k]) for k in numbers])
        (c, width), m = at.shape, left.shape[1]
        gram = np.empty((c, m + width, m + width))
        gram[:, :m, :m] = left[self._columns_of(others)]
        gram[:, m:, :m] = left[at]
        gram[:, :m, m:] = left[at].transpose(0, 2, 1)
        gram[:, m:, m:] = [self._own[k] for k in numbers]
        return gram

    def _columns_of(self, chosen: Sequence[int]) -> np.ndarray:
        parts = [np.arange(*self._starts[k : k + 2]) for k in chosen]
        return np.concatenate([np.zeros(0, int), *parts])

    def judge_each(self, others: Sequence[int]) -> np.ndarray:
        """Evidence of other places together with each place."""
        found = np.empty(len(self._own))
        for numbers in self._alike:
            gram = self._grams(others, numbers)
            at = np.array([self._columns_of([*others, k]) for k in numbers])
            squares, V = np.linalg.eigh(gram)
            visible = squares > MIN_COLUMN_REMAINDER**2
            g = (self._onto[at][:, None] @ V)[:, 0]
            explained = np.sum(np.where(visible, g**2 / np.maximum(squares, 1e-300), 0.0), axis=1)
            rank = visible.sum(axis=1) + self._start.scanned
            found[numbers] = evidence(explained, self._total, rank, self._targets.dof)
        return found

    def judge(self, chosen: Sequence[int]) -> float:
        """Evidence of some places together."""
        return float(self.judge_each(chosen[:-1])[chosen[-1]])

    def find_best(self, others: Sequence[int]) -> tuple[int, float]:
        """The place of the robot that describes the data best beside others, and the evidence of
        all."""
        able = [one.site.kind != DEVICE for one in self._hypotheses]
        judged = np.where(able, self.judge_each(others), -np.inf)
        judged[list(others)] = -np.inf
        number = int(np.argmax(judged))
        return number, float(judged[number])

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
            judged = self.judge_each(others)
            equal = [
                self._write_beside(others, other)
                for other in range(len(self._hypotheses))
                if other not in chosen and judged[other] > whole - EQUAL_EVIDENCE
            ]
            equal.sort(key=lambda one: one.preference)
            parts.append(Part(formula, tuple(equal)))
        return tuple(sorted(parts, key=lambda one: -one.formula.evidence))

    def _solve(self, chosen: Sequence[int]) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """The coefficients of each place, fitted together, and their standard deviations."""
        at = self._columns_of(chosen)
        inverse = np.linalg.pinv(
            self._grams(chosen[:-1], chosen[-1:])[0], rcond=MIN_COLUMN_REMAINDER**2, hermitian=True
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
