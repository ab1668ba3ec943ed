"""Score the effects of the catalogue that the present samples can test."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from parallel_cal.base.confidence import EQUAL_EVIDENCE, SIGNIFICANCE_LEVEL
from parallel_cal.base.errors import ModelError
from parallel_cal.causes.effects import (
    MIN_SCANNED,
    compute_effect_columns,
    extend,
    find_missing_conditions,
    scan_settings,
    widen_scene,
)
from parallel_cal.causes.settings import choose_setting
from parallel_cal.diagnosis.scoring import Score, score
from parallel_cal.diagnosis.thresholds import (
    MAX_DIAGNOSED_SAMPLES,
    MIN_SLOW_CORRELATION,
    MIN_VISIBLE_SIGMAS,
)
from parallel_cal.identification.observations import conditions
from parallel_cal.model.effect import Effect
from parallel_cal.model.model import Model
from parallel_cal.model.shelf import load_effect
from parallel_cal.posterior.scene import Scene
from parallel_cal.posterior.search import WeighedSetting


@dataclass(frozen=True)
class Candidate:
    """One effect on these data: its score, or the reason why it has none.

    `settings` are its fixed numbers as scanned, `tried` how many were, `sigma` how uncertain those
    are that were refined. `applies` is False if this robot's model cannot have the effect,
    `missing` conditions were not recorded, `reason` says what else stands against it. `scene` is
    the one it was scored in: a larger model has one of its own.
    """

    name: str
    effect: Effect = field(repr=False)
    settings: Mapping[str, float] = field(default_factory=dict)
    score: Score | None = None
    scene: Scene | None = field(default=None, repr=False)
    tried: int = 1
    missing: tuple[str, ...] = ()
    reason: str = ""
    sigma: Mapping[str, float] = field(default_factory=dict)
    applies: bool = True

    @property
    def testable(self) -> bool:
        """Whether the data could show the effect."""
        return self.score is not None and not self.reason

    @cached_property
    def varies_slowly(self) -> bool:
        """Whether it goes with time, temperature, or a condition that was changed as slowly (loads
        in turn), as noise may that is not white."""
        if {"time", "temperature"} & set(self.effect.needs):
            return True
        if self.scene is None or not self.effect.needs:
            return False
        dataset = self.scene.dataset
        order = np.argsort(dataset.time, kind="stable")
        for name in self.effect.conditions(self.scene.model.mechanism):
            values = dataset.conditions[name][order]
            away = values - values.mean()
            # The divisor is limited because a condition that never changes has no correlation.
            neighbour_correlation = float(away[1:] @ away[:-1] / max(away @ away, 1e-300))
            if neighbour_correlation > MIN_SLOW_CORRELATION:
                return True
        return False

    @property
    def log_p(self) -> float:
        """Logarithm of the p-value, for as many settings as were tried."""
        if self.score is None:
            return 0.0
        return min(0.0, self.score.log_p + float(np.log(self.tried)))

    @property
    def p_value(self) -> float:
        return float(np.exp(self.log_p))


def candidate(
    scene: Scene,
    name: str,
    scored: Iterable[Candidate] = (),
    known: WeighedSetting | None = None,
    apart: bool = False,
) -> Candidate:
    """The score of one effect, with a `known` setting, or the best where it has any to scan; with
    `apart`, joints may have numbers of their own.

    An effect that has special cases among those `scored` is not scored if one of them explains
    nothing, and has no score unless it explains significantly more than each of them: simpler
    effects come first. A special case with stated constants is none of an effect that scans its
    own.
    """
    effect = load_effect(name)
    if reason := effect.applies(scene.model.mechanism):
        return Candidate(name, effect, reason=f"does not apply: {reason}", applies=False)
    try:
        plain = extend(scene.model, name)
    except ModelError as error:
        return Candidate(name, effect, reason=str(error), applies=False)
    if effect.of_device and not effect.reads and not scene.shows_pose:
        return Candidate(name, effect, reason="cannot be tested: no device measured a pose")
    if missing := find_missing_conditions(plain, scene.dataset):
        # The condition `session` is the number of the recording, which one recording alone lacks.
        lacks = f"no {' and no '.join(missing)} recorded"
        if list(missing) == ["session"]:
            lacks = "it needs at least two recordings"
        reason = f"cannot be tested: {lacks}"
        return Candidate(name, effect, missing=missing, reason=reason)
    if plain.mechanism is not scene.model.mechanism:
        return _score_larger_model(scene, name, effect, plain)
    a = conditions(plain, scene.dataset)
    settings = scan_settings(scene, effect)
    several = len(settings) > 1
    special = [c for c in scored if c.name in effect.generalizes and c.score is not None]
    if several:  # one turn of a stated pulley or motor says nothing about the other periods
        special = [c for c in special if c.tried >= MIN_SCANNED or not c.settings]
    for one in special:
        if one.log_p > np.log(SIGNIFICANCE_LEVEL):
            reason = f"not tested: {one.name}, a special case of it, explains nothing"
            return Candidate(name, effect, reason=reason)
    if not settings:
        reason = f"cannot be tested: {', '.join(effect.needs)} never changed"
        return Candidate(name, effect, reason=reason)
    if known:
        setting, sigma = known.values, known.sigma
    elif several:
        part = next(scene.divide(MAX_DIAGNOSED_SAMPLES))
        setting, sigma = choose_setting(part, name, settings, apart)
    else:
        setting, sigma = settings[0], {}
    highest = score(scene, compute_effect_columns(scene, plain, setting, a))
    reason = _explain_invisible(highest, len(settings))
    found = Candidate(name, effect, setting, highest, scene, len(settings), (), reason, sigma)
    for one in special:
        if found.log_p > one.log_p - EQUAL_EVIDENCE:
            reason = f"explains no more than {one.name}, a special case of it"
            return Candidate(name, effect, reason=reason)
    return found


def _explain_invisible(score: Score, tried: int) -> str:
    """Why a score says nothing: all that the effect could show hides in the geometry, or in the
    noise. An effect that the residuals show plainly is visible, however small it usually is."""
    if not score.q:
        return "cannot be seen with this set-up: the geometry absorbs it"
    shown = score.log_p + np.log(tried) < np.log(SIGNIFICANCE_LEVEL)
    if score.size < MIN_VISIBLE_SIGMAS and not shown:
        return f"cannot be seen: at its typical size it makes {score.size:.1g} sigmas"
    return ""


def _score_larger_model(scene: Scene, name: str, effect: Effect, wide: Model) -> Candidate:
    """A larger model's further parameters, in a scene of its own: its rows differ."""
    wider, further = widen_scene(scene, wide)
    return Candidate(name, effect, score=score(wider, further), scene=wider)
