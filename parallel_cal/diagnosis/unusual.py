"""Effects that were found larger than usual, with what each one gains at held-out poses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from parallel_cal.base.documents import to_json_value
from parallel_cal.diagnosis.search import Search, Trial, ratio_of
from parallel_cal.identification.acceptance import format_errors
from parallel_cal.identification.prediction_errors import Summary
from parallel_cal.identification.unusual import UnusualSize, describe_by_effect
from parallel_cal.model.shelf import load_effect


@dataclass(frozen=True)
class UnusualEffect:
    """An effect with sizes outside the usual range, and the validation errors without and with it.

    `without` and `ratio` (with over without) are None if the effect was in the model already, or if
    the data cannot be fitted without it. `is_only_one`: no other effect was found. `is_alone`: the
    errors are those without any effect and with this one alone, because the other effects alone
    have no plausible fit. `advice` says how to state the kind of machine on which such a size is
    usual, if the model does not state its kind.
    """

    name: str
    sizes: tuple[UnusualSize, ...]
    without: Summary | None
    present: Summary
    ratio: float | None
    is_only_one: bool
    is_alone: bool = False
    advice: tuple[str, ...] = ()

    @property
    def description(self) -> str:
        """The sentence about the size; with its gain if there are several effects."""
        words = describe_by_effect(self.sizes)[self.name]
        if self.without is not None and self.present.is_known and not self.is_only_one:
            errors = format_errors(self.present, self.without)
            alone = "alone, " if self.is_alone else ""
            words += f"; {alone}this effect changes the error at held-out poses {errors}"
        return ". ".join([words, *self.advice])

    def document(self) -> dict[str, Any]:
        return {
            "effect": self.name,
            "parameters": to_json_value(self.sizes),
            "holdout_without": to_json_value(self.without),
            "holdout_with": to_json_value(self.present),
            "holdout_ratio": self.ratio,
            "text": self.description,
        }


def find_unusual_effects(search: Search, best: Trial) -> tuple[UnusualEffect, ...]:
    """Find the effects of a fit that are larger than usual, and refit without each of them."""
    found = []
    sizes = best.fitted.unusual.values()
    for name in describe_by_effect(sizes):
        own = tuple(c for c in best.chosen if c.name == name)
        others = tuple(c for c in best.chosen if c.name != name)
        without, present = search.fit(*others) if own else None, best
        is_alone = without is not None and without.result is None
        if is_alone:
            without, present = search.fit(), search.fit_as_shown(*own)
        if without is None or without.result is None or present.result is None:
            before, after, ratio, is_alone = None, best.fitted, None, False
        else:
            before, after = without.result.held_out.summary, present.result
            ratio = ratio_of(without, present)
        its = tuple(one for one in sizes if one.effect == name)
        advice = tuple(load_effect(name).other_kinds(best.fitted.model.mechanism))
        found.append(
            UnusualEffect(
                name, its, before, after.held_out.summary, ratio, not others, is_alone, advice
            )
        )
    return tuple(found)
