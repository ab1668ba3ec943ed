"""Where Newton's method begins: the mechanism's closed form, or the solution expanded at home."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.base.rotation import cayley
from parallel_cal.kinematics.solutions import MIN_REGULAR_SINGULAR_VALUE
from parallel_cal.model.configuration import Configuration
from parallel_cal.model.structure import Structure

MAX_HOME_RESIDUAL = 1e-6  # m, rad: beyond that, home of the drawing closes nothing
DEAD_POINT_STEP = 0.1  # rad, or a share of the length: of a motor that leaves a dead point
DRIVE_STEPS = 10
MIN_SIDE = 1e-8  # smallest scaled singular value at which home is on one side of a dead point
STEP = 1e-4  # m, rad: of the differences that give second derivatives


def unknown_columns(s: Structure, problem: str) -> list[int]:
    """Return the unknown columns of (q, r, w, u) of the "direct" or the "inverse" problem."""
    m, n = s.mechanism, len(s.mechanism.joints)
    if problem == "direct":
        return m.dependent_columns
    return [*range(n), *(n + i for i in m.parasitic), *m.passive_columns]


@lru_cache(maxsize=64)
def start_function(s: Structure, problem: str) -> ca.Function:
    """Build (configuration, geometry) -> the configuration at which iterations begin.

    The unknowns come from the candidates of an ideal mechanism `s`. If these are home whatever is
    given, they are expanded there to second order: near home little is then left to the
    iterations, and farther away they still begin on the branch of home.
    """
    m, q, r, R9, u = s.mechanism, s.q, s.r, s.R9, ca.DM(s.mechanism.home.passive)
    moved = path_home(s, problem)
    if problem == "direct":
        r, R9 = s.start_pose(s.q, s.geometry.column)
    else:
        q = s.start_joints(s.r, s.R9, s.geometry.column)
    start = ca.vertcat(q, r, R9, u)
    if (moved != np.array(m.home.configuration)).any():
        n = len(m.joints)
        start = ca.vertcat(ca.DM(moved[:n]), r, R9, ca.DM(moved[n + 12 :]))
    elif begins_at_home(s, problem):
        n = len(m.joints)
        given = [*range(n)] if problem == "direct" else [n + i for i in m.controlled]
        columns = unknown_columns(s, problem)
        if (series := _expand_at_home(s, given, columns)) is not None:
            d, turn = _change_from_home(s, problem)
            change = ca.SX.zeros(len(s.scale))
            for column, slope, curvature in zip(columns, *series, strict=True):
                change[column] = ca.dot(ca.DM(slope), d) + ca.bilin(ca.DM(curvature), d, d) / 2
            for i in {*columns} & {n + 3, n + 4, n + 5}:
                change[i] -= turn[i - n - 3]  # the given rotation is turned so far already
            R9 = start[n + 3 : n + 12]  # turned by a rotation vector in `change`
            if {n + 3, n + 4, n + 5} & {*columns}:
                R9 = ca.vec((cayley(change[n + 3 : n + 6]) @ ca.reshape(R9, 3, 3).T).T)
            start = ca.vertcat(
                start[: n + 3] + change[: n + 3], R9, start[n + 12 :] + change[n + 6 :]
            )
    return ca.Function(f"{problem}_start", [s.configuration, s.v], [start])


def _change_from_home(s: Structure, problem: str) -> tuple[Any, Any]:
    """Compute how far the given coordinates are from home, within half a turn (m, rad), and the
    turn from home of the rotation at which iterations begin (rad)."""
    m = s.mechanism
    home = Configuration.from_rows(m.home.configuration, len(m.passive))
    if problem == "direct":
        turns = m.joint_periods
        d = ca.vertsplit(s.q - ca.DM(home.q))
        nearest = [
            one - turn * ca.floor(one / turn + 0.5) if turn else one
            for one, turn in zip(d, turns, strict=True)
        ]
        return ca.vertcat(*nearest), ca.DM.zeros(3)
    E = s.R @ ca.DM(home.R).T
    turn = ca.vertcat(E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]) / 2
    return ca.vertcat(s.r - ca.DM(home.r), turn)[m.controlled], turn


@lru_cache(maxsize=64)
def begins_at_home(s: Structure, problem: str) -> bool:
    """Return whether the candidates of an ideal mechanism are home whatever is given."""
    if problem == "direct":
        found = ca.vertcat(*s.start_pose(s.q, s.geometry.column))
    else:
        found = s.start_joints(s.r, s.R9, s.geometry.column)
    return not ca.symvar(ca.SX(found))


@lru_cache(maxsize=64)
def path_home(s: Structure, problem: str) -> np.ndarray:
    """Return the configuration (nq + 12 + nu,) at which paths of an ideal mechanism begin: home.

    If home is at a dead point, two readings have the same pose near it, and `inverse` would follow
    either. Its paths begin where a motor has moved from there: to home's side of the dead point,
    or, if home is on neither side, to that where this motor has more room.
    """
    m, home = s.mechanism, np.array(s.mechanism.home.configuration)
    if problem == "direct" or not begins_at_home(s, problem):
        return home
    size, side = _regularity(s, home)
    if size > MIN_REGULAR_SINGULAR_VALUE:
        return home
    best, chosen = (False, False, 0.0), home
    for k, (low, high) in enumerate(m.joint_limits):
        for step in (1.0, -1.0):
            x = _drive(s, home, k, step * DEAD_POINT_STEP * m.length / s.scale[k])
            size, reached = _regularity(s, x)
            room = high - home[k] if step > 0 else home[k] - low
            rank = size > MIN_REGULAR_SINGULAR_VALUE, reached * side >= 0.0, room
            if rank > best:
                best, chosen = rank, x
    return chosen


def _regularity(s: Structure, x: np.ndarray) -> tuple[float, float]:
    """Return the smallest singular value of the inverse problem, and the side on which x is; 0 if
    there are no sides, or if x is on none."""
    columns = unknown_columns(s, "inverse")
    J = np.array(s.closure_configuration(x, s.neutral, s.table.nominal)[1])
    J = J[:, columns] / s.scale[columns]
    if not np.isfinite(J).all():
        return 0.0, 0.0
    size = float(np.linalg.svd(J, compute_uv=False)[-1])
    square = J.shape[0] == J.shape[1] and size > MIN_SIDE
    return size, float(np.sign(np.linalg.det(J))) if square else 0.0


def _drive(s: Structure, x: np.ndarray, joint: int, way: float) -> np.ndarray:
    """Move one joint, and close the loops after each of some small steps."""
    columns, passive = unknown_columns(s, "direct"), len(s.mechanism.passive)
    for i in range(3 * DRIVE_STEPS):
        phi, J = s.closure_configuration(x, s.neutral, s.table.nominal)
        change = np.zeros(len(s.scale))
        if i % 3 == 0:
            change[joint] = way / DRIVE_STEPS
            phi = np.array(phi).ravel() + np.array(J)[:, joint] * change[joint]
        change[columns] = -np.linalg.lstsq(np.array(J)[:, columns], np.array(phi).ravel())[0]
        x = Configuration.from_rows(x, passive).apply_change(change).rows
    return x


def _expand_at_home(
    s: Structure, given: list[int], unknown: list[int]
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return first (k, n) and second (k, n, n) derivatives of k unknowns by n given coordinates, of
    the nominal robot at home; None if home is singular or does not close, or if the rows are more
    or fewer than the unknowns."""
    home = s.mechanism.home.configuration
    at_home = Configuration.from_rows(home, len(s.mechanism.passive))
    phi, J = s.closure_configuration(home, s.neutral, s.table.nominal)
    if J.shape[0] != len(unknown) or not given:
        return None
    scaled = np.array(J)[:, unknown] / s.scale[unknown]
    if not np.isfinite(scaled).all() or np.linalg.norm(np.array(phi)) > MAX_HOME_RESIDUAL:
        return None
    if np.linalg.svd(scaled, compute_uv=False)[-1] < MIN_REGULAR_SINGULAR_VALUE:
        return None

    def slope(J: Any) -> np.ndarray:
        J = np.array(J)
        return -np.linalg.solve(J[:, unknown], J[:, given])

    first = slope(J)
    second = np.empty((*first.shape, len(given)))
    for k in range(len(given)):
        change = np.zeros(len(s.scale))
        change[given[k]], change[unknown] = STEP, STEP * first[:, k]
        ends = []
        for sign in (1, -1):
            at = at_home.apply_change(sign * change).rows
            ends.append(slope(s.closure_configuration(at, s.neutral, s.table.nominal)[1]))
        second[:, :, k] = (ends[0] - ends[1]) / (2 * STEP)
    return first, second
