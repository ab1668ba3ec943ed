"""Screening: where an error enters and on what it depends, without a formula.

A hypothesis is a site and a driver, or two. Its columns are the site's derivatives times a basis of
the driver, without what the geometry and the model's effects can imitate. Its score compares the
residual with and without these columns.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import combinations
from typing import Any, NamedTuple, TypeVar

import numpy as np

from parallel_cal.base.parallel import Runner, run_on_cores, running
from parallel_cal.diagnosis.thresholds import MIN_COLUMN_REMAINDER, SAMPLES_PER_NUMBER
from parallel_cal.discovery import basis
from parallel_cal.discovery.drivers import (
    AXIS,
    INCLINATION,
    LAGGED,
    NEXT,
    OWNERS,
    PLACES,
    PREVIOUS,
    READING,
    ROBOT,
    Driver,
)
from parallel_cal.discovery.places import BASE, DEVICE, JOINT, PARAMETER, PLATFORM, ROD, Site
from parallel_cal.discovery.thresholds import (
    FINE_SPLINES,
    MAX_CHUNK_NUMBERS,
    SPLINES,
)
from parallel_cal.posterior.scene import Scene

T = TypeVar("T")
# One driver for every member of a site: `load` of its own joint, or `payload` for all.
DriverSet = tuple[Driver, ...]
# Families of drivers that an error of a device knows.
OF_DEVICE = {*PLACES, "time", "temperature", LAGGED, "session"}


@dataclass(frozen=True)
class Hypothesis:
    """A site errs with one or two drivers."""

    site: Site
    drivers: tuple[DriverSet, ...]

    @property
    def families(self) -> tuple[str, ...]:
        """Names of the drivers; of each member's own joint without the joint."""
        return tuple(
            own[0].name if len({one.name for one in own}) == 1 else own[0].family
            for own in self.drivers
        )

    @property
    def slow(self) -> bool:
        """Whether all drivers change as slowly as noise may."""
        return all(one.slow for own in self.drivers for one in own)

    @property
    def key(self) -> tuple[str, bool, frozenset[str]]:
        """Equal for hypotheses that are one answer: time constants of a lag are not told apart."""
        lags = {own[0].name: own[0].family for own in self.drivers if own[0].family == LAGGED}
        return *self.site.key, frozenset(lags.get(name, name) for name in self.families)

    @property
    def exact_key(self) -> tuple[str, bool, tuple[str, ...]]:
        """Equal for hypotheses of the same site and the same drivers."""
        return *self.site.key, self.families

    def uses(self, driver: Driver) -> bool:
        """Whether a driver, or the same one of other joints, is one of its drivers."""
        return any(own[0].family == driver.family for own in self.drivers)

    @property
    def scanned(self) -> int:
        """The number of time constants that were searched for."""
        return sum(own[0].family == LAGGED for own in self.drivers)

    def of_members(self, numbers: Sequence[int]) -> Hypothesis:
        """This hypothesis about some members of its site only."""
        drivers = tuple(tuple(own[number] for number in numbers) for own in self.drivers)
        return replace(self, site=self.site.of_members(numbers), drivers=drivers)


@dataclass(frozen=True)
class Targets:
    """What hypotheses are scored on: `directions` (n, p), orthonormal, that the model can imitate,
    and `residuals` (n, m) without them, with `dof` degrees of freedom each. `group` (N,) is the
    number of the pose that a sample visits."""

    directions: np.ndarray = field(repr=False)
    residuals: np.ndarray = field(repr=False)
    rows: int
    dof: int
    group: np.ndarray = field(repr=False)

    @classmethod
    def of(cls, scene: Scene, residuals: np.ndarray, found: np.ndarray) -> Targets:
        """Targets from residuals (n, m), with the columns (n, k) of laws that were found."""
        Q = scene.basis
        if found.shape[1]:
            left = scene.project_off_geometry(found)
            left = scene.project_off_geometry(left / np.linalg.norm(left, axis=0))
            U, sizes, _ = np.linalg.svd(left, full_matrices=False)
            Q = np.hstack([Q, U[:, sizes > MIN_COLUMN_REMAINDER]])
        left = residuals - Q @ (Q.T @ residuals)
        dof = scene.dof - (Q.shape[1] - scene.basis.shape[1])
        return cls(Q, left, scene.rows, dof, scene.group)

    @property
    def chi2_per_dof(self) -> float:
        """That of the first residual."""
        return float(self.residuals[:, 0] @ self.residuals[:, 0]) / max(self.dof, 1)


@dataclass(frozen=True)
class Scored:
    """Hypotheses with their evidence (h, m) for each of m residuals."""

    hypotheses: Sequence[Hypothesis]
    evidence: np.ndarray


def evidence(
    explained: np.ndarray, total: np.ndarray | float, rank: np.ndarray, dof: int
) -> np.ndarray:
    """Log of how much likelier a residual is with `rank` columns that explain some of its sum of
    squares: dof/2 log(total / rest) - rank/2 log(dof) (Schwarz 1978), noise of unknown size."""
    rest = np.maximum(total - explained, 1e-12 * total)
    return np.asarray(dof / 2 * np.log(total / rest) - rank / 2 * np.log(max(dof, 1)))


class Screening:
    """All hypotheses about a robot's residuals, and their scores."""

    def __init__(self, scene: Scene, sites: Sequence[Site], drivers: Sequence[Driver]) -> None:
        self._sites, self._drivers, self._basis = sites, drivers, scene.basis
        # Where the device stood elsewhere, too, what moves the platform may be the robot's.
        self._has_stations = any(one.owner == DEVICE for one in drivers)
        # Bases, which sites share, and products of columns, which all residuals share.
        self._known: dict[tuple[Any, ...], Any] = {}
        self._pairs: dict[tuple[Any, ...], list[tuple[DriverSet, DriverSet]]] = {}
        self._n, self._n_joints = len(scene.x), len(scene.model.joints)

    def list_hypotheses(self, driver: Driver) -> list[Hypothesis]:
        """The hypotheses of one driver alone, which may be that of each joint or rod."""
        return [
            Hypothesis(site, (own,))
            for site in self._sites
            for own in self._driver_sets(site)
            if self._is_plausible(site, own)
            and own[0].family == driver.family
            and (own[0].family != LAGGED or own[0].name == driver.name)
        ]

    def give_own_coefficients(self, one: Hypothesis) -> Hypothesis | None:
        """This hypothesis with coefficients of each member's own; None if the members have none."""
        own = [site for site in self._sites if site.each and site.name == one.site.name]
        return replace(one, site=own[0]) if own and not one.site.each else None

    def _splines(self, own: DriverSet, count: int) -> np.ndarray:
        return self._compute_once(count, _name(own), lambda: basis.splines(own, count))

    def _lines(self, own: DriverSet) -> np.ndarray:
        return self._compute_once("lines", _name(own), lambda: basis.lines(own))

    def _polynomials(self, own: DriverSet) -> np.ndarray:
        return self._compute_once("polynomials", _name(own), lambda: basis.polynomials(own))

    def _compute_once(self, kind: int | str, names: Iterable[Any], compute: Callable[[], T]) -> T:
        key = kind, *names
        if key not in self._known:
            self._known[key] = compute()
        known: T = self._known[key]
        return known

    def score(self, targets: Targets, run: Runner = run_on_cores) -> Iterator[Scored]:
        """Score all hypotheses, site by site."""
        with running(run, _score_site, (self, targets), self._sites) as scored:
            for parts in scored:
                yield from parts

    def score_site(self, site: Site, targets: Targets) -> list[Scored]:
        """Score the hypotheses about one site."""
        total = np.sum(targets.residuals**2, axis=0)
        work, scored = _SiteWork(site, self._basis, targets), list[Scored]()
        for number, (hypotheses, columns) in enumerate(self._iterate_bases(site)):
            multiply = partial(work.multiply, columns)
            products = self._compute_once("products", (*site.key, number), multiply)
            explained, rank = work.explain(columns, products)
            own = evidence(explained, total, rank[:, None], targets.dof)
            scored.append(Scored(hypotheses, own))
        return scored

    def _iterate_bases(self, site: Site) -> Iterator[tuple[list[Hypothesis], np.ndarray]]:
        """Iterate over hypotheses with their columns (members, hypotheses, k, N)."""
        sets = self._driver_sets(site)
        alone = [own for own in sets if self._is_plausible(site, own)]
        yield from _chunks(
            ([Hypothesis(site, (own,))], self._splines(own, SPLINES)) for own in alone
        )
        # A weak law in proportion to its driver is clear by one column, and not by so many splines.
        yield from _chunks(
            ([Hypothesis(site, (own,))], self._lines(own)) for own in alone if not own[0].few_values
        )
        if len(site.members) == 1 or not site.each:
            yield from _chunks(
                ([Hypothesis(site, pair)], basis.products(*map(self._polynomials, pair)))
                for pair in self._list_pairs(site, sets)
            )
        if site.kind != JOINT:
            return
        turning = [own for own in sets if own[0].family in (READING, NEXT, PREVIOUS)]
        if self._n >= SAMPLES_PER_NUMBER * FINE_SPLINES:
            own_joint = [
                own
                for own in turning
                if own[0].family == READING
                and all(d.joint == p.joint for d, p in zip(own, site.members, strict=True))
            ]
            yield from _chunks(
                ([Hypothesis(site, (own,))], self._splines(own, FINE_SPLINES)) for own in own_joint
            )
        for own in turning:
            at = basis.frequencies(np.concatenate([one.values for one in own]))
            columns = basis.waves(own, at)
            yield [Hypothesis(site, (own,))] * len(at), columns

    def _list_pairs(
        self, site: Site, sets: Sequence[DriverSet]
    ) -> list[tuple[DriverSet, DriverSet]]:
        """The pairs of drivers that may act together on a site, listed once."""
        if site.key not in self._pairs:
            instant = [own for own in sets if own[0].family != LAGGED]
            self._pairs[site.key] = [
                pair for pair in combinations(instant, 2) if self._is_plausible_pair(site, *pair)
            ]
        return self._pairs[site.key]

    def _driver_sets(self, site: Site) -> list[DriverSet]:
        """Drivers that each member may depend on: those of its own joint, those of all joints for
        a single place, and those of the whole robot."""
        n = len(site.members)
        by_owner = {kind: [one for one in self._drivers if one.owner == kind] for kind in OWNERS}
        common, own, of_rods = by_owner[ROBOT], by_owner[JOINT], by_owner[ROD]
        if site.kind == DEVICE:
            shown = by_owner[DEVICE]
            known = [one for one in common if one.family not in PLACES] if shown else common
            return [(one,) * n for one in (*shown, *known) if one.family in OF_DEVICE]
        if site.kind == BASE:
            by_axis = {one.index: one for one in by_owner[AXIS]}
            moments = [by_axis.get(place.index - 3) for place in site.members]
            of_axes = tuple(one for one in moments if one is not None)
            by_moment = [of_axes] if len(of_axes) == n else []
            return [*by_moment, *((one,) * n for one in common if one.family not in PLACES)]
        if site.kind == PLATFORM:
            moved = [one for one in own if one.family not in (READING, INCLINATION)]
            return [(one,) * n for one in (*moved, *common)]
        if site.kind == ROD:
            by_rod: dict[tuple[str, int | None], Driver] = {
                (one.family, one.index): one for one in of_rods
            }
            of_members = [
                tuple(by_rod[family, place.rod] for place in site.members)
                for family in dict.fromkeys(one.family for one in of_rods)
                if all((family, place.rod) in by_rod for place in site.members)
            ]
            return [*of_members, *((one,) * n for one in common)]
        if n == 1:
            joint = site.members[0].joint
            able = [one for one in own if one.family != INCLINATION or one.joint == joint]
            return [(one,) for one in (*able, *common)]
        by_joint: dict[tuple[str, int], Driver] = {(d.family, d.index): d for d in own}
        families = dict.fromkeys(one.family for one in own)
        joints = [place.joint for place in site.members]
        sets: list[DriverSet] = []
        if None not in joints:
            for family in families:
                members = [by_joint.get((family, int(joint or 0))) for joint in joints]
                if all(member is not None for member in members):
                    sets.append(tuple(one for one in members if one is not None))
        all_joints = site.kind == JOINT and n == self._n_joints > 1
        readings = [
            by_joint[READING, int(joint or 0)]
            for joint in joints
            if (READING, int(joint or 0)) in by_joint  # the reading of a joint at rest is no driver
        ]
        if all_joints and len(readings) == n:
            for family, step in ((NEXT, 1), (PREVIOUS, -1)):
                turned = [readings[(k + step) % n] for k in range(n)]
                sets.append(tuple(replace(one, family=family) for one in turned))
        return [*sets, *((one,) * n for one in common)]

    def _is_plausible(self, site: Site, own: DriverSet) -> bool:
        """Whether a site may err with one driver: from one station, what moves the platform as a
        device does cannot be told from an error of the device."""
        moves = site.kind in (PLATFORM, BASE)
        return not moves or self._has_stations or own[0].kind not in OF_DEVICE

    def _is_plausible_pair(self, site: Site, one: DriverSet, other: DriverSet) -> bool:
        """Whether two drivers may act together on a site: for a joint, its own quantities, other
        readings and those of the whole robot; for a single length, its own joint's as well."""
        if site.kind == BASE:
            return False
        # Lengths that err in proportion to the inclination shift the platform along the vertical:
        # multiplied by another quantity, this is an error of the pose.
        if INCLINATION in (one[0].family, other[0].family):
            return False
        if site.kind == DEVICE:
            return all(own[0].family in {*PLACES, "time"} for own in (one, other))
        if site.kind == PLATFORM:  # a field of position alone is the device's
            return any(self._is_plausible(site, own) for own in (one, other))
        if len(site.members) > 1:
            return not {one[0].family, other[0].family} & {NEXT, PREVIOUS}
        if site.kind == ROD or (site.kind == PARAMETER and site.members[0].joint is not None):
            return False  # its group and its joint stand for it
        return all(
            d.joint in (None, site.members[0].joint) or d.family == READING
            for own in (one, other)
            for d in own
        )


def _name(own: DriverSet) -> list[str]:
    return [one.name for one in own]


def _score_site(shared: tuple[Screening, Targets], site: Site) -> list[Scored]:
    screening, targets = shared
    return screening.score_site(site, targets)


def _chunks(
    items: Iterator[tuple[list[Hypothesis], np.ndarray]],
) -> Iterator[tuple[list[Hypothesis], np.ndarray]]:
    """Join hypotheses with columns (members, k, N) of equal shape, as many as memory allows."""
    waiting: list[tuple[list[Hypothesis], np.ndarray]] = []

    def joined() -> tuple[list[Hypothesis], np.ndarray]:
        hypotheses = [one for own, _ in waiting for one in own]
        return hypotheses, np.stack([columns for _, columns in waiting], axis=1)

    for item in items:
        waiting.append(item)
        if len(waiting) * item[1].size > MAX_CHUNK_NUMBERS:
            yield joined()
            waiting = []
    if waiting:
        yield joined()


class _Products(NamedTuple):
    """Of columns of hypotheses: what scales them to length 1 (h, s), their products (h, s, s) with
    this length and without what the geometry can imitate, and `orthonormalise` of these."""

    scale: np.ndarray
    left: np.ndarray
    root: np.ndarray
    rank: np.ndarray


class _SiteWork:
    """Sums over rows that all hypotheses about one site share. The targets' directions are a
    `basis` of what the geometry can imitate, and those of laws that were found."""

    def __init__(self, site: Site, basis: np.ndarray, targets: Targets):
        self._rows, self._each, self._basis = targets.rows, site.each, basis
        self._J = np.array([place.columns for place in site.members])  # (members, N, rows)
        found = targets.directions[:, basis.shape[1] :]
        self._n_found = found.shape[1]
        self._along = self._sum_rows(np.hstack([found, targets.residuals]))

    def _sum_rows(self, vectors: np.ndarray) -> np.ndarray:
        """What an error of each member at each sample has in common with vectors (n, m):
        (members, N, m)."""
        by_sample = vectors.reshape(-1, self._rows, vectors.shape[1])
        return np.einsum("jnr,nrm->jnm", self._J, by_sample, optimize=True)

    @cached_property
    def _along_basis(self) -> np.ndarray:
        return self._sum_rows(self._basis)

    @cached_property
    def _weights(self) -> np.ndarray:
        return np.einsum("inr,jnr->ijn", self._J, self._J, optimize=True)

    def multiply(self, W: np.ndarray) -> _Products:
        """Products of what columns W (members, h, k, N) change in the residuals."""
        members, h, k, _ = W.shape
        gram = np.empty((h, members, k, members, k))
        for i in range(members):
            for j in range(i, members):
                block = W[i] @ (W[j] * self._weights[i, j]).transpose(0, 2, 1)
                gram[:, i, :, j] = block
                gram[:, j, :, i] = block.transpose(0, 2, 1)
        size = members * k
        G = gram.reshape(h, size, size) if self._each else np.asarray(gram.sum(axis=(1, 3)))
        lengths = np.sqrt(np.maximum(np.diagonal(G, axis1=1, axis2=2), 0.0))
        scale = np.where(lengths > 1e-12, 1 / np.maximum(lengths, 1e-12), 0.0)
        along = self._project(W, self._along_basis)
        left = (G - along @ along.transpose(0, 2, 1)) * scale[:, :, None] * scale[:, None, :]
        return _Products(scale, left, *_orthonormalise(left))

    def _project(self, W: np.ndarray, along: np.ndarray) -> np.ndarray:
        """Products (h, s, m) of columns W (members, h, k, N) with vectors `along` the members
        (members, N, m)."""
        members, h, k, n = W.shape
        onto = (W.reshape(members, h * k, n) @ along).reshape(members, h, k, -1)
        if self._each:
            return onto.transpose(1, 0, 2, 3).reshape(h, members * k, -1)
        return np.asarray(onto.sum(axis=0))

    def explain(self, W: np.ndarray, products: _Products) -> tuple[np.ndarray, np.ndarray]:
        """Explained sums of squares (h, m) and ranks (h,) of columns W (members, h, k, N) with
        their products."""
        B = self._project(W, self._along) * products.scale[:, :, None]
        along, onto = B[:, :, : self._n_found], B[:, :, self._n_found :]
        root, rank = products.root, products.rank
        if self._n_found:
            root, rank = _orthonormalise(products.left - along @ along.transpose(0, 2, 1))
        return np.sum((root.transpose(0, 2, 1) @ onto) ** 2, axis=1), rank


def _orthonormalise(products: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """T (h, s, s) of the orthonormal columns B T that span columns B with these products (h, s, s),
    zero for what is left of them by rounding, and their number (h,)."""
    squares, directions = np.linalg.eigh(products)
    visible = squares > MIN_COLUMN_REMAINDER**2
    inverse = np.where(visible, np.maximum(squares, 1e-300) ** -0.5, 0.0)
    return directions * inverse[:, None, :], visible.sum(axis=1)
