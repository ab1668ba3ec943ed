"""Joint limits and the workspace of a machine, as LinuxCNC's .ini file states them.

`[JOINT_n] MIN_LIMIT` and `MAX_LIMIT` limit the joints, `[AXIS_X]` and so on the end point. A limit
that the machine cannot reach, such as the -1e99 that LinuxCNC assumes or the -1000 of its example
of a hexapod, ends no joint's travel. Source: LinuxCNC documentation, "INI configuration".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.units import DEGREE, MM
from parallel_cal.importing import deltas
from parallel_cal.importing.deltas import BELOW_HOMED, USED_HEIGHT_M, Shoulders, Towers
from parallel_cal.importing.settings import Settings
from parallel_cal.model.mechanism import Workspace
from parallel_cal.recordings.recording import Array

HOMED = "[JOINT_{}] HOME_OFFSET"  # the joint at its switch
JOINT_LIMITS = ("[JOINT_{}] MIN_LIMIT", "[JOINT_{}] MAX_LIMIT")
AXIS_LIMITS = ("[AXIS_{}] MIN_LIMIT", "[AXIS_{}] MAX_LIMIT")
RAIL_RODS = 100.0  # no rail is as many times longer than a rod
NO_LIMITS = (
    "the .ini file has no MIN_LIMIT and MAX_LIMIT that a joint can reach: joint limits are assumed "
    "in the model file; correct them there"
)
NOT_REACHED = (
    "[AXIS_Z] MIN_LIMIT and MAX_LIMIT are heights that the joints do not reach inside their own "
    "limits: they are not used"
)
BED_ELSEWHERE = (
    "the limits do not let the tool use z = 0, so the bed is assumed at the lowest height that "
    "they permit, z = {:.1f} mm, and a fit finds it. State where it is, if you know it (--sensor "
    "'probe: {{height: {:.4g}}}', in m)"
)


def read_limits(
    stated: Settings, fields: Sequence[str], unit: float, low: float, high: float
) -> Array:
    """Return MIN_LIMIT and MAX_LIMIT (2,) in m or rad: infinite if not stated, or beyond `low` and
    `high`, which the machine cannot reach."""
    expected = "a position of the joint, in the unit of LINEAR_UNITS or degrees"
    least, most = (
        stated.number(field, expected, default) * unit
        for field, default in zip(fields, (-np.inf, np.inf), strict=True)
    )
    if least >= most:
        raise stated.error(fields[1] if fields[1] in stated else fields[0], "MIN_LIMIT < MAX_LIMIT")
    return np.array([least if least > low else -np.inf, most if most < high else np.inf])


def _read_all_limits(stated: Settings, n: int, unit: float, low: float, high: float) -> Array:
    """Return the limits (n, 2) of joints 0 to n - 1."""
    fields = ([field.format(i) for field in JOINT_LIMITS] for i in range(n))
    return np.array([read_limits(stated, each, unit, low, high) for each in fields])


def _describe_assumed(limits: Array) -> list[str]:
    return [] if np.isfinite(limits).all() else [NO_LIMITS]


def strut_limits(
    stated: Settings, home: Array, switches: Array, unit: float
) -> tuple[Array, list[str]]:
    """Return limits (n, 2) m of struts, and remarks on what is assumed.

    A strut is longer than 0. Where MIN_LIMIT says otherwise, nobody has set the limits, and a
    MAX_LIMIT of more than twice the length at home is none. Struts are assumed to reach as far
    beyond home as their switches are before it.
    """
    limits = _read_all_limits(stated, len(home), unit, 0.0, np.inf)
    unset = np.isinf(limits[:, 0]) & (limits[:, 1] > 2 * home)
    limits[unset, 1] = np.inf
    remarks = _describe_assumed(limits)
    beyond = np.where(switches < home, 2 * home - switches, np.maximum(switches, 1.5 * home))
    assumed = np.column_stack([np.full(len(home), float(home.min()) / 2), beyond])
    return np.where(np.isfinite(limits), limits, assumed), remarks


def with_rails(towers: Towers, stated: Settings, unit: float) -> tuple[Towers, list[str]]:
    """Return a linear Delta with the limits and the workspace of its .ini file, and remarks."""
    rail = RAIL_RODS * float(towers.rods.max())
    limits = _read_all_limits(stated, 3, unit, -rail, rail)
    remarks = _describe_assumed(limits)
    at_switch = np.array([HOMED.format(i) in stated for i in range(3)])
    at_top = at_switch & np.isinf(limits[:, 1]) & (towers.end_stops > limits[:, 0])
    ends = np.column_stack([limits[:, 0], np.where(at_top, towers.end_stops, limits[:, 1])])
    above = np.sqrt(towers.rods**2 - towers.radius**2) + np.array(towers.zero)
    low, high = float((ends[:, 0] - above).max()), float((ends[:, 1] - above).min())
    if low >= high:
        field = JOINT_LIMITS[1].format(int((ends[:, 1] - above).argmin()))
        raise stated.error(field, "limits at which all three carriages are at one height")
    used = read_limits(stated, [f.format("Z") for f in AXIS_LIMITS], unit, -rail, rail)
    if max(low, used[0]) < min(high, used[1]):
        low, high = max(low, used[0]), min(high, used[1])
    else:
        used[:] = -np.inf, np.inf
        remarks.append(NOT_REACHED)
    floor = low if np.isfinite(low) else high - USED_HEIGHT_M
    if low <= 0 and high >= min(USED_HEIGHT_M, -low):
        floor = 0.0
    else:
        remarks.append(BED_ELSEWHERE.format(floor / MM, floor))
    height = float(towers.rods.min()) if np.isfinite(used[1]) else USED_HEIGHT_M
    box = _clip(deltas.make_box(towers.usual_reach, floor, min(high, floor + height)), stated, unit)
    floor_q, top_q = towers.joints(np.array([box.low, (0.0, 0.0, box.high[2])]))
    assumed = np.column_stack([np.minimum(-0.1, floor_q), np.maximum(towers.end_stops, top_q)])
    given = np.where(np.isfinite(limits), limits, assumed)
    return replace(towers, limits=_pairs(given), box=box), remarks


def with_arm_travel(
    hung: Shoulders, stated: Settings, unit: float, unreachable: DatasetError
) -> tuple[Shoulders, list[str]]:
    """Return a hanging rotary Delta with the limits and the workspace of its .ini file, and
    remarks. LinuxCNC counts the arms' angles downwards."""
    limits = -_read_all_limits(stated, 3, DEGREE, -np.pi, np.pi)[:, ::-1]
    remarks, homed = _describe_assumed(limits), hung.homed
    least = np.where(np.isfinite(limits[:, 0]), limits[:, 0], -np.pi / 2)
    top = np.where(homed > least, homed, np.pi / 2)
    given = np.column_stack([least, np.where(np.isfinite(limits[:, 1]), limits[:, 1], top)])
    bounded = replace(hung, limits=_pairs(given), switches=homed)
    middle = given.mean(axis=1) if np.isfinite(limits).all() else homed - BELOW_HOMED
    middle = np.clip(middle, *given.T)
    placed = deltas.place_below(bounded, middle, unreachable)
    used = read_limits(stated, [f.format("Z") for f in AXIS_LIMITS], unit, -np.inf, np.inf)
    if np.isfinite(used).all():
        q = hung.joints(np.array([[0.0, 0.0, used.mean()]]))[0]
        if ((q >= given[:, 0]) & (q <= given[:, 1])).all():
            placed = replace(placed, box=deltas.make_box(hung.usual_reach, *map(float, used)))
        else:
            remarks.append(NOT_REACHED)
    box = placed.box or deltas.make_box(hung.usual_reach)
    return replace(placed, box=_clip(box, stated, unit)), remarks


def _clip(box: Workspace, stated: Settings, unit: float) -> Workspace:
    """Return a workspace about the axis, inside the limits of [AXIS_X] and [AXIS_Y]."""
    low, high = list(box.low), list(box.high)
    for i, axis in enumerate("XY"):
        fields = [field.format(axis) for field in AXIS_LIMITS]
        least, most = read_limits(stated, fields, unit, -np.inf, np.inf)
        if least < 0 < most:
            low[i], high[i] = max(low[i], float(least)), min(high[i], float(most))
    return Workspace(tuple(low), tuple(high))


def _pairs(limits: Array) -> tuple[tuple[float, float], ...]:
    return tuple((float(low), float(high)) for low, high in limits)
