"""Search for a set of effects: forward by score, backward, and by exchange, judged at held-out
poses."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from parallel_cal.base.errors import FitError, ModelError
from parallel_cal.base.progress import Progress
from parallel_cal.diagnosis.catalogue import Candidate, find_new_parameters
from parallel_cal.posterior.scene import Scene, SharedDerivatives, columns
from parallel_cal.diagnosis.scoring import log_p_of
from parallel_cal.diagnosis.thresholds import (
    EFFECT_SIGNIFICANCE_LEVEL,
    MAX_EFFECTS,
    MAX_EQUAL_SHUFFLES,
    MAX_LINEAR_OVERSIZE,
    MAX_SWAP_ERROR_RATIO,
    MAX_UNUSUAL_ERROR_RATIO,
    MAX_UNUSUAL_START_RATIO,
    MIN_CHI2_FALL,
    MIN_LOG_EVIDENCE_GAIN,
    MIN_SEPARATION_SIGMAS,
    SHUFFLES,
)
from parallel_cal.identification.acceptance import acceptance
from parallel_cal.identification.checks import (
    ContradictionError,
    ImplausibleGeometryError,
    WrongSignError,
)
from parallel_cal.identification.estimate import Estimate, NoSolutionError
from parallel_cal.identification.fit import FitResult, UnjudgedFit
from parallel_cal.identification.platform_shift import explain_unseparated_device
from parallel_cal.identification.prediction_errors import held_out_ratio
from parallel_cal.identification.unusual import describe_by_effect
from parallel_cal.model.model import Model
from parallel_cal.model.parameters import Parameter

Refit = Callable[[Model, bool], UnjudgedFit]  # of a model; whether contradictions are accepted


@dataclass(frozen=True)
class Chosen:
    """An effect with the settings of its fixed numbers, as pairs; `unusual` if its parameters may
    be larger than usual."""

    name: str
    fixed: tuple[tuple[str, float], ...] = ()
    unusual: bool = False

    @classmethod
    def of(cls, one: Candidate) -> Chosen:
        return cls(one.name, tuple(sorted(one.settings.items())))

    @property
    def settings(self) -> dict[str, float]:
        return dict(self.fixed)

    @property
    def text(self) -> str:
        """The effect as `add` takes it."""
        numbers = (f"{key}={float(value)!r}" for key, value in self.fixed)
        return ":".join(filter(None, [self.name, ",".join(numbers)]))


@dataclass(frozen=True)
class Trial:
    """A refit of the model with some effects, or the reason why it has none; `wrong_sign` if the
    reason is a sign that physics forbids, `contradicts` if it is a contradiction that a caller may
    insist on, `unsolved` if the refit found no solution. `implausible` is the chi2/dof of a refit
    whose geometry no robot has. `scenes` keeps the scene once it is made; it shares derivatives
    with other trials. `unjudged` is the fit if its validation errors are not computed yet.
    """

    chosen: tuple[Chosen, ...]
    result: FitResult | None
    reason: str = ""
    wrong_sign: bool = False
    contradicts: bool = False
    unsolved: bool = False
    implausible: float | None = None
    scenes: list[Scene] = field(default_factory=list, repr=False, compare=False)
    shared: SharedDerivatives | None = field(default=None, repr=False, compare=False)
    unjudged: UnjudgedFit | None = field(default=None, repr=False, compare=False)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(c.name for c in self.chosen)

    @property
    def kinds(self) -> frozenset[Chosen]:
        """The chosen effects with their settings, whatever size they may have."""
        return frozenset(replace(c, unusual=False) for c in self.chosen)

    @property
    def fitted(self) -> FitResult:
        """The refit; FitError if it failed."""
        if self.result is None and self.implausible is not None:
            raise ImplausibleGeometryError(self.reason, self.implausible)
        if self.result is None:
            raise FitError(self.reason)
        return self.result

    @property
    def scene(self) -> Scene:
        """The scene of the refit, made once for all trials that share it."""
        if not self.scenes:
            r = self.fitted
            scene = Scene.of(r.model, r.dataset, r.observations, r.free, self.shared)
            self.scenes.append(scene)
        return self.scenes[0]


def _fail(chosen: tuple[Chosen, ...], error: FitError) -> Trial:
    """Make the trial of a refit that failed."""
    wrong_sign = isinstance(error, WrongSignError)
    contradicts = isinstance(error, ContradictionError)
    unsolved = isinstance(error, NoSolutionError)
    absurd = error.chi2_per_dof if isinstance(error, ImplausibleGeometryError) else None
    return Trial(chosen, None, str(error), wrong_sign, contradicts, unsolved, absurd)


def _judge(trial: Trial) -> Trial:
    """Compute the validation errors of a trial; one that failed if they cannot be computed."""
    assert trial.unjudged is not None
    try:
        return replace(trial, result=trial.unjudged.judge(), unjudged=None)
    except FitError as error:
        return _fail(trial.chosen, error)


Rank = Callable[[Trial], list[Candidate]]  # what may be added to it, the best first
Rivals = Mapping[str, list[Candidate]]  # of each effect, what the data confuse it with


class Search:
    """The refits of one diagnosis, each made once. Validation errors cost several fits: they are
    computed for those refits only that must be judged."""

    def __init__(
        self,
        model: Model,
        refit: Refit,
        progress: Progress,
        usual_only: bool = False,
    ):
        self._model, self._progress, self._refit = model, progress, refit
        self._usual_only = usual_only
        self._shared = SharedDerivatives()
        self._known: dict[tuple[Collection[Chosen], bool], Trial] = {}

    def fit(self, *chosen: Chosen, insist: bool = False, judged: bool = True) -> Trial:
        """Fit the baseline with these effects on all poses and, if `judged`, judge it at held-out
        poses; with `insist`, unusual sizes and contradictions are accepted."""
        trial = self._fit_any_size(chosen, False, judged)
        if trial.result is None:
            again = insist and trial.contradicts
            return self._fit_any_size(chosen, True, judged) if again else trial
        usual = () if insist else tuple(one.name for one in chosen if not one.unusual)
        for effect, words in describe_by_effect(trial.result.unusual.values()).items():
            if effect in usual:
                return Trial(chosen, None, words)
        return trial

    def fit_as_shown(self, *chosen: Chosen, judged: bool = True) -> Trial:
        """Fit with these effects, each as large as the data show, unless only usual sizes are
        accepted: `add` would accept it with a warning."""
        trial = self._fit_any_size(chosen, False, judged)
        if self._usual_only or trial.result is None:
            return self.fit(*chosen, judged=judged)
        larger = describe_by_effect(trial.result.unusual.values())
        return replace(
            trial,
            chosen=tuple(replace(c, unusual=c.unusual or c.name in larger) for c in chosen),
        )

    def _fit_any_size(self, chosen: tuple[Chosen, ...], insist: bool, judged: bool) -> Trial:
        """Fit once for all callers, whatever size the effects turn out to have, and in whatever
        order they were chosen."""
        ordered = tuple(replace(one, unusual=False) for one in chosen)
        for key in ((frozenset(ordered), insist), (ordered, insist)):
            if (known := self._known.get(key)) is None:
                continue
            if judged and known.unjudged is not None:
                known = self._known[key] = _judge(known)
            return replace(known, chosen=chosen)
        names = ", ".join(c.name for c in chosen)
        self._progress(f"refitting with {names}" if names else "refitting the geometry", 0.5)
        key = frozenset(ordered), insist
        model = self._model
        try:
            for one in chosen:
                model = model.with_effect(one.name, one.settings)
            unjudged = self._refit(model, insist)
            trial = Trial(chosen, unjudged.result, shared=self._shared, unjudged=unjudged)
        except ModelError as error:  # an effect of the larger model, before it: the order matters
            key, trial = (ordered, insist), Trial(chosen, None, str(error))
        except FitError as error:
            trial = _fail(chosen, error)
        self._known[key] = _judge(trial) if judged and trial.unjudged is not None else trial
        return replace(self._known[key], chosen=chosen)

    def try_adding(self, before: Trial, one: Candidate) -> tuple[Trial, str]:
        """Refit with one more effect; return the trial and the objection to it (empty: none)."""
        after = self.fit(*before.chosen, Chosen.of(one))
        if after.result is None:
            return after, after.reason
        if reason := _describe_held_out_objection(before, after) or _describe_chance_objection(
            before, after, one
        ):
            return after, reason
        if (size := _compute_oversize_ratio(before.fitted, after.result)) > 1:
            return (
                after,
                f"its coefficients would be {size:.0f} times their usual size for little gain",
            )
        return after, explain_unseparated_device(before.fitted, after.result)

    def is_suspected(self, before: Trial, one: Candidate) -> bool:
        """Whether one more effect is significant but not proven yet, so that more poses would
        decide."""
        after = self.fit(*before.chosen, Chosen.of(one))
        if after.result is None or _describe_chance_objection(before, after, one):
            return False
        return bool(
            _describe_held_out_objection(before, after)
            or _compute_oversize_ratio(before.fitted, after.result) > 1
        )

    def forward(
        self, start: Trial, rank: Rank, rank_all: Rank, known: Trial | None = None
    ) -> tuple[Trial, dict[str, str]]:
        """Add effects one by one while one is significant and has no objection. `rank` returns the
        significant ones, `rank_all` all of the catalogue.

        It ends where the best next effect leads back to the effects, with the same settings, of a
        trial that is `known`: that trial was extended before.
        """
        trial: Trial = start
        against: dict[str, str] = {}
        while len(trial.chosen) < MAX_EFFECTS:
            best = rank(trial)[:1] if known else []
            if known and best and known.kinds <= trial.kinds | {Chosen.of(best[0])}:
                break
            more = self._find_next(trial, rank, rank_all, against)
            if more is None:
                break
            trial = more
        return trial, against

    def _find_next(
        self, before: Trial, rank: Rank, rank_all: Rank, against: dict[str, str]
    ) -> Trial | None:
        """Find the effect to add next; note objections `against` the others.

        An effect of usual size is taken, unless one that is larger than usual explains clearly
        more: a usual range is knowledge about other machines.
        """
        usual: Trial | None = None
        larger: list[Candidate] = []
        if rank(before):
            before = self.fit(*before.chosen)
        if before.result is None:
            return None
        for one in rank(before):
            after, reason = self.try_adding(before, one)
            if not reason:
                usual = after
                break
            against[one.name] = reason
            if after.result is None and not after.wrong_sign:
                larger.append(one)
        unusual = None if self._usual_only else self._try_unusual(before, larger)
        usual = usual or self._try_pairs(before, rank, rank_all)
        if usual is None or unusual is None:
            return usual or unusual
        return unusual if is_preferable(usual, unusual) else usual

    def _try_unusual(self, before: Trial, larger: list[Candidate]) -> Trial | None:
        """Find the effect, larger than usual, that explains most for its number of parameters;
        None if none passes."""
        found = []
        for one in larger:
            after = self.fit(*before.chosen, replace(Chosen.of(one), unusual=True))
            ratio = ratio_of(before, after)
            if ratio is None or ratio > MAX_UNUSUAL_ERROR_RATIO:
                continue
            if not (
                _describe_held_out_objection(before, after)
                or _describe_chance_objection(before, after, one)
                or explain_unseparated_device(before.fitted, after.fitted)
            ):
                found.append(after)
        best: Trial | None = None
        for after in found:
            if best is None or _explains_better(best, after):
                best = after
        return best

    def _try_pairs(self, before: Trial, rank: Rank, rank_all: Rank) -> Trial | None:
        """Find the best pair of effects of which one alone would need implausible parameters: the
        error may belong to the other, or half to a lookalike. None if no pair passes."""
        found, ranked = [], rank(before)
        trials = {c.name: self.fit(*before.chosen, Chosen.of(c)) for c in ranked}
        unsolved = {name for name, trial in trials.items() if trial.unsolved}
        partners = [c for c in rank_all(before) if c.score and c.name not in unsolved]
        refused = set[frozenset[str]]()  # the order of two effects hardly changes their sizes
        for one in ranked:
            alone = (*before.chosen, Chosen.of(one))
            if trials[one.name].result is not None:
                continue
            # A refit costs a second, and one without a solution several.
            if all(c.name == one.name or _is_pair_unusual(before, one, c) for c in partners):
                continue
            beyond = self.fit(*alone, insist=True, judged=False)
            more = rank(beyond) if beyond.result is not None else []
            halves = [c for c in ranked if c.name in one.effect.lookalikes]
            for other, less in [*((c, beyond) for c in more), *((c, before) for c in halves)]:
                pair = frozenset([one.name, other.name])
                if other.name in unsolved or pair in refused:
                    continue
                if _is_pair_unusual(before, one, other):
                    continue
                # Held-out poses last: they cost several fits, and most pairs fail before.
                both = self.fit(*alone, Chosen.of(other), judged=False)
                if both.result is None:
                    refused.add(pair)
                    continue
                if _describe_chance_objection(less, both, other):
                    continue
                if _compute_oversize_ratio(before.fitted, both.result) > 1:
                    continue
                both = self.fit(*alone, Chosen.of(other))
                if both.result is not None and not _describe_held_out_objection(before, both):
                    found.append(both)
                    break
        return min(found, key=lambda both: both.fitted.estimate.chi2_per_dof, default=None)

    def backward(self, trial: Trial) -> Trial:
        """Remove effects that later ones have made superfluous."""
        for one in trial.chosen:
            if len(trial.chosen) < 2:
                break
            # A superfluous effect does not stay only to keep another one in its usual range.
            others = [c for c in trial.chosen if c.name != one.name]
            if _is_superfluous_effect(self.fit_as_shown(*others, judged=False), trial):
                trial = self.fit_as_shown(*others)
        return trial

    def rescan_settings(self, trial: Trial, rank: Rank) -> Trial:
        """Scan the settings again with all chosen effects: the first scan did not know the later
        ones."""
        for name in trial.names if len(trial.chosen) > 1 else ():
            place = trial.names.index(name)
            *before, one = trial.chosen[: place + 1]
            behind = trial.chosen[place + 1 :]
            others = self.fit(*before, *behind, insist=True, judged=False) if one.fixed else None
            if others is None or others.result is None:
                continue
            again = next(c for c in rank(others) if c.name == name)
            chosen = replace(Chosen.of(again), unusual=one.unusual)
            after = self.fit(*before, chosen, *behind)
            if after.result and after.result.estimate.chi2 < trial.fitted.estimate.chi2:
                trial = after
        return trial

    def order_for_adding(self, trial: Trial) -> Trial:
        """Order the effects so that `add` accepts each of them after those before it, as far as
        there is such an order.

        The search may have exchanged effects that the later ones needed. Effects that can be fitted
        neither first nor last without each other are added together.
        """
        needed = []  # without these, the others cannot be fitted
        for one in trial.chosen:
            others = (c for c in trial.chosen if c is not one)
            if self.fit_as_shown(*others, judged=False).result is None:
                needed.append(one)
        tied = tuple(c for c in needed if self.fit_as_shown(c, judged=False).result is None)
        tied = tied if len(tied) > 1 else ()
        units = [(c,) for c in trial.chosen if c not in tied] + ([tied] if tied else [])
        chosen = self._find_longest_order((), tuple(units), set())
        names = [c.name for c in chosen]
        chosen = (*chosen, *(c for c in trial.chosen if c.name not in names))
        return trial if chosen == trial.chosen else self.fit(*chosen)

    def _find_longest_order(
        self,
        ordered: tuple[Chosen, ...],
        left: tuple[tuple[Chosen, ...], ...],
        ended: set[frozenset[str]],
    ) -> tuple[Chosen, ...]:
        """Find the longest order in which `add` accepts each group of effects `left` after those
        `ordered`. `ended` are the sets of effects from which no complete order was found."""
        before, longest = self.fit_as_shown(*ordered), ordered
        for one in left:
            more = (*ordered, *one)
            if frozenset(c.name for c in more) in ended:
                continue
            if _describe_objection_to_step(before, self.fit_as_shown(*more)):
                continue
            others = tuple(c for c in left if c is not one)
            found = self._find_longest_order(more, others, ended)
            longest = max(longest, found, key=len)
            if len(found) == len(ordered) + sum(map(len, left)):
                break
            ended.add(frozenset(c.name for c in more))
        return longest

    def exchange_rivals(self, trial: Trial, rivals: Rivals) -> Trial:
        """Exchange one effect for a rival that explains clearly more; the same trial if there is
        none."""
        clear = [
            other
            for *_, other in self._iterate_swaps(trial, rivals)
            if _is_clearly_better(trial, other)
        ]
        return min(clear, key=lambda other: other.fitted.estimate.chi2_per_dof, default=trial)

    def alternatives(self, trial: Trial, rivals: Rivals) -> list[Trial]:
        """The chosen effects, with one of them exchanged for a rival, wherever it can be fitted.

        A rival that is larger than usual must predict about as well: refits of such sizes are slow.
        Only those are judged that must be.
        """
        found = [other for *_, other in self._iterate_swaps(trial, rivals) if other.result]
        return [
            other
            for other in found
            if not any(one.unusual for one in other.chosen)
            or (ratio_of(trial, self.fit(*other.chosen)) or np.inf) <= MAX_UNUSUAL_START_RATIO
        ]

    def list_equals(self, trial: Trial, rivals: Rivals) -> list[Trial]:
        """The trials with one effect exchanged for a rival that explain the data as well, those
        with the least chi2 first."""
        found = [other for *_, other in self._iterate_swaps(trial, rivals)]
        equals = [other for other in found if is_as_good(trial, other)]
        return sorted(equals, key=lambda other: other.fitted.estimate.chi2_per_dof)

    def swaps(self, trial: Trial, rivals: Rivals) -> dict[str, list[str]]:
        """For each chosen effect, the rivals that explain the data as well in its place."""
        found: dict[str, list[str]] = {}
        for name, rival, other in self._iterate_swaps(trial, rivals):
            if is_as_good(trial, other):
                found.setdefault(name, []).append(rival)
        return found

    def _iterate_swaps(self, trial: Trial, rivals: Rivals) -> Iterator[tuple[str, str, Trial]]:
        """Iterate over chosen effects, their rivals, and the trials with the one in place of the
        other. A rival may be larger than usual if the effect is, and then must be able to stand
        alone: refits without a solution are slow."""
        for i, one in enumerate(trial.chosen):
            for other in rivals.get(one.name, []):
                rival = replace(Chosen.of(other), unusual=one.unusual)
                if rival.unusual and self.fit(rival).result is None:
                    continue
                swapped = (*trial.chosen[:i], rival, *trial.chosen[i + 1 :])
                exchanged = self.fit(*swapped, judged=False)
                # Nobody asks for the validation error of one that fits clearly worse.
                if fits_as_well(trial, exchanged):
                    exchanged = self.fit(*swapped)
                yield one.name, other.name, exchanged


def _is_pair_unusual(before: Trial, one: Candidate, other: Candidate) -> bool:
    """Whether two more effects would be far larger than usual, by one linear step from a fit.

    The usual sizes act as priors, so that a pair that the data hardly distinguish is never called
    unusual. The margin is for what is not linear; a refit decides about everything within it.
    """
    scene, parts, table = before.scene, list[np.ndarray](), list[Parameter]()
    for each in (one, other):
        if each.effect.widens:
            return False
        extended = scene.model.with_effect(each.name, each.settings)
        new = find_new_parameters(scene.model, extended)
        parts.append(columns(extended, scene, new))
        table += [p for p, is_new in zip(extended.table, new, strict=True) if is_new]
    B = scene.project_off_geometry(np.hstack(parts))
    prior = np.array([p.prior_sigma / p.tolerance for p in table])
    covariance = np.linalg.inv(B.T @ B + np.diag(prior**-2))
    sizes = covariance @ (B.T @ scene.residual)
    for p, size, variance in zip(table, sizes, np.diag(covariance), strict=True):
        low, high = p.plausible_range(float(np.sqrt(variance)) * p.tolerance)
        margin = MAX_LINEAR_OVERSIZE * (high - low)
        if not low - margin <= p.nominal + size * p.tolerance <= high + margin:
            return True
    return False


def _describe_held_out_objection(before: Trial, after: Trial) -> str:
    """Objection to a refit by its validation error; empty without held-out poses, because the
    verdict then says that nothing is proven."""
    judgement = acceptance(after.fitted, before.fitted)
    return judgement.against if judgement.judged else ""


def _describe_chance_objection(before: Trial, after: Trial, one: Candidate) -> str:
    """Objection that a refit is chance."""
    if _is_superfluous_effect(before, after):
        return "explains nothing of the remaining error"
    p = one.shuffled_p
    if p is not None and p > (1 + MAX_EQUAL_SHUFFLES) / (SHUFFLES + 1):
        return "explains no more than with its condition shuffled between poses"
    return ""


def _compute_oversize_ratio(before: FitResult, after: FitResult) -> float:
    """Rms of the new parameters in tolerances if the squares of all effects rise by more than the
    fall of chi2; else 0."""
    known = set(before.model.table.names)
    new = np.array([name not in known for name in after.model.table.names])
    were, squares = _sizes(before), _sizes(after)
    worth = (before.estimate.chi2 - after.estimate.chi2) / after.estimate.chi2_per_dof
    rise = squares.sum() - were.sum()
    return float(np.sqrt(squares[new & after.free].mean())) if rise > max(worth, 0.0) else 0.0


def _sizes(result: FitResult) -> np.ndarray:
    """Squares of the effects' numbers in tolerances (n_parameters,), less what is their own
    uncertainty; 0 for all others."""
    table, sigma = result.model.table, result.estimate.sigma
    away = (result.model.values - table.nominal) ** 2 - sigma**2
    counts = result.free & np.array([p.group == "effect" for p in table])
    return np.where(counts, np.maximum(away / table.tolerance**2, 0.0), 0.0)


def is_as_good(trial: Trial, other: Trial) -> bool:
    """Whether other effects explain the data as well, within the validation error and chance."""
    ratio = ratio_of(trial, other)
    return ratio is not None and ratio < MAX_SWAP_ERROR_RATIO and fits_as_well(trial, other)


def fits_as_well(trial: Trial, other: Trial) -> bool:
    """Whether other effects explain the same samples as well, within chance."""
    if trial.result is None or other.result is None:
        return False
    own, its = trial.result.estimate, other.result.estimate
    return its.chi2 - own.chi2 < MIN_SEPARATION_SIGMAS**2 * max(own.chi2_per_dof, 1e-300)


def _is_clearly_better(trial: Trial, other: Trial) -> bool:
    """Whether other effects explain more, by more than their numbers and chance are worth."""
    if other.result is None:
        return False
    own, its = trial.fitted.estimate, other.result.estimate
    worth = MIN_SEPARATION_SIGMAS**2 + 2 * max(own.dof - its.dof, 0)
    return own.chi2 - its.chi2 > worth * its.chi2_per_dof and not _describe_held_out_objection(
        trial, other
    )


def is_preferable(trial: Trial, other: Trial) -> bool:
    """Whether other effects explain the data better, or as well with fewer parameters."""
    if not is_more_informative(trial, other):
        return False
    ratio = ratio_of(trial, other)
    return ratio is None or ratio <= MAX_SWAP_ERROR_RATIO


def is_more_informative(trial: Trial, other: Trial) -> bool:
    """Whether other effects explain the same samples clearly better, or as well with fewer
    parameters; the validation errors are not compared."""
    if other.result is None:
        return False
    return information_gain(trial, other) > 2 * MIN_LOG_EVIDENCE_GAIN


def information_gain(trial: Trial, other: Trial) -> float:
    """Fall of the Bayesian information criterion chi2 / s^2 + k ln n (Schwarz 1978)."""
    own, its = trial.fitted.estimate, other.fitted.estimate
    noise = max(min(own.chi2_per_dof, its.chi2_per_dof), 1e-300)
    fewer = its.dof - own.dof
    return float((own.chi2 - its.chi2) / noise + fewer * np.log(max(own.dof, 2)))


def _explains_better(trial: Trial, other: Trial) -> bool:
    """Whether other effects explain the data better: by the error at held-out poses if the number
    of parameters says the same, else by the Bayesian information criterion.

    Many parameters can imitate what a few explain: in-sample they fit better, and predict worse.
    """
    ratio = ratio_of(trial, other)
    fewer = other.fitted.estimate.dof - trial.fitted.estimate.dof
    if ratio is not None and fewer > 0 and ratio <= 1:
        return True
    if ratio is not None and fewer < 0 and ratio >= 1:
        return False
    return information_gain(trial, other) > 0


def ratio_of(before: Trial, after: Trial) -> float | None:
    """Held-out error after over before; None where one is not known."""
    if before.result is None or after.result is None:
        return None
    return held_out_ratio(before.result.held_out.summary, after.result.held_out.summary)


def _describe_objection_to_step(before: Trial, after: Trial) -> str:
    """Objection of `add`, except that the device may err; empty if there is none."""
    if after.result is None:
        return after.reason
    if _is_superfluous_effect(before, after):
        return "the improvement may be chance"
    return _describe_held_out_objection(before, after) or explain_unseparated_device(
        before.fitted, after.fitted
    )


def _is_superfluous_effect(without: Trial, trial: Trial) -> bool:
    """Whether an effect explains nothing significant next to the others."""
    if without.result is None or trial.result is None:
        return False
    return is_superfluous(without.result.estimate, trial.result.estimate)


def is_superfluous(less: Estimate, more: Estimate) -> bool:
    """Whether the improvement by additional parameters may be chance, by an F test."""
    if less.dof == more.dof:  # a prior holds all of the additional parameters: at best it is one
        F = (less.chi2 - more.chi2) / max(more.chi2_per_dof, 1e-300)
        chance = log_p_of(max(F, 0.0), 1, max(more.dof, 1)) > np.log(EFFECT_SIGNIFICANCE_LEVEL)
        return bool(chance or more.chi2 > (1 - MIN_CHI2_FALL) * less.chi2)
    if less.dof < more.dof or more.dof <= 0:
        return False
    return improvement_log_p(less, more) > np.log(EFFECT_SIGNIFICANCE_LEVEL)


def improvement_log_p(less: Estimate, more: Estimate) -> float:
    """log p of the improvement by additional parameters, by an F test."""
    q = less.dof - more.dof
    if q <= 0 or more.dof <= 0:
        return 0.0
    F = max(less.chi2 - more.chi2, 0.0) / q / max(more.chi2_per_dof, 1e-300)
    return float(log_p_of(F, q, more.dof))
