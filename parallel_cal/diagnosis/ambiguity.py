"""Ask which effects of a model another effect would replace without loss.

The residuals of a model that contains an effect cannot show its lookalikes. So each effect is
removed, and the catalogue is tested as if the effect had still to be found.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from parallel_cal.base.errors import ModelError
from parallel_cal.diagnosis.catalogue import Candidate
from parallel_cal.diagnosis.entries import rivals_of
from parallel_cal.diagnosis.next_measurement import DecidingPoses
from parallel_cal.diagnosis.search import Chosen, Rank, Search, Trial, is_superfluous
from parallel_cal.identification.registration import STATION_EFFECT
from parallel_cal.model.model import Model


@dataclass(frozen=True)
class Ambiguity:
    """An effect of the model, and the candidates that explain the samples as well in its place."""

    effect: str
    rivals: tuple[Candidate, ...]

    @property
    def names(self) -> list[str]:
        return [one.name for one in self.rivals]


def find_ambiguous_effects(
    model: Model,
    best: Trial,
    search_of: Callable[[Model], Search],
    rank_with: Callable[[str], Rank],
) -> tuple[Ambiguity, ...]:
    """Find the effects of a model that other effects would replace without loss.

    Parameters
    ----------
    model : Model
    best : Trial
        The fit of the model with the effects that were found.
    search_of : callable
        Makes the search that refits a smaller model.
    rank_with : callable
        Makes the ranking of the catalogue together with an effect of the model.
    """
    fitted, found = best.fitted, []
    for effect in model.effects:
        own = fitted.model.table.matching([f"{effect.name}.*"])
        if effect.name == STATION_EFFECT or not (own & fitted.free).any():
            continue  # it describes where devices stand, or its parameters were given
        try:
            search = search_of(model.without_effect(effect.name))
        except ModelError:  # another effect needs it
            continue
        without = search.fit(*best.chosen)
        if without.result is None or is_superfluous(without.result.estimate, fitted.estimate):
            continue
        unusual = any(size.effect == effect.name for size in fitted.unusual.values())
        present = Trial((*best.chosen, Chosen(effect.name, unusual=unusual)), fitted)
        ranked = rank_with(effect.name)(without)
        rivals = {effect.name: rivals_of(present, ranked).get(effect.name, [])}
        names = search.swaps(present, rivals).get(effect.name, [])
        if names:
            found.append(Ambiguity(effect.name, tuple(c for c in ranked if c.name in names)))
    return tuple(found)


def describe_ambiguities(found: Sequence[Ambiguity], plan: DecidingPoses | None) -> tuple[str, ...]:
    """Describe each ambiguity, with what the planned poses would tell about it."""
    sentences = []
    for one in found:
        names, cure = " or ".join([one.effect, *one.names]), ""
        if plan is not None and {one.effect, *one.names}.issuperset(plan.between):
            would = "tell" if plan.is_enough else "not yet tell"
            cure = (
                f"; {len(plan.poses)} planned poses would {would} (with a probability of "
                f"{plan.certainty.then:.2f})"
            )
        sentences.append(
            f"{names}: the samples do not tell which of them the robot has, the model contains "
            f"{one.effect}{cure}"
        )
    return tuple(sentences)
