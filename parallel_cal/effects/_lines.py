"""Shared by effects of the lines of a cable robot: which robots have them, lengths and tensions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.rotation import quaternion_to_matrix
from parallel_cal.mechanisms.cable import Cable
from parallel_cal.mechanisms.hanging_sled import HangingSled
from parallel_cal.model.effect import Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named

LINES = (Cable, HangingSled)


def needs_lines(mechanism: Mechanism) -> str:
    """Return why an effect of lines does not apply; empty if it does."""
    if not isinstance(mechanism, LINES):
        return "no line holds the platform"
    if isinstance(mechanism, Cable) and any(mechanism.moving_pulleys):
        return "its lines run over pulleys on the platform"
    return ""


def needs_point(mechanism: Mechanism) -> str:
    """Return why lines do not end at one point; empty if they do, or if there are none."""
    return "its lines hold a sled that tilts" if isinstance(mechanism, HangingSled) else ""


def has_redundant_lines(mechanism: Mechanism) -> bool:
    """Whether lines can pull against each other: there are more of them than freedoms."""
    return len(mechanism.joints) > len(mechanism.moves)


def hangs(mechanism: Mechanism) -> bool:
    """Whether the lines carry weight: gravity acts along a coordinate that moves."""
    return any(mechanism.gravity[axis] for axis in mechanism.moved if axis < 3)


def _explain_gravity(mechanism: Mechanism) -> str:
    """Say what to state if the platform hangs, although gravity is across its motion."""
    down = [-9.81 * (axis == mechanism.moves[-1]) + 0.0 for axis in "xyz"]
    return (
        f"gravity {list(mechanism.gravity)} m/s^2 does not act in its directions of motion "
        f"({' '.join(mechanism.moves)}); if it hangs, state gravity in the model file "
        f"(gravity: {down})"
    )


def needs_tension(mechanism: Mechanism) -> str:
    """Return why the tensions of the lines are not known; empty if they are."""
    if why := needs_lines(mechanism):
        return why
    if hangs(mechanism) or has_redundant_lines(mechanism):
        return ""
    why = "neither a weight nor redundant lines keep its lines taut"
    return f"{why}: {_explain_gravity(mechanism)}"


def needs_hanging_lines(mechanism: Mechanism) -> str:
    """Return why the weight of the platform does not stretch lines; empty if it does."""
    if why := needs_lines(mechanism) or needs_point(mechanism):
        return why
    if hangs(mechanism):
        return ""
    return f"the platform does not move along gravity: {_explain_gravity(mechanism)}"


def compute_sag(seen: Seen, mechanism: Cable, weight: Any) -> Any:
    """Return the displacement of the platform by a weight (N), in the coordinates that move, times
    the stiffness EA (N) of the lines, which is the same for all."""
    n = len(mechanism.moves)
    K = ca.SX.zeros(n, n)
    for i, strand in enumerate(find_strands(seen, mechanism), start=1):
        to_anchor = mechanism.place(strand)
        advantage = seen.p[f"line{i}"].advantage
        K += advantage * to_anchor @ to_anchor.T / ca.norm_2(to_anchor) ** 3
    return ca.solve(K, weight)


def line_stretches(seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Any:
    """Return by how much each line is longer under the weights (n_lines, 1), times EA: N m."""
    assert isinstance(mechanism, Cable)
    mass = e["mass"].platform + at["payload"]
    sag = compute_sag(seen, mechanism, mass * mechanism.place(ca.DM(mechanism.gravity)))
    strands = [mechanism.place(strand) for strand in find_strands(seen, mechanism)]
    return ca.vertcat(*[-ca.dot(to, sag) / ca.norm_2(to) for to in strands])


def find_strands(seen: Seen, mechanism: Cable | HangingSled) -> list[Any]:
    """Return the vectors in {B}, (3, 1) m, from the end of each line to its anchor."""
    return mechanism.strands(seen.r, seen.R, seen.p)


def find_up(mechanism: Mechanism) -> Any:
    """Return the unit vector (3, 1) in {B} against gravity."""
    down = np.array(mechanism.gravity, dtype=float)
    return ca.DM(-down / np.linalg.norm(down))


def find_tensions(
    seen: Seen, mechanism: Cable | HangingSled, pretension: Any, weight: Any
) -> list[Any]:
    """Return the tension of each line: W t = weight up, nearest to `pretension` in every line.

    t = pretension (1 - W^+ W 1) + W^+ weight up, with the unit vectors from {P} to the anchors as
    columns of W; in the unit of `pretension` and `weight`.
    """
    strands = find_strands(seen, mechanism)
    W = ca.horzcat(*[mechanism.place(s) / ca.norm_2(s) for s in strands])
    wanted = weight * mechanism.place(find_up(mechanism))
    if not has_redundant_lines(mechanism):
        return ca.vertsplit(ca.solve(W, wanted))
    missing = wanted - pretension * ca.sum2(W)
    return ca.vertsplit(pretension + W.T @ ca.solve(W @ W.T, missing))


def find_wound_struts(mechanism: Mechanism) -> list[int]:
    """Return the numbers of the joints whose reading is the length of a strut that is a line: a
    spool lets out line as the reading grows. (A spool that winds line in pushes a rigid strut.)"""
    p = Named(mechanism.parameters.names, ca.DM(mechanism.parameters.nominal))
    r, R = find_home(mechanism)
    spools = [mechanism.spool(i, p) for i in range(len(mechanism.struts(r, R, p)))]
    return [i for i, spool in enumerate(spools) if spool is not None and spool.turn > 0]


def shift_lines(
    seen: Seen,
    mechanism: Mechanism,
    excess: Callable[[Seen], list[Any]],
    since_home: bool = True,
) -> Seen:
    """Return the readings that let out straight, rigid lines to the same end point.

    `excess` returns by how much the free line at the reading exceeds the distance from the end
    point to the anchor (m), for each joint. With `since_home` it counts from where readings are
    zero. The reading of a strut is its length.
    """
    more = excess(seen)
    if since_home:
        there = find_home(mechanism)
        more = [m - m0 for m, m0 in zip(more, excess(seen.with_pose(*there)), strict=True)]
    if isinstance(mechanism, LINES):
        more = [m / mechanism.per_reading(seen.p, i) for i, m in enumerate(more)]
    return seen.with_q(seen.q - ca.vertcat(*more))


def find_home(mechanism: Mechanism) -> tuple[Any, Any]:
    """Return position (3, 1) m and rotation (3, 3) of {P} at home."""
    home = mechanism.home
    return ca.DM(home.position), ca.DM(quaternion_to_matrix(home.quaternion))
