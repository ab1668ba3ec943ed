"""Formulas: the shortest sum of terms that describes an error where the screening found it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from itertools import product
from typing import NamedTuple

import numpy as np

from parallel_cal.diagnosis.thresholds import MIN_COLUMN_REMAINDER
from parallel_cal.discovery.basis import frequencies
from parallel_cal.discovery.drivers import NEXT, PREVIOUS, READING, TIME, Driver
from parallel_cal.discovery.places import BASE, DEVICE, JOINT, PARAMETER, PLATFORM, ROD, Site
from parallel_cal.discovery.screening import DriverSet, Hypothesis, Targets, evidence
from parallel_cal.discovery.thresholds import (
    MAX_TERMS,
    MIN_SIGN_SHARE,
    MIN_TERM_EVIDENCE,
    REDRAWS,
)

PLACE_KINDS = (
    JOINT,
    PLATFORM,
    BASE,
    ROD,
    PARAMETER,
    DEVICE,
)  # the more usual place of an error first
POWERS = {1: "linear", 2: "quadratic", 3: "cubic"}
CENTRES = 24  # of a bump or a step, over the range of its driver
WIDTHS = (0.02, 0.04, 0.08, 0.15, 0.3)  # of a bump or a step, as shares of the range
# In which a law saturates or settles, as shares of the largest value: so close that a refinement
# does not change which of the two describes the data better.
SCALES = (0.05, 0.07, 0.1, 0.14, 0.2, 0.28, 0.4, 0.56, 0.8)


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
class Group:
    """Terms that are chosen together, such as sine and cosine; `scanned` is the number of constants
    that were searched for, each of which counts like a coefficient."""

    terms: tuple[Term, ...]
    scanned: int = 0


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
        unusual = site.kind != JOINT and any(_is_reading(own) for own in drivers)
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


def _is_reading(own: Sequence[Driver]) -> bool:
    return own[0].family in (READING, NEXT, PREVIOUS)


def _is_of_other_joint(site: Site, own: Sequence[Driver]) -> bool:
    """Whether joints, or parts of their chains, err with the readings of other joints: rarer than
    with their own."""
    if not _is_reading(own):
        return False
    joints = [place.joint for place in site.members]
    return any(joint not in (None, one.joint) for one, joint in zip(own, joints, strict=True))


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
    groups = list(_iterate_groups(hypothesis, len(targets.residuals) // targets.rows))
    search = _Selection(targets, hypothesis, groups)
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


class _Selection:
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
        along = self._sum_rows(targets.directions)
        # Products of what errors of two members change at each sample.
        weights = np.einsum("inr,jnr->ijn", self._J, self._J, optimize=True)
        numbers_of: dict[int, list[int]] = {}
        for number, group in enumerate(groups):
            numbers_of.setdefault(len(group.terms), []).append(number)
        self._alike = [
            _Alike.of(hypothesis, [groups[n] for n in numbers], numbers, along, weights)
            for numbers in numbers_of.values()
        ]

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
            if number is None or gain < MIN_TERM_EVIDENCE:
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
        steps = _scan_steps(self.hypothesis.drivers[driver], factor)
        Q = self.targets.directions
        U = self._span(others)

        def left_over(away: np.ndarray) -> float:
            constants = start + steps * away
            if np.any(np.abs(away) > 1.5) or (len(constants) > 1 and constants[1] <= 0):
                return self._total
            B = build_columns(self.hypothesis, _with_constants(group, constants).terms)
            B = B / np.maximum(np.linalg.norm(B, axis=0), 1e-12)
            B = B - Q @ (Q.T @ B)
            B = B - U @ (U.T @ B)
            fitted = np.linalg.lstsq(B, self._r, rcond=MIN_COLUMN_REMAINDER)[0]
            return float(np.sum((self._r - B @ fitted) ** 2))

        simplex = np.vstack([np.zeros(len(start)), 0.5 * np.eye(len(start))])
        found = minimize(
            left_over,
            simplex[0],
            method="Nelder-Mead",
            options={"initial_simplex": simplex, "xatol": 0.01, "fatol": 1e-3, "maxfev": 60},
        )
        self.groups.append(_with_constants(group, start + steps * found.x))
        return len(self.groups) - 1

    def backward(self, chosen: list[int]) -> list[int]:
        """Remove groups without which the data are about as likely."""
        while len(chosen) > 1:
            whole = self.judge(chosen)
            without = [[n for n in chosen if n != g] for g in chosen]
            evidences = [self.judge(own) for own in without]
            k = int(np.argmax(evidences))
            if whole - evidences[k] >= MIN_TERM_EVIDENCE:
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


def _iterate_groups(hypothesis: Hypothesis, n_samples: int) -> Iterator[Group]:
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

    if _is_reading(own):
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


def _scan_steps(own: Sequence[Driver], factor: Factor) -> np.ndarray:
    """Distances from scanned constants to their neighbours in the scan."""
    span = float(np.ptp(np.concatenate([one.values for one in own])))
    half = factor.constants[0] / 2
    first = {"sin": np.pi / (2 * span), "saturating": half, "settling": half}
    steps = [first.get(factor.kind, span / CENTRES), *(c / 2 for c in factor.constants[1:])]
    return np.array(steps)


def _with_constants(group: Group, constants: np.ndarray) -> Group:
    """A group of terms with other scanned constants, which all its terms share."""
    values = tuple(float(value) for value in constants)
    terms = tuple(
        Term(tuple((number, Factor(one.kind, values)) for number, one in term.factors))
        for term in group.terms
    )
    return Group(terms, group.scanned)


def _find_unstable(search: _Selection, chosen: Sequence[int]) -> int | None:
    """The group whose terms all change their sign with the choice of the poses; None if all keep
    it. Visits of one pose stay together."""
    group = search.targets.group
    names = np.unique(group)
    rng = np.random.default_rng(0)
    B = search.build(chosen).projected
    Z = np.column_stack([B, search.targets.residuals[:, 0]])
    rows = Z.reshape(-1, search.targets.rows, Z.shape[1])
    grams = np.array(
        [np.einsum("nri,nrj->ij", rows[group == name], rows[group == name]) for name in names]
    )
    k, found = B.shape[1], []
    for _ in range(REDRAWS):
        count = np.bincount(rng.integers(len(names), size=len(names)), minlength=len(names))
        G = np.tensordot(count, grams, axes=1)
        found.append(np.linalg.pinv(G[:k, :k], rcond=1e-9, hermitian=True) @ G[:k, k])
    signs = np.abs(np.mean(np.sign(found), axis=0))
    start, worst, least = 0, None, 2 * MIN_SIGN_SHARE - 1
    for number in chosen:
        width = len(search.build([number]).scale)
        stable = float(np.max(signs[start : start + width]))
        if stable < least:
            worst, least = number, stable
        start += width
    return worst
