"""Effects that were found larger than usual, with what each one gains at held-out poses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from parallel_cal.base.documents import to_json_value
from parallel_cal.diagnosis.search import Search, Trial, ratio_of
from parallel_cal.identification.acceptance import format_errors
from parallel_cal.identification.prediction_errors import Summary
from parallel_cal.identification.unusual import UnusualSize, describe_by_effect


@dataclass(frozen=True)
class UnusualEffect:
    """An effect with sizes outside the usual range, and the validation errors without and with it.

    `without` and `ratio` (with over without) are None if the effect was in the model already, or if
    the data cannot be fitted without it. `is_only_one`: no other effect was found.
    """

    name: str
    sizes: tuple[UnusualSize, ...]
    without: Summary | None
    present: Summary
    ratio: float | None
    is_only_one: bool

    @property
    def description(self) -> str:
        """The sentence about the size; with its gain if there are several effects."""
        words = describe_by_effect(self.sizes)[self.name]
        if self.without is None or not self.present.is_known or self.is_only_one:
            return words
        errors = format_errors(self.present, self.without)
        return f"{words}; this effect changes the error at held-out poses {errors}"

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
        others = tuple(c for c in best.chosen if c.name != name)
        without = search.fit(*others) if len(others) < len(best.chosen) else None
        known = None if without is None or without.result is None else without.result
        found.append(
            UnusualEffect(
                name,
                tuple(one for one in sizes if one.effect == name),
                known.held_out.summary if known else None,
                best.fitted.held_out.summary,
                ratio_of(without, best) if without is not None else None,
                not others,
            )
        )
    return tuple(found)
