"""Discover the law of an error that no effect of the catalogue describes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from parallel_cal.base.arguments import check_arguments
from parallel_cal.base.documents import to_json_value
from parallel_cal.base.errors import FitError
from parallel_cal.base.notebook import ShownInNotebook
from parallel_cal.base.options import with_changes
from parallel_cal.base.parallel import Runner, run_on_cores, running
from parallel_cal.base.progress import Progress, ignore_progress, never_falling
from parallel_cal.base.threads import single_threaded
from parallel_cal.diagnosis.diagnose import find_mistrusted_samples
from parallel_cal.diagnosis.field import Field
from parallel_cal.diagnosis.noise import NoiseLevel
from parallel_cal.diagnosis.scene import Scene
from parallel_cal.diagnosis.stations import DeviceField, find_stations
from parallel_cal.diagnosis.thresholds import MAX_HELD_COORDINATE_SIGMAS
from parallel_cal.diagnosis.verdict import share_explained
from parallel_cal.discovery.drivers import (
    LAGGED,
    PLACES,
    WORDS,
    Driver,
    list_drivers,
    list_shown_positions,
    name_lags,
    select_for_screening,
)
from parallel_cal.discovery.effect_file import (
    Coefficient,
    list_coefficients,
    load_text,
    write_effect,
    write_effect_file,
    write_formula,
)
from parallel_cal.discovery.folds import Choice, choose_in_folds
from parallel_cal.discovery.formula import Formula, find_formula
from parallel_cal.discovery.nulls import characterise_noise, compute_threshold, draw_residuals
from parallel_cal.discovery.parts import Part, Parts, find_parts
from parallel_cal.discovery.places import (
    BASE,
    DEVICE,
    JOINT,
    PARAMETER,
    PLATFORM,
    ROD,
    list_places,
    list_sites,
)
from parallel_cal.discovery.screening import Hypothesis, Screening, Targets
from parallel_cal.discovery.shape import Shape, find_shape
from parallel_cal.discovery.thresholds import (
    LAGS_PER_OCTAVE,
    MAX_EQUAL_EVIDENCE,
    MAX_EQUAL_MEMBERS_P,
    MAX_FORMULA_LAG,
    MAX_FORMULAS,
    MAX_LAWS,
    MAX_SCREENED_SAMPLES,
    MAX_SIMPLER_EVIDENCE,
    MAX_SPLITS,
    MIN_RIVAL_EVIDENCE_SHARE,
    MIN_TERM_EVIDENCE,
    NULL_SESSIONS,
)
from parallel_cal.identification.acceptance import format_errors
from parallel_cal.identification.checks import ImplausibleGeometryError
from parallel_cal.identification.fit import FitResult, fit
from parallel_cal.identification.options import FitKeywords, FitOptions
from parallel_cal.identification.prediction_errors import Summary
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.lagged import add_lagged_conditions
from parallel_cal.session.steps import Step, add

if TYPE_CHECKING:
    from typing_extensions import Unpack


# Families of drivers whose values a person cannot choose for a pose at rest.
NOT_CHOSEN = ("time", "session", "velocity", "acceleration", "settling")
A_STATION = (
    "a second station: measure the same poses with the device moved and turned, about an axis that "
    "the error does not surround, and give all recordings; an error of the device goes with it"
)
MAX_SHOWN_PARAMETERS = 6  # of a law in its sentence; the table has all


@dataclass(frozen=True)
class Law:
    """A law that was found: where an error enters, on what it depends, and its formula.

    Attributes
    ----------
    place : str
        The quantity that errs: a joint, a parameter (`chain1.La_y`), `pose.z` or `device.z`, or
        several of them, such as `joints`.
    drivers : tuple of str
        The quantities that the error depends on, such as `load.joint2`.
    formula : str
        The error as a sum of terms, with the names of `parameters`.
    unit : str
        Unit of the error.
    parameters : tuple of Coefficient
        The coefficients, identified together with the geometry, and the constants of terms.
    share : float or None
        Share of the error above the noise floor that the law accounts for.
    before, after, noise_floor : Summary
        Validation errors without and with the law; the noise floor.
    tested : dict of (float, float)
        The range of each driver in the samples.
    alternatives : tuple of str
        Laws that describe the data equally well, each as `PLACE by DRIVER`.
    choice : Choice
        The residuals at held-out poses if its form and its constants are chosen without them.
    evidence, threshold : float
        Log evidence of place and drivers without a formula, and the value that the best of all
        hypotheses exceeds in one of a hundred sessions without a law.
    against : str
        Why the law is not proven; empty if it is.
    device_may_err : bool
        Whether the reason is that robot and measuring device may both cause the error.
    of_device : bool
        Whether the measuring device errs.
    text : str
        The effect file.
    rivals : dict of str
        The effect file of each of `alternatives`, by its name.
    """

    place: str
    drivers: tuple[str, ...]
    formula: str
    unit: str
    parameters: tuple[Coefficient, ...]
    share: float | None
    before: Summary
    after: Summary
    noise_floor: Summary
    tested: Mapping[str, tuple[float, float]]
    alternatives: tuple[str, ...]
    choice: Choice
    evidence: float
    threshold: float
    against: str
    device_may_err: bool
    of_device: bool
    sentence: str
    text: str = field(repr=False)
    shape: Shape | None = field(repr=False, default=None)
    rivals: Mapping[str, str] = field(repr=False, default_factory=dict)

    @property
    def name(self) -> str:
        """`PLACE by DRIVER and DRIVER`."""
        return f"{self.place} by {' and '.join(self.drivers)}"

    def document(self) -> dict[str, Any]:
        """The law as JSON data; SI, None for unknown values."""
        return {
            "place": self.place,
            "drivers": list(self.drivers),
            "formula": self.formula,
            "unit": self.unit,
            "parameters": {
                c.name: {"value": c.value, "sigma": c.sigma, "unit": c.unit}
                for c in self.parameters
            },
            "share": to_json_value(self.share),
            "validation": {
                "before": self.before.document(),
                "after": self.after.document(),
                "noise_floor": self.noise_floor.document(),
                "residuals_ratio": to_json_value(self.choice.ratio),
                "residuals_ratio_chosen_anew": to_json_value(self.choice.ratio_anew),
            },
            "tested": {name: list(span) for name, span in self.tested.items()},
            "or": list(self.alternatives),
            "of_device": self.of_device,
            "against": self.against,
            "evidence": to_json_value(self.evidence),
            "threshold": to_json_value(self.threshold),
        }


@dataclass(frozen=True)
class Discovery(ShownInNotebook):
    """The result of `discover`.

    Attributes
    ----------
    model : Model
    dataset : Dataset
    laws : tuple of Law
        The proven laws, best first.
    suspected : tuple of Law
        Laws beyond chance that the same judgement as that of `add` refuses; `against` says why.
    verdict : str
        `described` (laws were found and proven at held-out poses), `robot_or_device` (the
        measuring device may cause the error), `suspected` or `nothing`.
    summary : str
    measure_next : tuple of str
        What to measure to decide between laws that describe the data equally well.
    described : Model
        The fitted model with the proven laws, for use in this process. To write a model file, write
        the effect first and add it with `add`.
    needs_larger_model : bool
        Whether the measured pose varies in coordinates that the model holds at one value.
    """

    model: Model
    dataset: Dataset
    laws: tuple[Law, ...]
    suspected: tuple[Law, ...]
    verdict: str
    summary: str
    measure_next: tuple[str, ...]
    described: Model
    needs_larger_model: bool = False

    def __repr__(self) -> str:
        found = "; ".join(law.name for law in self.laws) or "no law"
        return (
            f"Discovery({self.model.mechanism.name}, {len(self.dataset)} samples, "
            f"{self.verdict}: {found})"
        )

    def write(self, path: str | Path) -> list[Path]:
        """Write the proven laws as effect files: the first to `path`, further ones to
        `path` with `_2` and `_3` behind the name. ModelError for a name that cannot be imported."""
        path = Path(path)
        paths = [
            path.with_stem(f"{path.stem}_{k}") if k > 1 else path
            for k in range(1, len(self.laws) + 1)
        ]
        for law, own in zip(self.laws, paths, strict=True):
            write_effect_file(own, law.text)
        return paths

    def document(self, files: Sequence[str | Path] = ()) -> dict[str, Any]:
        """The JSON document of `parallel-cal discover`; SI, None for unknown values."""
        return {
            "verdict": self.verdict,
            "summary": self.summary,
            "laws": [law.document() for law in self.laws],
            "suspected": [law.document() for law in self.suspected],
            "measure_next": list(self.measure_next),
            "needs_larger_model": self.needs_larger_model,
            "file": str(files[0]) if files else None,
            "files": [str(file) for file in files],
            "samples": len(self.dataset),
            "dataset": {"source": self.dataset.source, "sha256": self.dataset.sha256},
        }


@dataclass(frozen=True)
class _Winner:
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
    alone: _Winner | None = None
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

    def list_laws(self, threshold: float) -> list[tuple[_Winner, float]]:
        """The law and its parts, each with the evidence that it must exceed: chance is excluded by
        the law, so that a part is judged as a further term of a formula is."""
        parts = [
            _Winner(
                one.formula,
                one.equal,
                one.formula.evidence,
                excludes_device=self.excludes_device,
            )
            for one in self.parts
        ]
        return [(self, threshold), *((one, MIN_TERM_EVIDENCE) for one in parts)]


@check_arguments(FitError)
@single_threaded()
def discover(
    model: Model,
    dataset: Dataset,
    *,
    options: FitOptions | None = None,
    progress: Progress | None = None,
    run: Runner = run_on_cores,
    **changes: Unpack[FitKeywords],
) -> Discovery:
    """Find the law of an error that no effect of the catalogue describes.

    The free parameters are identified first. Then each place where an error can enter (each joint,
    each parameter of the mechanism, the platform's pose, the device) is tested with each quantity
    that the error may depend on. No formula is assumed, and the part of the error that geometric
    parameters could imitate is removed first. The best combinations get a formula. A law must
    explain more than the same search finds in simulated sessions with the same noise and no law. It
    must also pass the checks of `add`.

    Parameters
    ----------
    model : Model
    dataset : Dataset
    options : FitOptions, optional
        Options of the identification as one object.
    progress : callable, optional
        Called with a stage in words and the completed share (0 to 1), which never falls. An
        exception that it raises cancels the search.
    run : callable, optional
        Runs the parts of the search: on all cores of this machine by default, on a Dask cluster
        with `fleet.cluster.run_on_cluster`. The result does not depend on it.
    **changes
        Single options by name, as in `fit`.

    Returns
    -------
    Discovery
        `verdict` is `described`, `robot_or_device`, `suspected` or `nothing`; `laws` are the proven
        laws; `write(path)` writes them as effects that `add` takes.

    Raises
    ------
    FitError
        If the free parameters cannot be identified.

    Examples
    --------
    >>> import parallel_cal as pc
    >>> model = pc.read_model("config/delta_mockup_nominal.yaml")
    >>> data = pc.load_dataset("bags/delta_backlash", joints=model.joints)
    >>> pc.discover(model, data).laws[0].drivers
    ('direction',)
    """
    report = never_falling(progress or ignore_progress)
    options = with_changes(options, FitOptions, changes, FitError)
    report("identifying the geometry", 0.0)
    dataset = add_lagged_conditions(name_lags(dataset), dataset)
    base = fit(model, dataset, options)
    if options.loss != "linear":
        dataset = dataset.excluding(find_mistrusted_samples(base), f"by --loss {options.loss}")
        options = replace(options, loss="linear")
        base = fit(model, dataset, options)
    scene, given = _make_scene(base, dataset)
    drivers = list_drivers(scene)
    stations = find_stations(scene, given)
    places = list_places(scene, stations)
    device, shown = None, list[Driver]()
    if stations is not None:
        seen = stations.show(scene.seen[:, len(model.joints) :][:, :3])
        device = DeviceField(scene, stations)
        shown = list_shown_positions(seen)
        drivers = [one for one in drivers if one.family != "session"]  # stations change with it
    screening = Screening(scene, list_sites(places), [*select_for_screening(drivers), *shown])
    search = _Search(scene, screening, drivers, device, run, report)
    winners = _find_winners(search)
    thresholds = _find_thresholds(search, winners)
    real = [
        (one, threshold)
        for one, threshold in zip(winners, thresholds, strict=True)
        if one.evidence > threshold
    ]
    nothing = np.zeros((len(scene.residual), 0))
    proofs = [_Proof(base.model, base.estimate.chi2_per_dof, nothing, [], [])]
    for k, (winner, threshold) in enumerate(real):
        report("testing a law at held-out poses", 0.8 + 0.2 * k / len(real))
        prove = partial(_prove_all, proofs[-1], dataset=dataset, options=options, scene=scene)
        proof = prove(winner.list_laws(threshold), run=run)
        if winner.alone is not None and any(law.against for law in proof.laws):
            # Without a part that was refused, the law that the parts replaced may be the better.
            alone = prove([(winner.alone, threshold)], run=run)
            proof = min(proof, alone, key=lambda one: one.chi2_per_dof)
        proofs.append(proof)
    found = [law for one in proofs for law in one.laws]
    advice = [_advise(scene, winner, drivers) for one in proofs for winner in one.winners]
    held, current = Field.of(scene).held, proofs[-1].model
    return _conclude(model, dataset, found, [words for words in advice if words], current, held)


@dataclass(frozen=True)
class _Proof:
    """Laws that were judged one after the other: the model with those that were accepted, its
    chi2/dof, and their columns (n, k) beside those of earlier laws."""

    model: Model
    chi2_per_dof: float
    columns: np.ndarray
    laws: list[Law]
    winners: list[_Winner]


def _prove_all(
    before: _Proof,
    winners: Sequence[tuple[_Winner, float]],
    dataset: Dataset,
    options: FitOptions,
    scene: Scene,
    run: Runner,
) -> _Proof:
    """Judge laws, each with its limit, beside those that were accepted before."""
    model, chi2, columns, laws = before.model, before.chi2_per_dof, before.columns, list[Law]()
    for winner, threshold in winners:
        targets = Targets.of(scene, scene.residual[:, None], columns)
        choice = choose_in_folds(targets, winner.formula, run)
        law, step = _prove(winner, threshold, choice, model, dataset, options, scene)
        laws.append(law)
        if not law.against:
            model, chi2 = step.model, step.result.estimate.chi2_per_dof
            columns = np.hstack([columns, winner.formula.columns])
    return _Proof(model, chi2, columns, laws, [winner for winner, _ in winners])


def _make_scene(base: FitResult, given: Dataset) -> tuple[Scene, Dataset]:
    """The residuals to screen, of all samples or of evenly chosen ones of very many, and these
    samples as they were given: before a fit moved them into one frame of the device."""
    n = len(base.dataset)
    some = np.unique(np.linspace(0, n - 1, min(n, MAX_SCREENED_SAMPLES)).astype(int))
    scene = Scene.of(
        base.model, base.dataset.select(some), base.observations.select(some), base.free
    )
    return scene, given.select(some)


@dataclass(frozen=True)
class _Search:
    """What a search for laws works with: `device` are errors of a device that stood at several
    stations."""

    scene: Scene
    screening: Screening
    drivers: Sequence[Driver]
    device: DeviceField | None
    run: Runner
    report: Progress


@dataclass(frozen=True)
class _Best:
    """The best law in what earlier ones leave, and the hypotheses with their evidence."""

    winner: _Winner
    targets: Targets
    scored: Sequence[tuple[float, Hypothesis]]


def _find_winners(search: _Search) -> list[_Winner]:
    """The best law, and further ones in what it leaves, before any test of chance."""
    columns = np.zeros((len(search.scene.residual), 0))
    winners: list[_Winner] = []
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


def _count_laws(winners: Sequence[_Winner]) -> int:
    return sum(1 + len(one.parts) for one in winners)


def _find_best(search: _Search, columns: np.ndarray) -> _Best | None:
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
    winner = find_winner(targets, scored, search.run)
    if winner is None:
        return None
    formula = _refine_lag(targets, winner.formula, search)
    formula = refine_members(targets, formula, search.screening)
    equal = tuple(one for one in winner.equal if one.hypothesis.key != formula.hypothesis.key)
    return _Best(replace(winner, formula=formula, equal=equal), targets, scored)


def find_winner(
    targets: Targets,
    scored: Sequence[tuple[float, Hypothesis]],
    run: Runner = run_on_cores,
) -> _Winner | None:
    """Find formulas for the best hypotheses; of those equally good, take the simplest."""
    found: dict[tuple[Any, ...], Formula] = {}
    with running(run, find_formula, targets, _select_for_formulas(scored)) as formulas:
        for formula in filter(None, formulas):
            reduced = _reduce(formula)
            key = reduced.hypothesis.key
            if key not in found or found[key].evidence < reduced.evidence:
                found[key] = reduced
    if not found:
        return None
    best, *equal = sort_by_preference(list(found.values()))
    rival = find_rival(best.hypothesis, scored)
    return _Winner(best, tuple(equal), max(scored[0][0], best.evidence), rival)


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
        limit = MIN_RIVAL_EVIDENCE_SHARE * scored[0][0]
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
    equal = [one for one in formulas if one.evidence >= best - MAX_EQUAL_EVIDENCE]
    equal.sort(key=lambda one: one.preference)
    alike = [one for one in equal if one.quantities == equal[0].quantities]
    limit = max(one.evidence for one in alike) - MAX_SIMPLER_EVIDENCE
    first = next(one for one in alike if one.evidence >= limit)
    return [first, *(one for one in equal if one is not first)]


def _find_parts(search: _Search, best: _Best, limit: int) -> Parts | None:
    """Several laws of one driver, in different places, that describe the data better than a law of
    the robot with one driver, or as well as one with two; None if there are none.

    Where several parts err with the temperature, one of them alone describes less than a law with
    a second quantity that no part depends on.
    """
    formula, targets, list_hypotheses = (
        best.winner.formula,
        best.targets,
        search.screening.list_hypotheses,
    )
    drivers = formula.hypothesis.drivers
    if formula.hypothesis.site.kind == DEVICE:
        return None
    evidence, found = formula.evidence - MAX_EQUAL_EVIDENCE, None
    if len(drivers) == 1:
        found = find_parts(targets, formula, list_hypotheses(drivers[0][0]), limit)
        evidence = (found or formula).evidence + MAX_EQUAL_EVIDENCE
    for own in drivers:
        begin = [
            one
            for _, one in best.scored
            if len(one.drivers) == 1 and one.uses(own[0]) and one.site.kind != DEVICE
        ]
        for one in begin[:MAX_SPLITS]:
            start = find_formula(targets, one)
            if start is None:
                continue
            parts = find_parts(targets, start, list_hypotheses(own[0]), limit)
            if parts is not None and parts.evidence > evidence:
                evidence, found = parts.evidence, parts
    return found


def _refine_lag(targets: Targets, formula: Formula, search: _Search) -> Formula:
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
    with running(search.run, find_formula, targets, hypotheses) as found:
        return max([formula, *filter(None, found)], key=lambda one: one.evidence)


def refine_members(targets: Targets, formula: Formula, screening: Screening) -> Formula:
    """The formula with coefficients of each member's own, if the members differ significantly.

    Of equally good laws, that with one coefficient for all members is simpler, and says the place
    and the drivers. But by what the members differ, the robot would still err.
    """
    from scipy.special import chdtrc

    hypothesis = screening.give_own_coefficients(formula.hypothesis)
    own = find_formula(targets, hypothesis) if hypothesis else None
    if own is None or own.used_drivers != formula.used_drivers:
        return formula
    added = own.numbers - formula.numbers
    gained = own.evidence - formula.evidence
    if added <= 0 or formula.hypothesis.slow:  # noise that changes slowly is no chi2
        return own if gained > 0 else formula
    # The evidence without what it subtracts for each coefficient: twice of it is chi2 by chance.
    fall = 2 * gained + added * np.log(targets.dof)
    return own if chdtrc(added, max(fall, 0.0)) < MAX_EQUAL_MEMBERS_P else formula


def _select_for_formulas(scored: Sequence[tuple[float, Hypothesis]]) -> list[Hypothesis]:
    """The best hypotheses, but none of two drivers that gains little over one of them, and waves of
    one place and driver only once."""
    best, chosen = scored[0][0], list[Hypothesis]()
    seen: set[tuple[Any, ...]] = set()
    single: dict[tuple[Any, ...], float] = {}
    for e, one in scored:
        if len(one.drivers) == 1:
            key = (*one.site.key, one.families)
            single[key] = max(single.get(key, -np.inf), e)
    for e, one in scored:
        if e < best - MAX_FORMULA_LAG or len(chosen) >= MAX_FORMULAS:
            break
        if one.key in seen:
            continue
        alone = max(single.get((*one.site.key, (own,)), -np.inf) for own in one.families)
        if len(one.drivers) == 2 and e < alone + MAX_EQUAL_EVIDENCE:
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


def _find_thresholds(search: _Search, winners: Sequence[_Winner]) -> list[float]:
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


def _compute_limits(search: _Search, removed: Sequence[_Winner]) -> dict[bool, float]:
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


def _prove(
    winner: _Winner,
    threshold: float,
    choice: Choice,
    model: Model,
    dataset: Dataset,
    options: FitOptions,
    scene: Scene,
) -> tuple[Law, Step]:
    """Judge a law as `add` judges an effect, and describe it with the refitted numbers."""
    formula = winner.formula
    hypothesis = formula.hypothesis
    sentence, tested = describe_law(hypothesis), _list_ranges(hypothesis)
    where = _describe_data(dataset, tested)
    name = load_text(write_effect(formula, sentence, where))
    # With the samples in which the law was found.
    judge = partial(add, model, name, dataset, force=True, knocked=())
    try:
        step = judge(options=options)
    except ImplausibleGeometryError:  # geometry imitates the law: known sizes decide how much
        step = judge(options=replace(options, prior=True))
    refitted = step.result.parameters()
    coefficients = []
    for c in list_coefficients(formula):
        p = refitted[f"{name}.{c.name}"]
        coefficients.append(replace(c, value=p.value, sigma=None if c.scanned else p.sigma))
    own = {c.name: (c.value, c.sigma) for c in coefficients}
    assert step.rival is not None
    noise = NoiseLevel.of(scene, Field.of(scene), structured=True).variance
    rivals: dict[str, str] = {}
    for one in winner.equal:
        rival = write_effect(one, describe_law(one.hypothesis), where)
        rivals.setdefault(_name(one.hypothesis), rival)
    of_device = hypothesis.site.kind == DEVICE
    against = step.acceptance.against.replace(f" with '{name}'", "").replace(name, "it")
    device_may_err = step.acceptance.device_may_err
    if not against:
        against = _explain_device(winner)
        device_may_err = bool(against)
    if not against and not choice.is_clear:
        against = (
            "if its form and its constants are chosen without the held-out poses, the error there "
            "falls by no more than its own uncertainty"
        )
    law = Law(
        place=_name_place(hypothesis),
        drivers=hypothesis.families,
        formula=write_formula(formula),
        unit=hypothesis.site.unit,
        parameters=tuple(coefficients),
        share=share_explained(
            step.rival.estimate.chi2_per_dof, step.result.estimate.chi2_per_dof, noise
        ),
        before=step.acceptance.before,
        after=step.acceptance.after,
        noise_floor=step.result.noise_floor,
        tested=tested,
        alternatives=tuple(rivals),
        choice=choice,
        evidence=winner.evidence,
        threshold=threshold,
        against=against,
        device_may_err=device_may_err,
        of_device=of_device,
        sentence=sentence,
        text=write_effect(formula, sentence, where, values=own),
        shape=find_shape(scene, formula),
        rivals=rivals,
    )
    return law, step


def _explain_device(winner: _Winner) -> str:
    """Explain why the measuring device may cause the error of a law; empty if it may not.

    A law of the platform's position alone is a field over the workspace, as a device has it. For a
    law of the device, explain why the robot may cause the error."""
    if winner.formula.hypothesis.site.kind == DEVICE:
        if winner.rival is None:
            return ""
        return (
            "the robot may cause it as well as the measuring device: "
            f"{_name(winner.rival)} explains nearly as much"
        )
    others = [one.hypothesis for one in winner.equal if one.hypothesis.site.kind == DEVICE]
    if others:
        return f"the measuring device may cause it: {_name(others[0])} describes it as well"
    if winner.rival is not None:
        return f"the measuring device may cause it: {_name(winner.rival)} explains more"
    drivers = winner.formula.hypothesis.families
    if set(drivers) <= set(PLACES) and not winner.excludes_device:
        return (
            f"the measuring device may cause it: it depends on {' and '.join(drivers)} alone, as "
            "an error of a device does"
        )
    return ""


def _name_place(hypothesis: Hypothesis) -> str:
    site = hypothesis.site
    return f"{site.name}, each its own" if site.each else site.name


def _name(hypothesis: Hypothesis) -> str:
    return f"{_name_place(hypothesis)} by {' and '.join(hypothesis.families)}"


def describe_law(hypothesis: Hypothesis) -> str:
    """Say where an error enters and on what it depends: "The reading of joint2 errs with the load
    on joint2"."""
    site = hypothesis.site
    names = [place.name for place in site.members]
    last = ", ".join(name.rpartition(".")[2] for name in names)
    what = {
        JOINT: f"The reading of {_join(names)}",
        PARAMETER: f"The parameter {_join(names)}",
        ROD: f"The length of {_join(names)}",
        PLATFORM: f"The platform's {last}",
        BASE: f"The rotation {last} of the base, as the device sees it,",
        DEVICE: f"The {last} that the device shows",
    }[site.kind]
    on = " and ".join(
        own[0].words if len({one.name for one in own}) == 1 else WORDS[own[0].family]
        for own in hypothesis.drivers
    )
    each = ", each in its own way" if site.each else ""
    return f"{what} errs with {on}{each}"


def _join(names: Sequence[str]) -> str:
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))


def _list_ranges(hypothesis: Hypothesis) -> dict[str, tuple[float, float]]:
    drivers = {one.name: one for own in hypothesis.drivers for one in own}
    return {name: one.range for name, one in drivers.items()}


def _describe_data(dataset: Dataset, tested: Mapping[str, tuple[float, float]]) -> str:
    spans = ", ".join(f"{name} {low:.4g} to {high:.4g}" for name, (low, high) in tested.items())
    digest = f" (sha256 {dataset.sha256[:12]})" if dataset.sha256 else ""
    return (
        f"parallel-cal discover, {len(dataset)} samples of {dataset.source or 'arrays'}{digest}; "
        f"tested in SI units: {spans}"
    )


def _conclude(
    model: Model,
    dataset: Dataset,
    found: Sequence[Law],
    advice: Sequence[str],
    described: Model,
    held: float,
) -> Discovery:
    """The verdict, its sentence, and what to measure next. `held` is by how many sigmas coordinates
    vary that the model holds at one value."""
    laws = tuple(law for law in found if not law.against)
    suspected = tuple(law for law in found if law.against)
    if laws:
        verdict = "described"
    elif any(law.device_may_err for law in suspected):
        verdict = "robot_or_device"
    else:
        verdict = "suspected" if suspected else "nothing"
    words = [_describe_proof(law) for law in laws]
    words += [f"{law.sentence}, but this is not proven: {law.against}." for law in suspected]
    if not words:
        words = [
            "no place and no driver explain more than in sessions with the same noise and without "
            "a law"
        ]
    summary = " ".join(words)
    if any(law.device_may_err for law in suspected):
        advice = [*advice, A_STATION]
    needs_larger_model = held > MAX_HELD_COORDINATE_SIGMAS
    if needs_larger_model:
        summary = f"{_explain_larger_model(model, held)} {summary}"
    return Discovery(
        model,
        dataset,
        laws,
        suspected,
        verdict,
        summary,
        tuple(advice),
        described,
        needs_larger_model,
    )


def _explain_larger_model(model: Model, held: float) -> str:
    """Say that a model is too small for what was measured, and which one to use instead."""
    mechanism, larger = model.mechanism, "a larger model"
    if type(mechanism).widen is not Mechanism.widen:
        name, _ = mechanism.widen(mechanism.parameters.mapping(mechanism.parameters.nominal))
        larger = f"the larger model {name}"
    return (
        "The measured pose includes coordinates that the model holds at one value; they vary by "
        f"{held:.0f} sigmas: use {larger} first."
    )


def _describe_proof(law: Law) -> str:
    """The sentence about a proven law."""
    numbers = [
        f"{c.name} {c.value:.3g}{f' +- {c.sigma:.2g}' if c.sigma else ''} {c.unit}"
        for c in law.parameters[:MAX_SHOWN_PARAMETERS]
    ]
    rest = len(law.parameters) - len(numbers)
    terms = ", ".join(numbers) + (f" and {rest} more" if rest else "")
    share = ""
    if law.share is not None:
        share = f" It accounts for {100 * law.share:.0f} % of the error above the noise floor."
    spans = ", ".join(f"{n} {low:.3g} to {high:.3g}" for n, (low, high) in law.tested.items())
    floor = f"; noise floor {format_errors(law.noise_floor)}" if law.noise_floor.is_known else ""
    other = f" Equally good: {', '.join(law.alternatives)}." if law.alternatives else ""
    # Each fold identifies the coefficients again, but not the form of the law and its constants.
    chosen = ["form", *(c.name for c in law.parameters if c.scanned)]
    verb = "was" if len(chosen) == 1 else "were"
    return (
        f"{law.sentence}: {law.formula} ({terms}).{share} Error at held-out poses "
        f"{format_errors(law.after, law.before)}{floor}; {_join(chosen)} {verb} chosen with "
        f"these poses: residuals there fall to {100 * law.choice.ratio:.1f} %, and to "
        f"{100 * law.choice.ratio_anew:.1f} % if chosen without them. Tested at {spans}.{other}"
    )


def _advise(scene: Scene, winner: _Winner, drivers: Sequence[Driver]) -> str:
    """Say which poses tell a law from an equally good one: those that resemble the samples at which
    the two differ most. Empty if there is no other."""
    if not winner.equal:
        return ""
    own, other = (
        scene.project_off_geometry(one.columns) @ one.coefficients.ravel()
        for one in (winner.formula, winner.equal[0])
    )
    apart = np.linalg.norm(scene.by_sample(own - other), axis=1)
    far = np.argsort(-apart)[: max(len(apart) // 10, 3)]
    names = f"{_name(winner.formula.hypothesis)} from {_name(winner.equal[0].hypothesis)}"
    sigmas = float(np.linalg.norm(apart))
    if sigmas < 1.0:
        return (
            f"nothing tells {names}: at these samples both laws are the same function "
            f"({sigmas:.1f} sigmas)"
        )
    shifts = [
        (float(np.mean(one.values[far]) - np.mean(one.values)) / float(np.std(one.values)), one)
        for one in drivers
        if one.family not in NOT_CHOSEN and np.std(one.values) > 0
    ]
    shifts.sort(key=lambda item: -abs(item[0]))
    where = [f"{'large' if shift > 0 else 'small'} {one.name}" for shift, one in shifts[:2]]
    return (
        f"to tell {names}, measure more poses with {' and '.join(where)}, where they differ most; "
        f"the present samples tell them by {sigmas:.1f} sigmas"
    )
