"""Ask which effects of a model another effect may be in place of.

The residuals of a model that contains an effect cannot show its lookalikes. So each effect is
removed, and the sum is made about the geometry found with it, as if it had still to be found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.diagnosis.causes import Causes, Doubt, find_swaps
from parallel_cal.diagnosis.next_measurement import DecidingPoses
from parallel_cal.diagnosis.search import Trial
from parallel_cal.identification.observations import conditions
from parallel_cal.identification.registration import STATION_EFFECT
from parallel_cal.model.model import Model
from parallel_cal.posterior.scene import Scene


@dataclass(frozen=True)
class Ambiguity:
    """An effect of the model, the `names` of those that may be in its place, the likeliest first,
    and what the sum leaves possible."""

    effect: str
    names: list[str]
    doubt: Doubt = field(repr=False)


def find_ambiguous_effects(best: Trial, names: Sequence[str]) -> tuple[Ambiguity, ...]:
    """Find the effects of a model in whose place others may be.

    Parameters
    ----------
    best : Trial
        The fit of the model with the effects that were found.
    names : sequence of str
        The effects that are possible.
    """
    fitted, found = best.fitted, []
    new = {one.name for one in best.chosen}
    for effect in fitted.model.effects:
        own = fitted.model.table.matching([f"{effect.name}.*"])
        if effect.name in new or effect.name == STATION_EFFECT or not (own & fitted.free).any():
            continue  # it describes where devices stand, or its parameters were given
        try:
            smaller = fitted.model.without_effect(effect.name)
        except ModelError:  # another effect needs it
            continue
        others = (name for name in names if not fitted.model.has_effect(name))
        possible = [effect.name, *others]
        causes = Causes.of(_scene_without(best, smaller), possible, kinds=())
        described = causes.explain()[1]
        swaps = find_swaps(described)
        groups = ([name, *others] for name, others in swaps.items())
        rivals = next((group for group in groups if effect.name in group), [effect.name])
        if len(rivals) > 1:
            rivals.remove(effect.name)
            found.append(Ambiguity(effect.name, rivals, causes.list_possible(described, swaps)))
    return tuple(found)


def _scene_without(best: Trial, smaller: Model) -> Scene:
    """The residuals of a fit without one of its effects, at the geometry found with it."""
    fitted = best.fitted
    free = dict(zip(fitted.model.table.names, fitted.free.tolist(), strict=True))
    observations = replace(fitted.observations, a=conditions(smaller, fitted.dataset))
    mask = np.array([free[name] for name in smaller.table.names])
    return Scene.of(smaller, fitted.dataset, observations, mask, best.shared, fitted.prior)


def describe_ambiguities(found: Sequence[Ambiguity], plan: DecidingPoses | None) -> tuple[str, ...]:
    """Describe each ambiguity, with what the planned poses would tell about it."""
    sentences = []
    for one in found:
        names, cure = " or ".join([one.effect, *one.names]), ""
        if plan is not None and {one.effect, *one.names}.issuperset(plan.between):
            would = "tell" if plan.is_enough else "not yet tell"
            cure = (
                f"; {len(plan.poses)} planned pose{'s' if len(plan.poses) > 1 else ''} would "
                f"{would} (with a probability of "
                f"{plan.certainty.then:.2f})"
            )
        sentences.append(
            f"{names}: the samples do not tell which of them the robot has, the model contains "
            f"{one.effect}{cure}"
        )
    return tuple(sentences)
