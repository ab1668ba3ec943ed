"""Search for a set of effects: forward by score, backward, and by exchange, judged at held-out
poses."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from itertools import product

from parallel_cal.base.errors import FitError, ModelError
from parallel_cal.base.progress import Progress
from parallel_cal.diagnosis.catalogue import Candidate
from parallel_cal.identification.checks import (
    ContradictionError,
    WrongSignError,
)
from parallel_cal.identification.estimate import NoSolutionError
from parallel_cal.identification.fit import FitResult, UnjudgedFit
from parallel_cal.identification.prediction_errors import held_out_ratio
from parallel_cal.identification.unusual import describe_by_effect
from parallel_cal.model.model import Model
from parallel_cal.posterior.scene import Scene, SharedDerivatives

Place = Callable[[Model], Model]  # the device where it stands if the robot has the effects
# Of a model; whether contradictions are accepted, and the fit near which a single step is enough.
Refit = Callable[[Model, bool, FitResult | None], UnjudgedFit]


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
    """A refit of the model with some effects, or the reason why it has none; `wrong_sign` is the
    effect whose sign physics forbids, if that is the reason, `contradicts` if it is a contradiction
    that a caller may insist on, `unsolved` if the refit found no solution. `scenes` keeps the scene
    once it is made; it shares derivatives with other trials. `unjudged` is the fit if its
    validation errors are not computed yet.
    """

    chosen: tuple[Chosen, ...]
    result: FitResult | None
    reason: str = ""
    wrong_sign: str = ""
    contradicts: bool = False
    unsolved: bool = False
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
        if self.result is None:
            raise FitError(self.reason)
        return self.result

    @property
    def scene(self) -> Scene:
        """The scene of the refit, made once for all trials that share it."""
        if not self.scenes:
            r = self.fitted
            scene = Scene.of(r.model, r.dataset, r.observations, r.free, self.shared, r.prior)
            self.scenes.append(scene)
        return self.scenes[0]


def _fail(chosen: tuple[Chosen, ...], error: FitError) -> Trial:
    """Make the trial of a refit that failed."""
    wrong_sign = error.effect if isinstance(error, WrongSignError) else ""
    contradicts = isinstance(error, ContradictionError)
    unsolved = isinstance(error, NoSolutionError)
    return Trial(chosen, None, str(error), wrong_sign, contradicts, unsolved)


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
    """The refits of one diagnosis, each made once, with the device where it stands if the robot has
    the effects of the refit: the lack of a large one moves it.

    Validation errors cost several fits: they are computed for those refits only that must be
    judged. The fit without further effects, which may be known (`base`), may have a geometry that
    no robot has, which imitates what is missing; one with effects must explain it.
    """

    def __init__(
        self,
        model: Model,
        refit: Refit,
        progress: Progress,
        usual_only: bool = False,
        place: Place | None = None,
        base: FitResult | None = None,
    ):
        self._model, self._progress, self._refit = model, progress, refit
        self._usual_only, self._place = usual_only, place or (lambda model: model)
        self._shared = SharedDerivatives()
        self._known: dict[tuple[Collection[Chosen], bool, bool], Trial] = {}
        if base is not None:
            self._known[frozenset(), False, False] = Trial((), base, shared=self._shared)

    def fit(
        self, *chosen: Chosen, insist: bool = False, judged: bool = True, once: bool = False
    ) -> Trial:
        """Fit the baseline with these effects on all poses and, if `judged`, judge it at held-out
        poses; with `insist`, unusual sizes and contradictions are accepted. With `once`, a single
        step from the baseline is enough: for what is shown, and decides nothing."""
        trial = self._fit_any_size(chosen, False, judged, once)
        if trial.result is None:
            again = insist and trial.contradicts
            return self._fit_any_size(chosen, True, judged) if again else trial
        usual = () if insist else tuple(one.name for one in chosen if not one.unusual)
        for effect, words in describe_by_effect(trial.result.unusual.values()).items():
            if effect in usual:
                return Trial(chosen, None, words)
        return trial

    def fit_as_shown(self, *chosen: Chosen, judged: bool = True, once: bool = False) -> Trial:
        """Fit with these effects, each as large as the data show, unless only usual sizes are
        accepted: `add` would accept it with a warning. `once` is as in `fit`."""
        trial = self._fit_any_size(chosen, False, judged, once)
        if self._usual_only or trial.result is None:
            return self.fit(*chosen, judged=judged, once=once)
        larger = describe_by_effect(trial.result.unusual.values())
        return replace(
            trial,
            chosen=tuple(replace(c, unusual=c.unusual or c.name in larger) for c in chosen),
        )

    def _fit_any_size(
        self, chosen: tuple[Chosen, ...], insist: bool, judged: bool, once: bool = False
    ) -> Trial:
        """Fit once for all callers, whatever size the effects turn out to have, and in whatever
        order they were chosen; a whole fit that is known is better than a single step."""
        ordered = tuple(replace(one, unusual=False) for one in chosen)
        for key in product((frozenset(ordered), ordered), (insist,), sorted({False, once})):
            if (known := self._known.get(key)) is None:
                continue
            if judged and known.unjudged is not None:
                known = self._known[key] = _judge(known)
            return replace(known, chosen=chosen)
        names = ", ".join(c.name for c in chosen)
        self._progress(f"refitting with {names}" if names else "refitting the geometry", 0.5)
        key = frozenset(ordered), insist, once
        model, near = self._model, self.fit(judged=False).result if once else None
        try:
            for one in chosen:
                model = model.with_effect(one.name, one.settings)
            # The lack of an effect moves the device; a single step does not pay for moving it back.
            if chosen and not once:
                model = self._place(model)
            unjudged = self._refit(model, insist, near)
            trial = Trial(chosen, unjudged.result, shared=self._shared, unjudged=unjudged)
            if chosen and (words := unjudged.result.implausible):
                trial = Trial(chosen, None, words)
        except ModelError as error:  # an effect of the larger model, before it: the order matters
            key, trial = (ordered, insist, once), Trial(chosen, None, str(error))
        except FitError as error:
            trial = _fail(chosen, error)
        self._known[key] = _judge(trial) if judged and trial.unjudged is not None else trial
        return replace(self._known[key], chosen=chosen)


def ratio_of(before: Trial, after: Trial) -> float | None:
    """Held-out error after over before; None where one is not known."""
    if before.result is None or after.result is None:
        return None
    return held_out_ratio(before.result.held_out.summary, after.result.held_out.summary)
