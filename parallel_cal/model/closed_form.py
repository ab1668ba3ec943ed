"""Closed forms of chapter 6, with coefficients derived from the closure itself.

If a closure row is a squared length in the unknown position, or in one joint angle, its
coefficients follow from evaluating it. So no model is written twice.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import casadi as ca

from parallel_cal.model.parameters import Named

if TYPE_CHECKING:
    from parallel_cal.model.mechanism import Mechanism


def positions(mechanism: Mechanism, q: Any, p: Named, R: Any = None) -> tuple[Any, Any]:
    """Find both solutions of the general position problem (eqs 6.1-6.6); NaN if none is real.

    The first three closure rows are spheres: c (P.P + V.P + H) with a constant c.
    """
    r = ca.SX.sym("r", 3)
    R = ca.DM.eye(3) if R is None else R
    rows = mechanism.closure(q, r, R, p)[:3]
    gradient = ca.jacobian(rows, r)
    scale = ca.jacobian(gradient[:, 0], r[0]) / 2
    V = _at_zero(gradient, r) / ca.repmat(scale, 1, 3)
    H = _at_zero(rows, r) / scale
    centres = [(-V[i, :] / 2).T for i in range(3)]
    squares = [ca.dot(c, c) - H[i] for i, c in enumerate(centres)]
    return three_spheres(centres, squares)


def two_circles(centres: Sequence[Any], squares: Sequence[Any]) -> tuple[Any, Any]:
    """Intersect two circles of given centres (2, 1) and squared radii in two points, the one to the
    left of the way from the first centre to the second first."""
    away = centres[1] - centres[0]
    square = ca.sumsqr(away)
    along = (square + squares[0] - squares[1]) / (2 * square)
    up = ca.sqrt(squares[0] / square - along**2)
    aside = ca.vertcat(-away[1], away[0])
    foot = centres[0] + along * away
    return foot + up * aside, foot - up * aside


def three_spheres(centres: Sequence[Any], squares: Sequence[Any]) -> tuple[Any, Any]:
    """Intersect three spheres of given centres and squared radii in two points.

    Eq. 6.2 solves for x and y as functions of z and fails if the centres are in a vertical plane.
    This function solves along the normal of the centres' plane instead, which has no such case.
    (The printed root of eq. 6.4 has +4LQ; with eq. 6.5's Q it must be -4LQ.)
    """
    a, b = centres[1] - centres[0], centres[2] - centres[0]
    n = ca.cross(a, b)
    u = (squares[0] - squares[1] + ca.dot(a, a)) / 2
    v = (squares[0] - squares[2] + ca.dot(b, b)) / 2
    foot = (u * ca.cross(b, n) + v * ca.cross(n, a)) / ca.dot(n, n)
    height = ca.sqrt((squares[0] - ca.dot(foot, foot)) / ca.dot(n, n))
    return centres[0] + foot + height * n, centres[0] + foot - height * n


def joint_angles(mechanism: Mechanism, r: Any, R: Any, p: Named) -> list[tuple[Any, ...]]:
    """Find both angles of every joint by eqs 6.23-6.24; NaN if none is real.

    Row i must depend on joint i alone, as k0 + ka cos q + kb sin q. Its values at three angles give
    the coefficients.
    """
    n = len(mechanism.joints)

    def rows(angle: float) -> Any:
        return mechanism.closure(ca.DM.ones(n) * angle, r, R, p)[:n]

    zero, quarter, half = rows(0.0), rows(ca.pi / 2), rows(ca.pi)
    constant = (zero + half) / 2
    a, b, c = (zero - half) / 2, quarter - constant, -constant
    # Both solutions of a cos q + b sin q = c (eq. 6.24)
    s = ca.sqrt(a**2 + b**2 - c**2)
    one, other = ca.atan2(b * c + a * s, a * c - b * s), ca.atan2(b * c - a * s, a * c + b * s)
    return [(one[i], other[i]) for i in range(n)]


def _at_zero(expression: Any, symbol: Any) -> Any:
    return ca.substitute(expression, symbol, ca.DM.zeros(symbol.shape))
