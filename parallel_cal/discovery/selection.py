"""Select the shortest sum of terms that describes an error where the screening found it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from parallel_cal.base.confidence import EQUAL_EVIDENCE
from parallel_cal.diagnosis.thresholds import CREDIBLE, MIN_COLUMN_REMAINDER
from parallel_cal.discovery.formula import Formula, build_columns
from parallel_cal.discovery.screening import Hypothesis, Targets, evidence
from parallel_cal.discovery.term_groups import Group, iterate_groups, scan_steps, with_constants
from parallel_cal.discovery.thresholds import (
    MAX_TERMS,
    REDRAWS,
)


def find_formula(targets: Targets, hypothesis: Hypothesis) -> Formula | None:
    """Find the shortest formula for a hypothesis, on the first residual of the targets; None if no
    term describes the residual.

    Terms are added while each makes the data clearly likelier, and removed if later ones make them
    superfluous, or if their sign changes with the choice of the poses. Members that the samples do
    not show are not in the formula.
    """
    found = _find_formula_of_all(targets, hypothesis)
    shown = [] if found is None else _list_shown_members(targets, found)
    if found is None or not 0 < len(shown) < found.coefficients.shape[1]:
        return found
    return find_formula(targets, hypothesis.of_members(shown))


def _list_shown_members(targets: Targets, formula: Formula) -> list[int]:
    """Numbers of the members that move the residual by a standard deviation of its noise, if a
    coefficient of theirs has the size that it has among all members. Of others, any value would
    describe the samples as well."""
    Q, r, c = targets.directions, targets.residuals[:, 0], formula.coefficients
    B = formula.columns - Q @ (Q.T @ formula.columns)
    left = r - B @ np.linalg.lstsq(B, r, rcond=MIN_COLUMN_REMAINDER)[0]
    noise = np.sqrt(left @ left / targets.dof)
    weight = 1 / np.maximum(formula.sigma, 1e-300) ** 2
    size = np.sqrt(np.sum(weight * c**2, axis=1) / np.sum(weight, axis=1))
    moved = size[:, None] * np.linalg.norm(B, axis=0).reshape(c.shape)
    return np.flatnonzero(np.any(moved > noise, axis=0)).tolist()


def _find_formula_of_all(targets: Targets, hypothesis: Hypothesis) -> Formula | None:
    """Find the formula of all members of a hypothesis."""
    groups = list(iterate_groups(hypothesis, len(targets.residuals) // targets.rows))
    search = Selection(targets, hypothesis, groups)
    chosen = search.forward()
    chosen = search.backward(chosen)
    while chosen:
        unstable = _find_unstable(search, chosen)
        if unstable is None:
            break
        chosen = [number for number in chosen if number != unstable]
    return search.formula(chosen) if chosen else None


class _Columns(NamedTuple):
    """Columns (n, k) of groups: as they are, what scales them to length 1, and scaled columns
    without what the model can imitate."""

    raw: np.ndarray
    scale: np.ndarray
    projected: np.ndarray


@dataclass(frozen=True)
class _Alike:
    """Groups of as many terms each, compared by sums over samples.

    `values` (members, groups, terms, N) are the terms, `gram` (groups, k, k) the products of the
    columns of each group, and `along` (groups, k, p) their parts along what the model can imitate.
    """

    numbers: list[int]
    values: np.ndarray
    each: bool
    gram: np.ndarray
    along: np.ndarray

    @classmethod
    def of(
        cls,
        hypothesis: Hypothesis,
        groups: Sequence[Group],
        numbers: list[int],
        along: np.ndarray,
        weights: np.ndarray,
    ) -> _Alike:
        members, each = len(hypothesis.site.members), hypothesis.site.each
        common = all(one is own[0] for own in hypothesis.drivers for one in own)
        drivers = [
            np.concatenate([one.values for one in (own[:1] if common else own)])
            for own in hypothesis.drivers
        ]
        every = np.array([[term.value(drivers) for term in group.terms] for group in groups])
        values = every.reshape(*every.shape[:2], -1, weights.shape[2]).transpose(2, 0, 1, 3)
        values = np.ascontiguousarray(values)  # a product with all terms is then a single one
        values = np.broadcast_to(values, (members, *values.shape[1:]))
        _, g, terms, _ = values.shape
        products = np.empty((g, terms, members, terms, members))
        for i in range(members):
            for j in range(i, members):
                block = (values[i] * weights[i, j]) @ values[j].transpose(0, 2, 1)
                products[:, :, i, :, j] = block
                products[:, :, j, :, i] = block.transpose(0, 2, 1)
        k = terms * members if each else terms
        gram = products.reshape(g, k, k) if each else np.asarray(products.sum(axis=(2, 4)))
        one = cls(numbers, values, each, gram, np.zeros((g, k, 0)))
        return replace(one, along=one.project(along))

    def project(self, along: np.ndarray) -> np.ndarray:
        """Products (groups, k, p) of the columns with vectors, of which each member at each sample
        has `along` (members, N, p) in common with an error."""
        members, groups, terms, n = self.values.shape
        by_member = self.values.reshape(members, groups * terms, n) @ along
        by_member = by_member.reshape(members, groups, terms, along.shape[2])
        if self.each:
            by_group = by_member.transpose(1, 2, 0, 3)
            return by_group.reshape(*self.gram.shape[:2], along.shape[2])
        return by_member.sum(axis=0)

    def explain(self, along: np.ndarray, left: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Squares (groups,) that each group explains of a residual, and its rank, beside columns
        that were chosen; `along` and `left` are what errors have in common with these and with the
        residual."""
        Z = np.concatenate([self.along, self.project(along)], axis=2)
        onto = self.project(left)[:, :, 0]
        lengths = np.sqrt(np.maximum(np.diagonal(self.gram, axis1=1, axis2=2), 0.0))
        scale = np.where(lengths > 1e-12, 1 / np.maximum(lengths, 1e-12), 0.0)
        rest = (self.gram - Z @ Z.transpose(0, 2, 1)) * scale[:, :, None] * scale[:, None, :]
        squares, V = np.linalg.eigh(rest)
        visible = squares > MIN_COLUMN_REMAINDER**2
        inverse = np.where(visible, np.maximum(squares, 1e-300) ** -0.5, 0.0)
        g = np.einsum("gij,gi->gj", V, onto * scale) * inverse
        return np.sum(g**2, axis=1), visible.sum(axis=1)


class Selection:
    """Forward selection of groups of terms, on columns without what the model can imitate.

    Groups are compared by sums over samples. Columns over all rows are built for chosen groups
    only: those of all groups would fill the memory.
    """

    def __init__(self, targets: Targets, hypothesis: Hypothesis, groups: Sequence[Group]):
        self.hypothesis, self.groups, self.targets = hypothesis, list(groups), targets
        self._built: dict[int, _Columns] = {}
        self._r = targets.residuals[:, 0]
        self._total = float(self._r @ self._r)
        self._J = np.array([place.columns for place in hypothesis.site.members])
        self._along = self._sum_rows(targets.directions)
        # Products of what errors of two members change at each sample.
        self._weights = np.einsum("inr,jnr->ijn", self._J, self._J, optimize=True)
        numbers_of: dict[int, list[int]] = {}
        for number, group in enumerate(groups):
            numbers_of.setdefault(len(group.terms), []).append(number)
        self._alike = [
            self._compare([groups[n] for n in numbers], numbers) for numbers in numbers_of.values()
        ]

    def _compare(self, groups: Sequence[Group], numbers: list[int]) -> _Alike:
        return _Alike.of(self.hypothesis, groups, numbers, self._along, self._weights)

    def _sum_rows(self, vectors: np.ndarray) -> np.ndarray:
        """What an error of each member at each sample has in common with vectors (n, k):
        (members, N, k)."""
        by_sample = vectors.reshape(*self._J.shape[1:], vectors.shape[1])
        return np.einsum("mnr,nrk->mnk", self._J, by_sample, optimize=True)

    def build(self, chosen: Sequence[int]) -> _Columns:
        """The columns of some groups."""
        for number in chosen:
            if number not in self._built:
                raw = build_columns(self.hypothesis, self.groups[number].terms)
                lengths, Q = np.linalg.norm(raw, axis=0), self.targets.directions
                scale = np.where(lengths > 1e-12, 1 / np.maximum(lengths, 1e-12), 0.0)
                unit = raw * scale
                self._built[number] = _Columns(raw, scale, unit - Q @ (Q.T @ unit))
        nothing = np.zeros((len(self._r), 0))
        parts = [_Columns(nothing, np.zeros(0), nothing), *(self._built[n] for n in chosen)]
        raw, scale, projected = (np.concatenate(own, axis=-1) for own in zip(*parts, strict=True))
        return _Columns(raw, scale, projected)

    def judge(self, chosen: Sequence[int]) -> float:
        """Evidence of some groups together."""
        if not chosen:
            return 0.0
        B = self.build(chosen).projected
        squares, V = np.linalg.eigh(B.T @ B)
        visible = squares > MIN_COLUMN_REMAINDER**2
        g = (V[:, visible].T @ (B.T @ self._r)) / np.sqrt(squares[visible])
        rank = int(visible.sum()) + sum(self.groups[number].scanned for number in chosen)
        rank += self.hypothesis.scanned
        found = evidence(
            np.array(float(g @ g)), np.array(self._total), np.array(rank), self.targets.dof
        )
        return float(found)

    def forward(self) -> list[int]:
        chosen: list[int] = []
        while len(chosen) < MAX_TERMS:
            number, gain = self._find_best(chosen)
            if number is None or gain < EQUAL_EVIDENCE:
                break
            chosen.append(self._refine(number, chosen))
        return chosen

    def _span(self, chosen: Sequence[int]) -> np.ndarray:
        """Orthonormal directions (n, k) of some groups, without what the model can imitate."""
        U, sizes, _ = np.linalg.svd(self.build(chosen).projected, full_matrices=False)
        return np.asarray(U[:, sizes > MIN_COLUMN_REMAINDER])

    def _find_best(self, chosen: Sequence[int]) -> tuple[int | None, float]:
        """The group that makes the data likeliest next to those chosen, and its gain."""
        U = self._span(chosen)
        r = self._r - U @ (U.T @ self._r)
        rest = np.array(float(r @ r))
        along, left = self._sum_rows(U), self._sum_rows(r[:, None])
        best: tuple[int | None, float] = (None, 0.0)
        for alike in self._alike:
            explained, rank = alike.explain(along, left)
            rank = rank + [self.groups[n].scanned for n in alike.numbers]
            gains = evidence(explained, rest, rank, self.targets.dof)
            gains[np.isin(alike.numbers, chosen)] = -np.inf
            k = int(np.argmax(gains))
            if gains[k] > best[1]:
                best = alike.numbers[k], float(gains[k])
        return best

    def _refine(self, number: int, others: Sequence[int]) -> int:
        """The number of a group whose scanned constants fit best next to the others: between those
        of the scan, or as they are if they fit best."""
        from scipy.optimize import minimize

        group = self.groups[number]
        if not group.scanned:
            return number
        driver, factor = group.terms[0].factors[0]
        start = np.array(factor.constants)
        steps = scan_steps(self.hypothesis.drivers[driver], factor)
        U = self._span(others)
        r = self._r - U @ (U.T @ self._r)
        along, left = self._sum_rows(U), self._sum_rows(r[:, None])

        def left_over(away: np.ndarray) -> float:
            constants = start + steps * away
            if np.any(np.abs(away) > 1.5) or (len(constants) > 1 and constants[1] <= 0):
                return self._total
            own = self._compare([with_constants(group, constants)], [number])
            return self._total - float(own.explain(along, left)[0][0])

        simplex = np.vstack([np.zeros(len(start)), 0.5 * np.eye(len(start))])
        found = minimize(
            left_over,
            simplex[0],
            method="Nelder-Mead",
            options={"initial_simplex": simplex, "xatol": 0.01, "fatol": 1e-3, "maxfev": 60},
        )
        self.groups.append(with_constants(group, start + steps * found.x))
        return len(self.groups) - 1

    def backward(self, chosen: list[int]) -> list[int]:
        """Remove groups without which the data are about as likely."""
        while len(chosen) > 1:
            whole = self.judge(chosen)
            without = [[n for n in chosen if n != g] for g in chosen]
            evidences = [self.judge(own) for own in without]
            k = int(np.argmax(evidences))
            if whole - evidences[k] >= EQUAL_EVIDENCE:
                break
            chosen = without[k]
        return chosen

    def solve(self, chosen: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Coefficients of the chosen columns, and their covariance."""
        _, scale, B = self.build(chosen)
        inverse = np.linalg.pinv(B.T @ B, rcond=MIN_COLUMN_REMAINDER**2, hermitian=True)
        found = -inverse @ (B.T @ self._r)  # the error cancels the residual
        rest = float(np.sum((self._r + B @ found) ** 2)) / max(self.targets.dof - len(scale), 1)
        return found * scale, inverse * np.outer(scale, scale) * max(rest, 1e-300)

    def formula(self, chosen: Sequence[int]) -> Formula:
        values, covariance = self.solve(chosen)
        terms = tuple(term for number in chosen for term in self.groups[number].terms)
        members = len(self.hypothesis.site.members) if self.hypothesis.site.each else 1
        shape = len(terms), members
        return Formula(
            self.hypothesis,
            terms,
            values.reshape(shape),
            np.sqrt(np.diag(covariance)).reshape(shape),
            self.judge(chosen),
            self.build(chosen).raw,
        )


def _find_unstable(search: Selection, chosen: Sequence[int]) -> int | None:
    """The group whose terms all change their sign with the choice of the poses; None if all keep
    it. Visits of one pose stay together."""
    order = np.argsort(search.targets.group, kind="stable")
    group = search.targets.group[order]
    rng = np.random.default_rng(0)
    B = search.build(chosen).projected
    Z = np.column_stack([B, search.targets.residuals[:, 0]])
    rows = Z.reshape(-1, search.targets.rows, Z.shape[1])[order].reshape(Z.shape)
    ends = search.targets.rows * (np.flatnonzero(np.diff(group)) + 1)
    grams = np.array([own.T @ own for own in np.split(rows, ends)])
    k, n, found = B.shape[1], len(grams), []
    for _ in range(REDRAWS):
        count = np.bincount(rng.integers(n, size=n), minlength=n)
        G = np.tensordot(count, grams, axes=1)
        found.append(np.linalg.pinv(G[:k, :k], rcond=1e-9, hermitian=True) @ G[:k, k])
    signs = np.abs(np.mean(np.sign(found), axis=0))
    start, worst, least = 0, None, 2 * CREDIBLE - 1
    for number in chosen:
        width = len(search.build([number]).scale)
        stable = float(np.max(signs[start : start + width]))
        if stable < least:
            worst, least = number, stable
        start += width
    return worst
