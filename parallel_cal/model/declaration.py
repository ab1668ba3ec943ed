"""Checks of a mechanism's class, such as a user's own: missing, miscounted or misnamed parts."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.model.parameters import Parameter

if TYPE_CHECKING:
    from parallel_cal.model.mechanism import Mechanism

PARTS = ("joints", "parameters", "home", "workspace", "joint_limits")
SI = ("m", "rad", "s", "kg", "N", "K", "degC", "px")


def check(m: Mechanism) -> None:
    """Check everything but the closure; ModelError for the first error."""
    if missing := [part for part in PARTS if not hasattr(m, part)]:
        raise ModelError(f"the class does not define {', '.join(missing)}")
    if not set(m.controlled) <= set(m.moved):
        astray = [c for c in m.controls if c not in m.moves]
        raise ModelError(f"it controls {', '.join(astray)}, which it does not move")
    if len(m.controls) > len(m.joints):
        raise ModelError(
            f"it controls {' '.join(m.controls)}, but has only the joints {', '.join(m.joints)}"
        )
    for key, found, members in (
        ("joint_limits", m.joint_limits, m.joints),
        ("home.joints", m.home.joints, m.joints),
        ("home.passive", m.home.passive, m.passive),
        ("passive_units", m.passive_units, m.passive),
        ("workspace.low", m.workspace.low, m.controls),
        ("workspace.high", m.workspace.high, m.controls),
    ):
        if len(found) != len(members):
            each = f"{len(members)}, one for each of {', '.join(members) or 'none'}"
            raise ModelError(f"{key} has {len(found)} entries, expected {each}")
    for kind, units in (("joint", m.joint_units), ("passive", m.passive_units)):
        if not {*units} <= {"rad", "m"}:
            raise ModelError(f"{kind} units are {', '.join(units)}, expected rad or m")
    check_parameters(m.parameters)
    numbers = [*m.parameters.nominal, *m.parameters.tolerance, *m.home.configuration]
    if not np.isfinite(numbers).all():
        raise ModelError("nominal values, tolerances and home must be finite numbers")
    if not m.length > 0:
        raise ModelError(
            f"length is {m.length} m, expected above 0 (it is the scale that weighs angles)"
        )


def check_parameters(parameters: Iterable[Parameter]) -> None:
    """Check that all parameters have SI units and tolerances above 0 (ModelError)."""
    for parameter in parameters:
        if not parameter.tolerance > 0:
            raise ModelError(
                f"{parameter.name}: tolerance is {parameter.tolerance}, expected above 0"
            )
        if foreign := {*re.findall("[A-Za-z]+", parameter.unit)} - {*SI}:
            expected = f"expected SI units ({', '.join(SI)})"
            raise ModelError(f"{parameter.name} has the unit {', '.join(foreign)}, {expected}")
