"""The catalogue as a model sees it: which effects these data can test, and how they score."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.diagnosis.scene import Scene, columns, columns_at, scene
from parallel_cal.diagnosis.scoring import Score, score
from parallel_cal.diagnosis.thresholds import SHUFFLES, VISIBLE_SIGMAS, WORTH_REFINING
from parallel_cal.identification.observations import conditions
from parallel_cal.model.effect import Effect
from parallel_cal.model.model import Model
from parallel_cal.model.shelf import load_effect, shelf_names
from parallel_cal.recordings.dataset import Dataset


@dataclass(frozen=True)
class Candidate:
    """One effect on these data: its score, or why it cannot have one.

    `settings` are its fixed numbers as scanned, `tried` how many were; `missing` conditions were
    not recorded, `reason` says what else stands against it. `there` is the scene it was scored
    in: a larger model has one of its own.
    """

    name: str
    effect: Effect
    settings: Mapping[str, float] = field(default_factory=dict)
    score: Score | None = None
    there: Scene | None = None
    tried: int = 1
    missing: tuple[str, ...] = ()
    reason: str = ""

    @property
    def testable(self) -> bool:
        """Whether the data could show the effect."""
        return self.score is not None and not self.reason

    @property
    def log_p(self) -> float:
        """Logarithm of the p-value, for as many settings as were tried."""
        if self.score is None:
            return 0.0
        return min(0.0, self.score.log_p + float(np.log(self.tried)))

    @property
    def p_value(self) -> float:
        return float(np.exp(self.log_p))

    @cached_property
    def shuffled_p(self) -> float | None:
        """Guard 4: share of copies with the condition shuffled between samples (all its columns
        alike) that score as well, counting the effect itself; None where it needs no condition."""
        if not self.effect.needs or self.score is None or self.there is None:
            return None
        here = self.there
        extended = here.model.with_effect(self.name, self.settings)
        a, new = conditions(extended, here.dataset), new_numbers(here.model, extended)
        own = [extended.conditions.index(c) for c in self.effect.conditions(extended.mechanism)]
        rng, as_good = np.random.default_rng(0), 1
        for _ in range(SHUFFLES):
            shuffled = a.copy()
            shuffled[:, own] = a[rng.permutation(len(a))][:, own]
            again = score(here, columns_at(extended, here, shuffled, new))
            as_good += again.log_p <= self.score.log_p
        return as_good / (SHUFFLES + 1)


def names_of(model: Model, also: Iterable[str] = (), only: Iterable[str] = ()) -> list[str]:
    """Effects to test: the shelf's, or `only` these, and a user's own by Python path (`also`)."""
    wanted = list(dict.fromkeys([*(list(only) or shelf_names("effects")), *also]))
    has = {effect.name for effect in model.effects}
    return [name for name in wanted if name not in has]


def candidate(here: Scene, name: str) -> Candidate:
    """The score of one effect, the best of its settings where it has any to scan."""
    effect = load_effect(name)
    if reason := effect.applies(here.model.mechanism):
        return Candidate(name, effect, reason=f"does not apply: {reason}")
    try:
        plain = here.model.with_effect(name)
    except ModelError as error:
        return Candidate(name, effect, reason=str(error))
    if missing := not_recorded(plain, here.dataset):
        return Candidate(name, effect, missing=missing, reason=_untestable(missing))
    if plain.mechanism is not here.model.mechanism:
        return _wider(here, name, effect, plain)
    a = conditions(plain, here.dataset)
    settings = list(effect.scan(here.model.mechanism))
    scores = [score_of(here, plain, setting, a) for setting in settings]
    best = int(np.argmin([s.log_p for s in scores]))
    setting, found = settings[best], scores[best]
    if len(settings) > 1 and len(setting) == 1 and found.log_p < WORTH_REFINING:
        setting, found = _refined(here, plain, settings, best, a)
    return Candidate(name, effect, setting, found, here, len(settings), (), _unseen(found))


def score_of(here: Scene, plain: Model, settings: Mapping[str, float], a: np.ndarray) -> Score:
    """The score of a model's last effect with these settings, conditions a (N, n_conditions)."""
    extended = plain.with_settings(plain.effects[-1].name, settings)
    return score(here, columns_at(extended, here, a, new_numbers(here.model, extended)))


def _refined(
    here: Scene, plain: Model, settings: list[Mapping[str, float]], best: int, a: np.ndarray
) -> tuple[Mapping[str, float], Score]:
    """The best value between the neighbours of the best one scanned."""
    from scipy.optimize import minimize_scalar

    (key,) = settings[best]
    near = sorted(s[key] for s in settings[max(best - 1, 0) : best + 2])
    found = minimize_scalar(
        lambda value: score_of(here, plain, {key: value}, a).log_p,
        bounds=(near[0], near[-1]),
        method="bounded",
        options={"xatol": 1e-3 * (near[-1] - near[0])},
    )
    refined = {key: float(found.x)}
    return refined, score_of(here, plain, refined, a)


def _unseen(found: Score) -> str:
    """Why a score says nothing: all that the effect could show hides in the geometry, or in the
    noise."""
    if not found.q:
        return "cannot be seen with this set-up: the geometry absorbs it"
    if found.size < VISIBLE_SIGMAS:
        return f"cannot be seen: at its typical size it makes {found.size:.1g} sigmas"
    return ""


def new_numbers(before: Model, after: Model) -> np.ndarray:
    """Mask of the free parameters that `after` has and `before` has not, or holds fixed."""
    old = {n for n, fixed in zip(before.table.names, before.fixed, strict=True) if not fixed}
    return np.array([n not in old for n in after.table.names]) & ~np.asarray(after.fixed)


def not_recorded(model: Model, dataset: Dataset) -> tuple[str, ...]:
    """Conditions, without their joints, that a model needs and the data lack."""
    lacking = (c for c in model.conditions if c not in dataset.conditions)
    return tuple(dict.fromkeys(c.split(".")[0] for c in lacking))


def _untestable(missing: tuple[str, ...]) -> str:
    return f"cannot be tested: no {' and no '.join(missing)} recorded"


def _wider(here: Scene, name: str, effect: Effect, wide: Model) -> Candidate:
    """A larger model's further parameters, in a scene of its own: its rows differ."""
    new = new_numbers(here.model, wide)
    observations = replace(here.observations, a=conditions(wide, here.dataset))
    there = scene(wide, here.dataset, observations, ~np.asarray(wide.fixed) & ~new)
    return Candidate(name, effect, score=score(there, columns(wide, there, new)), there=there)
