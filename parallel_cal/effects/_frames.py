"""Shared by effects of the whole scene: a base or device that shifts and rotates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca

from parallel_cal.base.rotation import cayley
from parallel_cal.model.effect import Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter

AXES = "xyz"
Size = tuple[str, float, float]  # unit, tolerance, and upper bound


def find_translation_axes(mechanism: Mechanism) -> list[str]:
    """Return the axes of {B} along which the platform moves."""
    return [a for a in AXES if a in mechanism.moves]


def find_rotation_axes(mechanism: Mechanism) -> list[str]:
    """Return the axes about which a rotation of the scene moves a coordinate of the platform."""
    moves = mechanism.moves
    return [a for a in AXES if f"r{a}" in moves or {*AXES} - {a} <= {*moves}]


def shift_and_turn(mechanism: Mechanism, v: Size, w: Size) -> list[Parameter]:
    """Return the parameters v and w along and about axes of {B} that move the platform."""
    return [
        *_components("v", find_translation_axes(mechanism), *v),
        *_components("w", find_rotation_axes(mechanism), *w),
    ]


def undo_shift_and_turn(seen: Seen, e: Named, share: Any) -> Seen:
    """Return the pose before it was rotated by w * share and then shifted by v * share."""
    v, w = (vector(e, name) * share for name in "vw")
    turn = cayley(w)
    return seen.with_pose(turn.T @ (seen.r - v), turn.T @ seen.R)


def vector(e: Named, name: str) -> Any:
    """Return three components; a component without a parameter is zero."""
    return ca.vertcat(*[e.get(f"{name}_{a}", 0) for a in AXES])


def _components(
    name: str, axes: list[str], unit: str, tolerance: float, most: float
) -> list[Parameter]:
    return [Parameter(f"{name}_{a}", unit, 0.0, tolerance, low=-most, high=most) for a in axes]


def select_station(
    stations: Mapping[int, Sequence[Sequence[float]]], session: Any
) -> tuple[Any, Any]:
    """Return the rotation (3, 3) and the shift (3, 1) from {B} to the frame of the device in a
    recording; `stations` has the rows of the rotation and the shift, by the number of the
    recording. A recording that it lacks has those of the first."""
    found = [(k, ca.DM(rows[:3]), ca.DM(rows[3])) for k, rows in stations.items()]
    _, turn, shift = found[0]
    for k, other, moved in found[1:]:
        turn = ca.if_else(session == k, other, turn)
        shift = ca.if_else(session == k, moved, shift)
    return turn, shift
