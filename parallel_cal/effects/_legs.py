"""Shared by laws on the inclination of legs, lines and rods: which mechanisms have them, and it."""

from __future__ import annotations

from typing import Any

import casadi as ca

from parallel_cal.effects._lines import find_up, needs_lines
from parallel_cal.effects._statics import rods
from parallel_cal.effects._struts import needs_struts
from parallel_cal.model.effect import Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named


def needs_legs(mechanism: Mechanism) -> str:
    """Return why there is no inclination of legs, lines or rods; empty if there is."""
    names, _ = rods(mechanism)
    if mechanism.passive:
        return "bodies on passive joints carry its platform, not legs, lines or rods alone"
    if names:
        shared = len(names) < len(mechanism.joints)
        return "its rods share one length" if shared else ""
    if not needs_struts(mechanism) or not needs_lines(mechanism):
        return ""
    return "it has no legs, lines or rods"


def leg_inclinations(seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Any:
    """Return the sine of the angle between each rod and the horizontal (n, 1), or each leg or line
    if there are no rods; positive if the end at the platform is the higher one.

    It is the vertical part of the unit vector dl/dr = -(dphi/dl)^-1 dphi/dr, with the closure
    phi(l, r) = 0 and the lengths l.
    """
    names, by_parameter = rods(mechanism)
    given = ca.vertcat(*[seen.p[name] for name in names]) if names else seen.q
    u, r = ca.SX.sym("u", given.numel()), ca.SX.sym("r", 3)
    free = seen.with_p(dict(zip(names, ca.vertsplit(u), strict=True))) if names else seen.with_q(u)
    moved = free.with_pose(r, free.R)
    phi = ca.vertcat(mechanism.closure(moved.q, moved.r, moved.R, moved.p))
    slopes = [ca.jacobian(phi, x) for x in (u, r)]
    by_u, by_r = ca.substitute(slopes, [u, r], [given, seen.r])
    along = -ca.solve(by_u, by_r)
    if names:
        along = ca.DM(by_parameter) @ along
    return along @ find_up(mechanism) / ca.sqrt(ca.sum2(along**2))
