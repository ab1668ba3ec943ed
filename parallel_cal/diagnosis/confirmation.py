"""Confirm what a search found: name only effects that `add` accepts, with the errors it reaches."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

from parallel_cal.base.errors import FitError
from parallel_cal.diagnosis.addition import Addition
from parallel_cal.diagnosis.explanation import Explanation
from parallel_cal.diagnosis.search import Chosen, Search, Trial, ratio_of
from parallel_cal.identification.fit import FitResult
from parallel_cal.identification.platform_shift import (
    explain_unseparated_device,
    find_large_device_effects,
)
from parallel_cal.model.effect import format_effect

USELESS = (
    "{} may only imitate an unknown law, and the error at held-out poses does not fall with it"
)
# What `add` makes of effects, with the fits without and with them
FindAddition = Callable[[str, FitResult, FitResult | None], Addition]


@dataclass(frozen=True)
class Confirmed:
    """The effects of a search as `add` judges them; `against` are the objections to those that it
    does not accept."""

    best: Trial
    robot_or_device: tuple[str, ...]
    addition: Addition | None
    doubted: Addition | None
    against: Mapping[str, str]

    @classmethod
    def of(cls, search: Search, found: Explanation, find: FindAddition) -> Confirmed:
        """Judge what a search found as `add` judges it, in one step.

        An effect that `add` refuses because the robot or the device may err stays in the diagnosis
        as doubtful, unless it only imitates an unknown law and the error does not fall with it; one
        that it refuses for another reason does not stay. The validation errors become those that
        `add` reaches. Without held-out poses `add` accepts nothing, and all stays.
        """
        base, best, robot_or_device = search.fit().fitted, found.best, found.robot_or_device
        against = dict[str, str]()
        doubtful = [*robot_or_device]
        if best.chosen and explain_unseparated_device(base, best.fitted):
            doubtful += find_large_device_effects(best.fitted.model)
        addition: Addition | None = None

        def judge(chosen: Sequence[Chosen]) -> Addition:
            # With stated noise the search has fitted them as `add` does.
            fitted = None if base.observations.unknown else search.fit_as_shown(*chosen).result
            return find("+".join(format_additions(best, chosen)), base, fitted)

        while base.held_out.judged.any() and addition is None:
            proven = [c for c in best.chosen if c.name not in doubtful]
            if not proven:
                break
            try:
                addition = judge(proven)
                objection = addition.acceptance.against
            except FitError as error:
                objection = str(error)
            if not objection:
                break
            more = () if addition is None else addition.doubtful
            addition = None
            if more:
                doubtful += more
                continue
            against[proven[-1].name] = objection
            left = [c for c in best.chosen if c is not proven[-1]]
            best = search.fit_as_shown(*left)
            while (
                best.result is None
            ):  # the others alone imitate what was refused, and cannot stand
                against[left[-1].name] = best.reason
                left = left[:-1]
                best = search.fit_as_shown(*left)
        for one in [c for c in best.chosen if c.name in doubtful and c.name in found.imitating]:
            without = search.fit_as_shown(*(c for c in best.chosen if c is not one))
            if (ratio_of(without, best) or 0.0) >= 1.0:
                against[one.name], best = USELESS.format(one.name), without
        doubted: Addition | None = None
        others = any(c.name in doubtful for c in best.chosen)
        if others and base.held_out.judged.any():
            with suppress(FitError):
                doubted = judge(best.chosen)
        if addition is not None and not others and not addition.knocked:
            best = replace(best, result=replace(best.fitted, held_out=addition.result.held_out))
        large = find_large_device_effects(best.fitted.model)
        names = [
            n for n in best.names if n in doubtful and (n in robot_or_device or n not in large)
        ]
        return cls(best, tuple(names), addition, doubted, against)


def format_additions(best: Trial, chosen: Iterable[Chosen]) -> tuple[str, ...]:
    """Effects of a trial, each as an argument of `add`."""
    names = best.fitted.model.table.names
    return tuple(format_effect(c.name, c.settings, names) for c in chosen)
