"""Describe a plan of poses: the poses, their figures of merit, and the expected errors."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from parallel_cal.base.rotation import quaternion_to_matrix, rotation_vector
from parallel_cal.base.units import ARCMIN
from parallel_cal.model.words import describe
from parallel_cal.planning.indices import NAMES
from parallel_cal.planning.plan import Plan
from parallel_cal.reporting.blocks import Block, Table
from parallel_cal.reporting.readable import (
    FOUND,
    format_fixed,
    is_known,
    number,
    value_unit,
    vector,
)
from parallel_cal.reporting.summary import Line, summary_table

MIN_SHOWN_TURN = 1e-4  # rad; a platform that turns less does not turn
MAX_UNCERTAIN_PARAMETERS = 5  # that are named
ERRORS = {"position": ("um", 1e6), "orientation": ("arcmin", 1 / ARCMIN)}  # unit and factor


def describe_poses(found: Plan, document: dict[str, Any]) -> Table:
    """Describe the poses in units for people, with fewer digits than a file has.

    There is a column of rotations only if the platform turns.
    """
    units = found.model.mechanism.joint_units
    names = ", ".join(dict.fromkeys(value_unit(unit)[0] for unit in units))
    turns = rotation_vector(quaternion_to_matrix([row["quaternion"] for row in document["poses"]]))
    shows_turns = np.abs(turns).max() > MIN_SHOWN_TURN
    rows = [
        (
            str(k + 1),
            vector(row["position"], "m", 1),
            *([vector(turns[k], "rad", 1)] if shows_turns else []),
            " ".join(vector([q], unit, 1) for q, unit in zip(row["joints"], units, strict=True)),
        )
        for k, row in enumerate(document["poses"])
    ]
    turned = ["rotation vector [deg]"] if shows_turns else []
    return Table(("pose", "position [mm]", *turned, f"joints [{names}]"), rows)


def describe_plan(found: Plan, document: dict[str, Any]) -> Iterator[Block]:
    """Describe the figures of merit beside those of random poses, and what stays uncertain."""
    planned, random = document["indices"], document["random"]
    rows = [
        [words, _format_short(planned[key]), _format_short(random[key])]
        for key, words in NAMES.items()
    ]
    expected = (document["expected"], random["expected"])
    rows += [
        [
            f"expected {kind} error, rms [{unit}]",
            *(format_fixed(column[f"{kind}_rms"], factor, 2) for column in expected),
        ]
        for kind, (unit, factor) in ERRORS.items()
    ]
    yield Table(("", "planned", "random"), rows)
    sigmas = {k: v["sigma_tolerances"] for k, v in document["expected"]["parameters"].items()}
    order = sorted(sigmas, key=lambda k: -(math.inf if sigmas[k] is None else sigmas[k]))
    yield Table(
        ("least certain parameter", "description", "sigma [tolerances]"),
        [
            (name, describe(name, found.model.table), _format_short(sigmas[name]))
            for name in order[:MAX_UNCERTAIN_PARAMETERS]
        ],
    )


def summarize_plan(found: Plan, document: dict[str, Any], following: str) -> Table:
    """Make the last lines: the expected errors, and what to do next."""

    def write(expected: dict[str, Any]) -> str:
        parts = [
            f"{number(expected[f'{kind}_rms'], factor)} {unit}"
            for kind, (unit, factor) in ERRORS.items()
            if is_known(expected[f"{kind}_rms"])
        ]
        return ", ".join(parts) or "not known"

    about = f"expected after a fit to these {len(found)} poses (rms, noise not included)"
    update = []
    if found.update is not None:
        k, rest = found.update.enough, found.update.invisible
        words = f"the first {k} of these poses show every usual drift at 3 sigma"
        if k is None:
            words = f"{len(found)} poses show no usual drift at 3 sigma: plan more"
        elif rest:
            words += f", except {', '.join(rest)}, which {len(found)} poses do not show"
        half, most = found.update.unchanged
        still = f"if nothing has changed, {half} poses decide it in half of the cases"
        if half is None:
            still = f"if nothing has changed, {len(found)} poses seldom decide it: plan more"
        elif most is not None:
            still += f", {most} in 90 %"
        update = [Line("update:", words, FOUND), Line("", still, FOUND)]
    return summary_table(
        [
            *update,
            Line("planned:", f"{write(document['expected'])} {about}", FOUND),
            Line("random:", f"{write(document['random']['expected'])} at random poses"),
            Line("next:", following),
        ]
    )


def _format_short(value: float | None) -> str:
    """Format four digits without an exponent."""
    if value is None:
        return "-"
    return np.format_float_positional(value, precision=4, fractional=False, trim="-")
