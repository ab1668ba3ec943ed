"""What a fleet teaches of the next robot: where its numbers will lie, as a model file's priors."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np

from parallel_cal.fleet.findings import Findings, Spread
from parallel_cal.model.model import Model
from parallel_cal.model.parameters import ParameterTable


def next_robot(drawing: Model, found: Findings) -> Model:
    """The model to begin the next robot's calibration with, by `--prior`: nominal values at the
    fleet's means, tolerances its spreads, and the effects that all robots have.

    An effect's number stays one about zero, with a tolerance that holds the fleet's mean, too.
    """
    learned = {one.name: one for one in found.parameters}
    mechanism = copy(drawing.mechanism)
    mechanism.parameters = ParameterTable(
        replace(p, nominal=one.mean, tolerance=compute_expected_sigma(one))
        if (one := learned.get(p.name))
        else p
        for p in mechanism.parameters
    )
    common = [effect for effect in found.effects if effect.kind == "design"]
    has = {effect.name for effect in drawing.effects}
    own = replace(drawing, mechanism=mechanism, covariance=None, history=())
    for effect in common:
        own = own if effect.name in has else own.with_effect(effect.name)
    numbers = {one.name: one for effect in common for one in effect.numbers}
    tolerances = {
        name: float(np.hypot(one.mean, compute_expected_sigma(one)))
        for name, one in numbers.items()
    }
    values = own.table.mapping(own.values)
    values |= {name: one.mean for name, one in (learned | numbers).items() if name in values}
    return replace(
        own, values=own.table.vector(values), tolerances={**own.tolerances, **tolerances}
    )


def compute_expected_sigma(one: Spread) -> float:
    """How far another robot's parameter lies from the mean, 1 sigma; where the spread came out
    small, half of what it may be."""
    return float(np.hypot(max(one.spread, one.high / 2), one.sigma))
