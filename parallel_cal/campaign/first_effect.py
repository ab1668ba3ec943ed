"""Find the effect without which the geometry cannot be identified, such as a target that slipped.

Where a large effect is missing, the geometry would have to imitate it with values that no such
robot has, and no fit of the geometry alone succeeds.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from parallel_cal.base.errors import FitError, ModelError
from parallel_cal.diagnosis.catalogue import (
    collect_recorded_values,
    find_missing_conditions,
    list_effects_to_test,
)
from parallel_cal.diagnosis.search import Chosen
from parallel_cal.identification.fit import fit
from parallel_cal.identification.options import FitOptions
from parallel_cal.model.model import Model
from parallel_cal.model.shelf import load_effect
from parallel_cal.recordings.dataset import Dataset

# How much larger chi2 must be with every other effect: two effects that explain the samples nearly
# as well leave it open which one the robot has.
MIN_CHI2_RATIO = 2.0
# Effects with more settings to scan are not tried: they are ripples, too small to mislead the
# geometry, and each setting costs a fit.
MAX_SETTINGS = 32


def find_first_effect(
    model: Model, dataset: Dataset, effects: Iterable[str], options: FitOptions
) -> Chosen | None:
    """Return the effect with which alone the samples can be fitted, if it is clear which.

    Each of the `effects` (all of the catalogue if none is named) is added before the first fit. The
    one that leaves the least chi2 is returned if every other effect leaves MIN_CHI2_RATIO times as
    much or permits no fit at all; else None.
    """
    least: dict[str, tuple[float, Mapping[str, float]]] = {}
    for name in list_effects_to_test(model, only=effects):
        for settings, extended in _variants(model, dataset, name):
            try:
                found = fit(extended, dataset, options, hold_out=0)
            except FitError:
                continue
            chi2 = found.estimate.chi2
            if chi2 < least.get(name, (np.inf,))[0]:
                least[name] = chi2, settings
    ranked = sorted(least, key=lambda name: least[name][0])
    if not ranked:
        return None
    best, others = ranked[0], ranked[1:]
    if others and least[others[0]][0] < MIN_CHI2_RATIO * least[best][0]:
        return None
    return Chosen(best, tuple(sorted(least[best][1].items())))


def _variants(
    model: Model, dataset: Dataset, name: str
) -> Iterator[tuple[Mapping[str, float], Model]]:
    """Yield an effect's settings to try, each with the model that has the effect so; none if it
    does not apply to the robot or depends on a condition that was not recorded."""
    effect = load_effect(name)
    if effect.applies(model.mechanism):
        return
    recorded = collect_recorded_values(dataset)
    try:
        if find_missing_conditions(model.with_effect(name), dataset):
            return
        scanned = [*effect.scan(model.mechanism, recorded)]
        for settings in scanned or [{}] if len(scanned) <= MAX_SETTINGS else ():
            yield settings, model.with_effect(name, settings)
    except ModelError:  # a larger mechanism that this robot cannot have
        return
