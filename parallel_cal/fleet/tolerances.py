"""Make the next robot's model file from a fleet: its means and spreads become the priors."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np

from parallel_cal.fleet.findings import Findings, Spread
from parallel_cal.model.model import Model
from parallel_cal.model.parameters import ParameterTable


def next_robot(drawing: Model, found: Findings) -> Model:
    """Make the model with which to start the next robot's calibration (`--prior`).

    Its nominal values are the fleet's means, its tolerances the fleet's spreads, and it has the
    effects of the design. The nominal value of an effect's coefficient stays zero, so its tolerance
    contains the fleet's mean, too.
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
    """Return 1 sigma of the distance of another robot's parameter from the mean.

    The spread counts as at least half the upper end of its interval: a spread of few robots may
    come out too small."""
    return float(np.hypot(max(one.spread, one.high / 2), one.sigma))
