"""Add effects to a model before its first fit.

Where a large effect is missing, the geometry may imitate it with values that no such robot has.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from fnmatch import fnmatchcase

from parallel_cal.base.errors import FitError
from parallel_cal.identification.options import FitOptions
from parallel_cal.model.effect import parse_effects
from parallel_cal.model.model import Model
from parallel_cal.recordings.dataset import Dataset


def add_effects(model: Model, effects: Iterable[str], dataset: Dataset) -> Model:
    """Return the model with more effects, each `NAME`, `NAME:parameter=value` or several by `+`;
    what it knew of its own parameters stays known.

    ModelError for an unknown effect, or one that the model has. FitError for an effect with a
    parameter that must be stated: only `add` searches for it.
    """
    recorded = {**dataset.conditions, **dict(zip(dataset.joint_names, dataset.q.T, strict=True))}
    for name, settings in (one for text in effects for one in parse_effects(text)):
        had = {effect.name for effect in model.effects}
        model = model.with_effect(name, settings).with_covariance_of(model)
        own = [effect for effect in model.effects if effect.name == name and name not in had]
        for effect in own:  # none if the effect is a larger mechanism
            searched = {key for one in effect.scan(model.mechanism, recorded) for key in one}
            if missing := sorted(searched - set(settings)):
                raise FitError(
                    f"effect {name}: {', '.join(missing)} is not stated, and a first fit cannot "
                    f"search for it: write '{name}:{missing[0]}=...', or use 'add', which searches"
                )
    return model


def limit_patterns(options: FitOptions, smaller: Model, larger: Model) -> FitOptions:
    """Return the options for a model without an effect, from those for the model with it.

    Patterns that match only parameters of the effect are removed. A pattern that matches in neither
    model stays, so that the fit reports it.
    """

    def kept(pattern: str) -> bool:
        return _matches(smaller, pattern) or not _matches(larger, pattern)

    free, fix, refit = (
        tuple(filter(kept, patterns)) for patterns in (options.free, options.fix, options.refit)
    )
    return replace(options, free=free, fix=fix, refit=refit)


def _matches(model: Model, pattern: str) -> bool:
    return any(fnmatchcase(name, pattern) for name in model.table.names)
