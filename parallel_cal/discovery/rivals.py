"""Between which laws the samples leave the choice, as a plan of poses needs it."""

from __future__ import annotations

from dataclasses import replace

from parallel_cal.diagnosis.decision import Undecided
from parallel_cal.diagnosis.search import Chosen, Trial
from parallel_cal.discovery.effect_file import load_text
from parallel_cal.discovery.law import Discovery
from parallel_cal.identification.fit import fit
from parallel_cal.identification.options import FitOptions


def pair_laws(found: Discovery, options: FitOptions) -> list[Undecided]:
    """Pair each proven law with each law that describes the data equally well.

    The model with the proven laws is fitted once, so that a plan lets the geometry adapt to the
    rival. Laws that contradict each other's parameters cannot be compared and are omitted.
    """
    if not any(law.rivals for law in found.laws):
        return []
    model = found.model
    names = [load_text(law.text) for law in found.laws]
    for name in names:
        model = model.with_effect(name)
    fitted = fit(model, found.dataset, replace(options, hold_out=0.0))
    best = Trial(tuple(Chosen(name) for name in names), fitted)
    pairs = []
    for law, name in zip(found.laws, names, strict=True):
        for rival, text in law.rivals.items():
            sets = {law.name: Chosen(name), rival: Chosen(load_text(text))}
            doubt = Undecided.between(best, sets)
            if doubt is not None:
                pairs.append(doubt)
    return pairs
