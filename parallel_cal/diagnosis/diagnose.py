"""Find what a model lacks: ranked effects, a verdict, and what to measure next."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from parallel_cal.base.arguments import check_arguments
from parallel_cal.base.errors import FitError
from parallel_cal.base.options import with_changes
from parallel_cal.base.progress import Progress, ignore_progress
from parallel_cal.base.threads import single_threaded
from parallel_cal.causes.effects import list_effects_to_test
from parallel_cal.causes.knocks import are_few
from parallel_cal.diagnosis.addition import Addition, find_addition
from parallel_cal.diagnosis.ambiguity import (
    Ambiguity,
    describe_ambiguities,
    find_ambiguous_effects,
)
from parallel_cal.diagnosis.catalogue import Candidate, candidate
from parallel_cal.diagnosis.columns import check_far_values, check_samples, naming_wrong_columns
from parallel_cal.diagnosis.confirmation import Confirmed, FindAddition
from parallel_cal.diagnosis.entries import (
    chi2_before,
    entries,
)
from parallel_cal.diagnosis.explanation import Explanation
from parallel_cal.diagnosis.findings import Doubts, Findings, Remainder
from parallel_cal.diagnosis.next_measurement import NextMeasurement
from parallel_cal.diagnosis.patterns import (
    OddSample,
    describe_knocked_samples,
    explain_exclusion,
    find_innocent_samples,
    list_samples_far_from,
    odd_samples,
)
from parallel_cal.diagnosis.result import Diagnosis
from parallel_cal.diagnosis.search import (
    Refit,
    Search,
    Trial,
)
from parallel_cal.diagnosis.thresholds import (
    MAX_DIAGNOSED_SAMPLES,
    MAX_MISTRUSTED_SHARE,
)
from parallel_cal.diagnosis.unusual import find_unusual_effects
from parallel_cal.diagnosis.verdict import judge
from parallel_cal.identification.added_effects import limit_patterns
from parallel_cal.identification.fit import (
    FitResult,
    Prepared,
    UnjudgedFit,
    fit,
    fit_unjudged,
)
from parallel_cal.identification.given_model import GivenModel
from parallel_cal.identification.observations import Observations
from parallel_cal.identification.options import FitKeywords, FitOptions
from parallel_cal.identification.outliers import (
    describe_far_values,
    may_hide_in_noise,
    search_outliers,
)
from parallel_cal.identification.platform_shift import (
    explain_unseparated_device,
)
from parallel_cal.model.model import Model
from parallel_cal.model.shelf import load_effect
from parallel_cal.posterior.search import WeighedSetting
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.recordings.loading import select_samples
from parallel_cal.recordings.options import ReadOptions

if TYPE_CHECKING:
    from typing_extensions import Unpack

LIKE_DRIFT = "indistinguishable from drift: neighbours in time explain each other as well"


@check_arguments(FitError)
@single_threaded()
def diagnose(
    model: Model,
    dataset: Dataset,
    *,
    effects: Iterable[str] = (),
    also: Iterable[str] = (),
    options: FitOptions | None = None,
    progress: Progress | None = None,
    **changes: Unpack[FitKeywords],
) -> Diagnosis:
    """Find the physical effects that a model lacks.

    The free parameters are identified first. The part of each candidate's pattern that geometric
    parameters could imitate is removed, and the rest is compared with the residuals. The best
    candidates are refitted and judged at held-out poses.
    docs/judge_your_calibration.md explains the verdicts.

    Parameters
    ----------
    model : Model
    dataset : Dataset
        Of more than 10,000 samples, so many are diagnosed, evenly spread over the recording; a
        warning says so. They keep their numbers.
    effects : iterable of str, optional
        Test only these effects of the catalogue.
    also : iterable of str, optional
        Python paths of your own effects, tested too.
    options : FitOptions, optional
        Options of the identification as one object.
    progress : callable, optional
        Called with a stage in words and the completed share (0 to 1).
    **changes
        Single options by name, as in `fit`. With a robust `loss`, samples with a weight below 0.5
        are excluded before the search. `dataset.warnings` of the result lists them.

    Returns
    -------
    Diagnosis
        `verdict.word` is `at_noise`, `explained`, `partly_explained`, `unexplained` or
        `cannot_know`; `effects` names the effects found, `entries` lists every candidate,
        `measure_next` proposes measurements.

    Raises
    ------
    FitError
        If the free parameters cannot be identified, or if other columns or conventions of the
        samples would describe them: the message names these.

    Examples
    --------
    >>> import parallel_cal as pc
    >>> model = pc.read_model("config/delta_mockup_nominal.yaml")
    >>> data = pc.load_dataset("bags/delta_backlash", joints=model.joints)
    >>> diagnosis = pc.diagnose(model, data)
    >>> diagnosis.verdict.word, diagnosis.effects
    ('explained', ('backlash',))
    """
    options = with_changes(options, FitOptions, changes, FitError)
    dataset = select_samples(dataset, ReadOptions(max_samples=MAX_DIAGNOSED_SAMPLES))
    setup = _Setup.of(model, dataset, effects, also, options, progress or ignore_progress)
    with naming_wrong_columns(setup.ready.start, setup.ready.dataset, setup.any_size):
        if options.loss == "linear":
            return setup.diagnose_without([])
        return setup.diagnose_without_mistrusted()


@single_threaded()
def diagnose_fitted(
    model: Model, dataset: Dataset, fitted: FitResult, progress: Progress | None = None
) -> Diagnosis:
    """Diagnose a model as `diagnose` does, with its `fitted` result to the same samples, which is
    not computed again. Raises FitError as `diagnose`."""
    options, report = fitted.options, progress or ignore_progress
    if options.loss != "linear":  # such a fit only tells which samples it mistrusts
        return diagnose(model, dataset, options=options, progress=report)
    names = list_effects_to_test(fitted.start, (), ())
    ready = Prepared(
        fitted.given, fitted.start, fitted.dataset, options, fitted.registration, fitted.drift
    )
    setup = _Setup(model, dataset, ready, names, report, fitted)
    with naming_wrong_columns(ready.start, ready.dataset, setup.any_size):
        return setup.diagnose_without([])


@dataclass(frozen=True)
class _Setup:
    """What is asked about which samples.

    `recorded` are the samples as given for the model that was `asked`; both are `ready` for a fit,
    with the device in its place. `names` are the effects to test. `fitted` is the fit of the model
    to all these samples, if it is known.
    """

    asked: Model
    recorded: Dataset
    ready: Prepared
    names: list[str]
    report: Progress
    fitted: FitResult | None = None

    @classmethod
    def of(
        cls,
        asked: Model,
        recorded: Dataset,
        effects: Iterable[str],
        also: Iterable[str],
        options: FitOptions,
        report: Progress,
    ) -> _Setup:
        """Prepare the samples as a fit does, and list the effects to test."""
        ready = Prepared.of(asked, recorded, options)
        names = list_effects_to_test(ready.start, also, effects)
        return cls(asked, recorded, ready, names, report)

    @property
    def any_size(self) -> FitOptions:
        """The options of a fit with effects of any size: an unusual one is evidence against other
        effects in any case."""
        return replace(self.ready.options, usual_only=False)

    def diagnose_without_mistrusted(self) -> Diagnosis:
        """Diagnose without the samples that a robust fit trusts least."""
        why, aside = f"by --loss {self.ready.options.loss}", self._find_mistrusted(self.ready.start)
        found = self.diagnose_without(aside, why)
        # A good pose may look bad only for as long as the effect is not in the model.
        try:
            again = self._find_mistrusted(found.best.fitted.model) if found.effects else aside
        except FitError:  # with all samples an effect may be out of its range
            return found
        return found if again == aside else self.diagnose_without(again, why)

    def diagnose_without(
        self,
        aside: list[int],
        why: str = "",
        seen: Observations | None = None,
        trusted: frozenset[int] = frozenset(),
    ) -> Diagnosis:
        """Diagnose without these samples, and without those that were disturbed alone, except the
        `trusted` ones; name them if it is known how all were `seen`."""
        why = why or f"because it is {explain_exclusion(self.ready.dataset, aside)}"
        kept = self.ready.dataset.excluding(aside, why)
        judged = self.ready.given.with_dataset(kept)
        least_squares = replace(self.any_size, loss="linear")
        base = None if aside else self.fitted
        refit = refit_with_equal_weights(self.ready.start, judged, least_squares, base)

        def place(extended: Model) -> Model:
            return judged.place(extended, self.any_size)

        def set_aside(knocked: Sequence[int]) -> list[int]:
            more = [one for one in knocked if one not in trusted]
            few = self.ready.options.loss == "linear" and are_few(
                [*aside, *more], self.ready.dataset
            )
            return more if few else []

        def find(text: str, base: FitResult, result: FitResult | None) -> Addition:
            as_add = replace(self.ready.options, loss="linear")
            samples, known = self.recorded.excluding(aside, why), (base, result)
            return find_addition(self.asked, text, samples, as_add, knocked=(), known=known)

        search = Search(
            self.ready.start, refit, self.report, self.ready.options.usual_only, place, base
        )
        self.report("identifying the geometry", 0.0)
        if not aside and (odd := self._find_contradicting(search.fit(judged=False))):
            return self.diagnose_without(odd[0], seen=odd[1])
        explanation = Explanation.of(search, self.names, set_aside)
        if more := explanation.knocked:
            everything = seen or search.fit().fitted.observations
            others = self.diagnose_without(sorted([*aside, *more]), "", everything, trusted)
            if innocent := find_innocent_samples(others.knocked, more):
                return self.diagnose_without(aside, why, seen, trusted | innocent)
            return others
        found = _diagnose_trusted(self, explanation, find)
        if seen is None:
            return found
        best = found.best.fitted.model
        far = list_samples_far_from(best, self.ready.dataset, seen, aside)
        return _with_samples_aside(found, far, self.ready.dataset)

    def _find_contradicting(self, base: Trial) -> tuple[list[int], Observations] | None:
        """Return the samples that contradict all others, which an implausible geometry may follow,
        or an estimated noise hide, and how all were seen; None if there are none, or more than a
        few. FitError if the columns or the motion of the samples are the cause of the geometry.
        Where no fit succeeds, samples are known only by values far outside those of all others."""
        model, dataset, options = self.ready.start, self.ready.dataset, self.any_size
        if base.result is None:
            if not are_few(far := [*describe_far_values(dataset)], dataset):
                check_far_values(dataset, base.reason)
            seen = self.ready.given.observe(model, dataset, options.joint_sigma, options.insist)
            return (far, seen) if far else None
        implausible = base.result.implausible
        if not implausible and not may_hide_in_noise(base.result.observations, dataset):
            return None
        observations = self.ready.given.observe(model, dataset, options.joint_sigma, options.insist)
        outliers = search_outliers(model, dataset, observations, options)
        numbers = list(outliers.numbers) if outliers else []
        few = numbers if are_few(numbers, dataset) else []
        if implausible:
            others = dataset.excluding(few, f"because it is {explain_exclusion(dataset, few)}")
            check_samples(model, others, options, implausible)
        return (few, observations) if few else None

    def _find_mistrusted(self, model: Model) -> list[int]:
        return find_mistrusted_samples(fit(model, self.ready.dataset, self.any_size, hold_out=0))


def find_mistrusted_samples(robust: FitResult) -> list[int]:
    """Return the samples that a robust fit trusts least, in order. Where most are mistrusted, it is
    the model that is wrong: at most a quarter of the samples is returned."""
    worst = robust.down_weighted[: int(MAX_MISTRUSTED_SHARE * len(robust.dataset))]
    return sorted(one.sample for one in worst)


def _with_samples_aside(
    others: Diagnosis, aside: Sequence[OddSample], dataset: Dataset
) -> Diagnosis:
    """Name the samples of a dataset in a diagnosis that was made without them."""
    remarks = (*others.verdict.remarks, describe_knocked_samples(aside, dataset))
    numbers = {one.sample for one in aside}
    odd = [one for one in others.odd_samples if one.sample not in numbers]
    return replace(
        others,
        verdict=replace(others.verdict, remarks=remarks),
        odd_samples=(*aside, *odd),
        knocked=tuple(aside),
    )


def refit_with_equal_weights(
    model: Model, given: GivenModel, options: FitOptions, base: FitResult | None = None
) -> Refit:
    """Return what refits larger models than `model` to the same samples, with the noise that the
    first fit estimates, or `base` if it is known: only with equal weights can the residuals of two
    models be compared."""
    noise: Observations | None = None if base is None else base.observations

    def refit(extended: Model, insist: bool, near: FitResult | None) -> UnjudgedFit:
        nonlocal noise
        asked = replace(options, insist=insist or options.insist)
        asked = limit_patterns(asked, extended, model)
        unjudged = fit_unjudged(extended, given.dataset, asked, None, given, noise, near)
        noise = noise or unjudged.result.observations
        return unjudged

    return refit


def _diagnose_trusted(setup: _Setup, found: Explanation, find: FindAddition) -> Diagnosis:
    """Diagnose samples of which none is set aside; `find` returns what `add` makes of effects."""
    search, names, report = found.search, setup.names, setup.report
    base = search.fit()
    ranked = tuple(_rank(base, names, found.settings, report))
    report("judging the effects as add does", 0.7)
    confirmed = Confirmed.of(search, found, find)
    best = confirmed.best
    rest, ambiguous = Remainder.of(best.scene), find_ambiguous_effects(best, names)
    report("computing the weights of the observations", 0.8)
    swaps = {name: rivals for name, rivals in found.swaps.items() if name in best.names}
    measure_next = _plan_next(best, found, swaps, ambiguous, ranked)
    doubts = Doubts(
        swaps=swaps,
        refused=(*confirmed.against.values(), *found.refuted.values()),
        robot_or_device=confirmed.robot_or_device,
        outdone=found.outdone,
        wrong_signs=found.wrong_signs,
        unusual=find_unusual_effects(search, best),
        ambiguous=describe_ambiguities(ambiguous, measure_next.plan) if ambiguous else (),
        unseparated=explain_unseparated_device(base.fitted, best.fitted) if best.chosen else "",
        like_drift=found.like_drift,
    )
    missing = zip(best.names, found.missing(best.names), strict=True)
    probability = {name: one["probability"] for name, one in missing}
    before = chi2_before(base, best, ranked)
    findings = Findings(base, best, before, rest, doubts, probability, found.laws)
    against = _list_refusals(best, found, confirmed, ambiguous)
    return Diagnosis(
        ready=setup.ready,
        findings=findings,
        explanation=found,
        confirmed=confirmed,
        entries=entries(ranked, base, search, rest.noise, against, best, found, confirmed.against),
        verdict=judge(findings),
        measure_next=measure_next,
        ambiguous=ambiguous,
        odd_samples=odd_samples(best.scene, rest.field),
    )


def _plan_next(
    best: Trial,
    found: Explanation,
    swaps: Mapping[str, list[str]],
    ambiguous: Sequence[Ambiguity],
    ranked: tuple[Candidate, ...],
) -> NextMeasurement:
    """What to measure so that the samples decide between effects and their rivals."""
    rivals = {c.name: swaps.get(c.name, []) for c in best.chosen}
    doubts = [found.doubt] if any(rivals.values()) and found.doubt else []
    rivals |= {one.effect: one.names for one in ambiguous}
    doubts += [one.doubt for one in ambiguous]
    return NextMeasurement(best, rivals, ranked, tuple(doubts))


def _list_refusals(
    best: Trial, found: Explanation, confirmed: Confirmed, ambiguous: Sequence[Ambiguity]
) -> dict[str, str]:
    """Why effects that the samples would allow are not among those found."""
    against = {**dict.fromkeys(found.like_drift, LIKE_DRIFT), **found.refuted, **found.absurd}
    against |= confirmed.against
    # What was refused at first, and chosen in the end, is not refused.
    against = {name: words for name, words in against.items() if name not in best.names}
    for one in ambiguous:
        looks_like = f"the samples do not distinguish it from {one.effect} of the model"
        against |= dict.fromkeys(one.names, looks_like)
    return against


def _rank(
    base: Trial, names: Sequence[str], found: Mapping[str, WeighedSetting], report: Progress
) -> list[Candidate]:
    """The effects to test as candidates, best first, untestable ones last; those found with the
    settings found."""
    scored = list[Candidate]()
    # Special cases come before the effects that generalize them.
    for k, name in enumerate(sorted(names, key=lambda name: bool(load_effect(name).generalizes))):
        report(f"testing {name}", 0.1 + 0.3 * k / len(names))
        scored.append(candidate(base.scene, name, scored, found.get(name)))
    return sorted(scored, key=lambda c: (not c.testable, c.log_p))
