"""Search for laws: the best one, further ones in what it leaves, and what chance explains."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from parallel_cal.base.confidence import EQUAL_EVIDENCE, SIGNIFICANCE_LEVEL
from parallel_cal.base.parallel import Runner, run_on_cores, running
from parallel_cal.base.progress import Progress
from parallel_cal.diagnosis.stations import DeviceField
from parallel_cal.diagnosis.thresholds import MIN_RIVAL_SHARE
from parallel_cal.discovery.drivers import (
    LAGGED,
    Driver,
)
from parallel_cal.discovery.formula import Formula
from parallel_cal.discovery.nulls import characterise_noise, compute_threshold, draw_residuals
from parallel_cal.discovery.parts import Part, Parts, find_parts
from parallel_cal.discovery.places import DEVICE
from parallel_cal.discovery.screening import Hypothesis, Screening, Targets
from parallel_cal.discovery.selection import find_formula
from parallel_cal.discovery.thresholds import (
    LAGS_PER_OCTAVE,
    MAX_FORMULA_LAG,
    MAX_FORMULAS,
    MAX_LAWS,
    MAX_SIMPLER_EVIDENCE,
    MAX_TERMS,
    NULL_SESSIONS,
)
from parallel_cal.posterior.scene import Scene


@dataclass(frozen=True)
class Winner:
    """A law before its proof: the formula, equally good ones, and the screening's evidence.

    For a law of the device, `rival` is one of the robot that explains nearly as much; for a law of
    the robot, one of the device that explains more. `parts` are further laws of the same driver,
    and `alone` is the law of one driver that they replaced. `excludes_device` is whether samples of
    several stations show that no smooth error of the device is such a law.
    """

    formula: Formula
    equal: tuple[Formula, ...]
    evidence: float
    rival: Hypothesis | None = None
    parts: tuple[Part, ...] = ()
    alone: Winner | None = None
    excludes_device: bool = False

    @property
    def columns(self) -> np.ndarray:
        """The columns (n, k) of the law and of its parts."""
        return np.hstack([self.formula.columns, *(one.formula.columns for one in self.parts)])

    @property
    def signal(self) -> np.ndarray:
        """What the law and its parts change in the residuals (n,)."""
        formulas = [self.formula, *(one.formula for one in self.parts)]
        return np.asarray(sum(one.columns @ one.coefficients.ravel() for one in formulas))

    def list_laws(self, threshold: float) -> list[tuple[Winner, float]]:
        """The law and its parts, each with the evidence that it must exceed: chance is excluded by
        the law, so that a part is judged as a further term of a formula is."""
        parts = [
            Winner(
                one.formula,
                one.equal,
                one.formula.evidence,
                excludes_device=self.excludes_device,
            )
            for one in self.parts
        ]
        return [(self, threshold), *((one, EQUAL_EVIDENCE) for one in parts)]


@dataclass(frozen=True)
class Search:
    """What a search for laws works with: `device` are errors of a device that stood at several
    stations."""

    scene: Scene
    screening: Screening
    drivers: Sequence[Driver]
    device: DeviceField | None
    run: Runner
    report: Progress


@dataclass(frozen=True)
class Formulas:
    """The formulas of hypotheses about the first residual of the targets, each searched once."""

    targets: Targets
    run: Runner = run_on_cores
    _known: dict[tuple[Any, ...], Formula | None] = field(default_factory=dict, repr=False)

    def find(self, hypotheses: Iterable[Hypothesis]) -> list[Formula]:
        """The formula of each of different hypotheses; none for one that no term describes."""
        wanted = {one.exact_key: one for one in hypotheses}
        new = [one for key, one in wanted.items() if key not in self._known]
        with running(self.run, find_formula, self.targets, new) as found:
            for one, formula in zip(new, found, strict=True):
                self._known[one.exact_key] = formula
        return [formula for key in wanted if (formula := self._known[key]) is not None]


@dataclass(frozen=True)
class _Best:
    """The best law in what earlier ones leave, and the hypotheses with their evidence."""

    winner: Winner
    formulas: Formulas
    scored: Sequence[tuple[float, Hypothesis]]


def find_winners(search: Search) -> list[Winner]:
    """The best law, and further ones in what it leaves, before any test of chance."""
    columns = np.zeros((len(search.scene.residual), 0))
    winners: list[Winner] = []
    best = _find_best(search, columns)
    while best is not None:
        winner, left = best.winner, MAX_LAWS - _count_laws(winners)
        parts = _find_parts(search, best, left)
        best = None
        if parts is not None and len(winner.formula.hypothesis.drivers) == 1 < left:
            # Places of this driver may only imitate what depends on another quantity.
            best = _find_best(search, np.hstack([columns, winner.columns]))
            gained = parts.evidence - winner.formula.evidence
            if best is not None and best.winner.formula.evidence > gained:
                parts = None
        if parts is not None:  # what the device may cause stays an objection
            of_device = [one for one in winner.equal if one.hypothesis.site.kind == DEVICE]
            first, *others = parts.laws
            equal = (*of_device, *first.equal)
            # A law with a second quantity, on which no part depends, names the wrong driver.
            alone = winner if len(winner.formula.hypothesis.drivers) == 1 else None
            winner = replace(
                winner, formula=first.formula, equal=equal, parts=tuple(others), alone=alone
            )
            best = None
        if search.device is not None and not winner.formula.hypothesis.slow:
            # No device can cause the law if samples of several stations show it.
            targets = Targets.of(search.scene, search.scene.residual[:, None], columns)
            excluded = search.device.excludes(winner.signal, targets.directions)
            alone = winner.alone and replace(winner.alone, excludes_device=excluded)
            winner = replace(winner, excludes_device=excluded, alone=alone)
        winners.append(winner)
        columns = np.hstack([columns, winner.columns])
        if _count_laws(winners) >= MAX_LAWS:
            break
        best = best or _find_best(search, columns)
    return winners


def _count_laws(winners: Sequence[Winner]) -> int:
    return sum(1 + len(one.parts) for one in winners)


def _find_best(search: Search, columns: np.ndarray) -> _Best | None:
    """The best law beside laws with the columns (n, k); None if chance explains it."""
    search.report("screening places and drivers", 0.1)
    targets = Targets.of(search.scene, search.scene.residual[:, None], columns)
    scored = [
        (float(e), one)
        for part in search.screening.score(targets, search.run)
        for e, one in zip(part.evidence[:, 0], part.hypotheses, strict=True)
    ]
    scored.sort(key=lambda item: -item[0])
    # By chance, the best of so many hypotheses is about as much likelier as their number.
    if not scored or scored[0][0] < np.log(len(scored)):
        return None
    search.report("searching formulas", 0.3)
    formulas = Formulas(targets, search.run)
    winner = find_winner(formulas, scored)
    if winner is None:
        return None
    formula = _refine_lag(formulas, winner.formula, search)
    formula = refine_members(formulas, formula, search.screening)
    equal = tuple(one for one in winner.equal if one.hypothesis.key != formula.hypothesis.key)
    return _Best(replace(winner, formula=formula, equal=equal), formulas, scored)


def find_winner(formulas: Formulas, scored: Sequence[tuple[float, Hypothesis]]) -> Winner | None:
    """Find formulas for the best hypotheses; of those equally good, take the simplest."""
    found: dict[tuple[Any, ...], Formula] = {}
    for formula in formulas.find(_select_for_formulas(scored)):
        reduced = _reduce(formula)
        key = reduced.hypothesis.key
        if key not in found or found[key].evidence < reduced.evidence:
            found[key] = reduced
    if not found:
        return None
    best, *equal = sort_by_preference(list(found.values()))
    rival = find_rival(best.hypothesis, scored)
    return Winner(best, tuple(equal), max(scored[0][0], best.evidence), rival)


def find_rival(
    hypothesis: Hypothesis, scored: Sequence[tuple[float, Hypothesis]]
) -> Hypothesis | None:
    """For a law of the device, the best one of the robot that explains nearly as much; for a law of
    the robot, the best one of the device with the same drivers that explains more. None if there is
    none.

    Formulas are not compared here: of a drift that no formula describes well, that of the robot may
    happen to be the better one.
    """
    if hypothesis.site.kind == DEVICE:
        limit = MIN_RIVAL_SHARE * scored[0][0]
        return next((one for e, one in scored if e >= limit and one.site.kind != DEVICE), None)
    drivers = {*hypothesis.families}
    for _, one in scored:
        if one.key == hypothesis.key:
            return None
        if one.site.kind == DEVICE and {*one.families} == drivers:
            return one
    return None


def sort_by_preference(formulas: Sequence[Formula]) -> list[Formula]:
    """The formulas that are about equally good, the preferred one first.

    Fewer quantities count more than the evidence. The number of coefficients hardly does: the
    evidence already counts them, and what a simpler law of the same quantities leaves out is an
    error of the robot.
    """
    best = max(one.evidence for one in formulas)
    equal = [one for one in formulas if one.evidence >= best - EQUAL_EVIDENCE]
    equal.sort(key=lambda one: one.preference)
    alike = [one for one in equal if one.quantities == equal[0].quantities]
    limit = max(one.evidence for one in alike) - MAX_SIMPLER_EVIDENCE
    first = next(one for one in alike if one.evidence >= limit)
    return [first, *(one for one in equal if one is not first)]


def _find_parts(search: Search, best: _Best, limit: int) -> Parts | None:
    """Several laws of one driver, in different places, that describe the data better than a law of
    the robot with one driver, or as well as one with two; None if there are none.

    Where several parts err with the temperature, one of them alone describes less than a law with
    a second quantity that no part depends on.
    """
    formula, targets = best.winner.formula, best.formulas.targets
    list_hypotheses = search.screening.list_hypotheses
    drivers = formula.hypothesis.drivers
    if formula.hypothesis.site.kind == DEVICE:
        return None
    evidence, found = formula.evidence - EQUAL_EVIDENCE, None
    if len(drivers) == 1:
        found = find_parts(targets, formula, list_hypotheses(drivers[0][0]), limit)
        evidence = (found or formula).evidence + EQUAL_EVIDENCE
    for own in drivers:
        begin = [
            one
            for _, one in best.scored
            if len(one.drivers) == 1 and one.uses(own[0]) and one.site.kind != DEVICE
        ]
        for start in best.formulas.find(begin[:MAX_TERMS]):
            if start is formula:  # the parts that it begins with were found above
                continue
            parts = find_parts(targets, start, list_hypotheses(own[0]), limit)
            if parts is not None and parts.evidence > evidence:
                evidence, found = parts.evidence, parts
    return found


def _refine_lag(formulas: Formulas, formula: Formula, search: Search) -> Formula:
    """The formula with the time constant that describes the data best."""
    own = formula.hypothesis.drivers[0]
    if own[0].family != LAGGED:
        return formula
    lags = [one for one in search.drivers if one.family == LAGGED]
    at = [one.name for one in lags].index(own[0].name)
    near = lags[max(at - LAGS_PER_OCTAVE + 1, 0) : at + LAGS_PER_OCTAVE]
    hypotheses = [
        replace(formula.hypothesis, drivers=((one,) * len(own),))
        for one in near
        if one is not own[0]
    ]
    return max([formula, *formulas.find(hypotheses)], key=lambda one: one.evidence)


def refine_members(formulas: Formulas, formula: Formula, screening: Screening) -> Formula:
    """The formula with coefficients of each member's own, if the members differ significantly.

    Of equally good laws, that with one coefficient for all members is simpler, and says the place
    and the drivers. But by what the members differ, the robot would still err.
    """
    from scipy.special import chdtrc

    hypothesis = screening.give_own_coefficients(formula.hypothesis)
    found = formulas.find([hypothesis]) if hypothesis else []
    if not found or found[0].used_drivers != formula.used_drivers:
        return formula
    [own] = found
    added = own.numbers - formula.numbers
    gained = own.evidence - formula.evidence
    if added <= 0 or formula.hypothesis.slow:  # noise that changes slowly is no chi2
        return own if gained > 0 else formula
    # The evidence without what it subtracts for each coefficient: twice of it is chi2 by chance.
    fall = 2 * gained + added * np.log(formulas.targets.dof)
    return own if chdtrc(added, max(fall, 0.0)) < SIGNIFICANCE_LEVEL else formula


def _select_for_formulas(scored: Sequence[tuple[float, Hypothesis]]) -> list[Hypothesis]:
    """The best hypotheses, but none of two drivers that gains little over one of them, and waves of
    one place and driver only once."""
    best, chosen = scored[0][0], list[Hypothesis]()
    seen: set[tuple[Any, ...]] = set()
    single: dict[tuple[Any, ...], float] = {}
    for e, one in scored:
        if len(one.drivers) == 1:
            key = one.exact_key
            single[key] = max(single.get(key, -np.inf), e)
    for e, one in scored:
        if e < best - MAX_FORMULA_LAG or len(chosen) >= MAX_FORMULAS:
            break
        if one.key in seen:
            continue
        alone = max(single.get((*one.site.key, (own,)), -np.inf) for own in one.families)
        if len(one.drivers) == 2 and e < alone + EQUAL_EVIDENCE:
            continue
        seen.add(one.key)
        chosen.append(one)
    return chosen


def _reduce(formula: Formula) -> Formula:
    """The formula of a hypothesis without the drivers that it does not use."""
    used = formula.used_drivers
    if len(used) == len(formula.hypothesis.drivers):
        return formula
    terms = tuple(
        replace(term, factors=tuple((used.index(n), factor) for n, factor in term.factors))
        for term in formula.terms
    )
    drivers = tuple(formula.hypothesis.drivers[n] for n in used)
    return replace(formula, terms=terms, hypothesis=replace(formula.hypothesis, drivers=drivers))


def find_thresholds(search: Search, winners: Sequence[Winner]) -> list[float]:
    """For each winner, the evidence that the best hypothesis of a session without any law rarely
    exceeds; drivers that change slowly are compared among themselves.

    The noise is what the winners leave, except those that change slowly: these could describe
    correlated noise, and must exceed what such noise imitates. Once one does, it is no noise for
    the others.
    """
    removed = [one for one in winners if not one.formula.hypothesis.slow]
    thresholds: dict[int, float] = {}
    while len(thresholds) < len(winners):
        limit = _compute_limits(search, removed)
        found = {k: limit[one.formula.hypothesis.slow] for k, one in enumerate(winners)}
        real = {k: t for k, t in found.items() if k not in thresholds and winners[k].evidence > t}
        thresholds |= real
        slow = [winners[k] for k in real if winners[k].formula.hypothesis.slow]
        if not slow:
            thresholds = {**found, **thresholds}
        removed += slow
    return [thresholds[k] for k in range(len(winners))]


def _compute_limits(search: Search, removed: Sequence[Winner]) -> dict[bool, float]:
    """The evidence that the best hypothesis of a session without any law rarely exceeds, of drivers
    that change slowly (True) and of the others, with the noise that `removed` laws leave."""
    scene = search.scene
    nothing = np.zeros((len(scene.residual), 0))
    columns = np.hstack([nothing, *(one.columns for one in removed)])
    rest = Targets.of(scene, scene.residual[:, None], columns).residuals[:, 0]
    noise = characterise_noise(scene, rest)
    targets = Targets.of(scene, draw_residuals(scene, noise, NULL_SESSIONS), nothing)
    maxima = {True: np.full(NULL_SESSIONS, -np.inf), False: np.full(NULL_SESSIONS, -np.inf)}
    for done, part in enumerate(search.screening.score(targets, search.run)):
        is_slow = np.array([one.slow for one in part.hypotheses])
        for kind in (True, False):
            if np.any(is_slow == kind):
                own = part.evidence[is_slow == kind].max(axis=0)
                maxima[kind] = np.maximum(maxima[kind], own)
        search.report("searching sessions without a law", 0.4 + 0.4 * (1 - 0.99**done))
    return {kind: compute_threshold(own) for kind, own in maxima.items() if np.isfinite(own).all()}
