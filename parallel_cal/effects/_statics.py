"""Static loads: the forces of weights on joints and rods, by virtual work on the closure."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.model.effect import Seen
from parallel_cal.model.mechanism import POSE, Home, Mechanism
from parallel_cal.model.parameters import Named, Parameter, ParameterTable

PAYLOAD = "payload"
JOINTS, RODS = 1, 2  # results of `_slopes`: what the weights act on
# Of a drive, by the unit of its joint: unit of the compliance, tolerance, and upper bound.
COMPLIANCE = {"rad": ("rad/(N m)", 1e-3, 1e-2), "m": ("m/N", 1e-6, 1e-5)}
MIN_WEIGHT_FORCE = 1e-6  # Nm or N, under 1 kg; a joint below it carries no weight


def masses(mechanism: Mechanism) -> list[Parameter]:
    """Return the known masses besides the payload (kg): the platform, and one part of each kind."""
    kinds = ("platform", *mechanism.parts)
    return [
        Parameter(f"mass.{k}", "kg", mechanism.masses.get(k, 0.0), 100.0, low=0.0, high=1000.0)
        for k in kinds
    ]


def compliances(mechanism: Mechanism, joints: Sequence[str]) -> list[Parameter]:
    """Return the compliances of the drives of some joints."""
    units = dict(zip(mechanism.joints, mechanism.joint_units, strict=True))
    sizes = [(joint, *COMPLIANCE[units[joint]]) for joint in joints]
    return [
        Parameter(f"{joint}.compliance", unit, 0.0, tolerance, low=0.0, high=most)
        for joint, unit, tolerance, most in sizes
    ]


def twist(seen: Seen, e: Named, forces: Any, mechanism: Mechanism) -> Seen:
    """Return the inputs with every reading changed by the compliance of its drive times the force
    on it (n_joints, 1), Nm or N."""
    twists = [
        e.get(f"{joint}.compliance", 0) * forces[i] for i, joint in enumerate(mechanism.joints)
    ]
    return seen.with_q(seen.q + ca.vertcat(*twists))


def joint_forces(seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Any:
    """Return the force of the weights on each joint along its reading (n_joints, 1), Nm or N."""
    return _forces(JOINTS, seen, e, at, mechanism)


def link_forces(seen: Seen, tool: Any, mechanism: Mechanism) -> Any:
    """Return the force on each joint (n_joints, 1), Nm or N, of the known masses of the links, and
    of a tool (kg) at the origin of {P}."""
    known = masses(mechanism)
    e = Named([kind.name for kind in known], ca.vertcat(*[kind.nominal for kind in known]))
    return joint_forces(seen, e, Named([PAYLOAD], ca.SX(tool)), mechanism)


def own_weight_torques(seen: Seen, mechanism: Mechanism, tool: Any = 0.0) -> Any:
    """Return the torque of the links' weight on each joint of a chain along its reading, divided by
    the weight of a metre of link (n_joints, 1): m^2.

    All links weigh the same per metre. The tool, at the end of the last link, weighs as much as
    `tool` (m) of link. The joints alone carry the weights, so their torques are the derivatives of
    the work of gravity.
    """
    q, down = ca.SX.sym("q", len(mechanism.joints)), ca.DM(mechanism.gravity)
    spans = mechanism.spans(q, seen.p)
    moment = sum((length * (foot + head) / 2 for length, foot, head in spans), ca.SX.zeros(3))
    if spans:
        moment += tool * spans[-1][2]
    work = ca.dot(down / ca.norm_2(down), moment)
    return ca.substitute(ca.jacobian(work, q).T, q, seen.q)


def rod_forces(seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Any:
    """Return the tension of each rod under the weights (n_rods, 1), N; compression is negative."""
    return np.linalg.pinv(rods(mechanism)[1]).T @ _forces(RODS, seen, e, at, mechanism)


def lengthen_rods(seen: Seen, mechanism: Mechanism, by: Any) -> Seen:
    """Return the inputs with every rod longer by (n_rods, 1) m, as far as its parameters allow."""
    names, by_length = rods(mechanism)
    changes = ca.vertsplit(np.linalg.pinv(by_length) @ by)
    return seen.with_p({k: seen.p[k] + d for k, d in zip(names, changes, strict=True)})


@lru_cache(maxsize=64)
def rods(mechanism: Mechanism) -> tuple[list[str], np.ndarray]:
    """Return the parameters that determine the rods' lengths, and d length / d parameter."""
    names = mechanism.parameters.names
    p = ca.SX.sym("p", len(names))
    lengths = ca.vertcat(ca.SX(0, 1), *mechanism.rod_lengths(Named(names, p)))
    by_length = np.array(ca.DM(ca.jacobian(lengths, p)))
    used = np.flatnonzero(by_length.any(axis=0))
    return [names[i] for i in used], by_length[:, used]


def find_loaded_joints(mechanism: Mechanism) -> list[str]:
    """Return the joints that carry weight of the payload."""
    loads = zip(mechanism.joints, estimate_joint_loads(mechanism), strict=True)
    return [joint for joint, load in loads if abs(load) > MIN_WEIGHT_FORCE]


def estimate_joint_loads(mechanism: Mechanism) -> tuple[float, ...]:
    """Return the load of a payload of 1 kg on each joint (Nm or N) of the nominal robot, a little
    away from home."""
    m = mechanism
    kinds = len(masses(m))
    return _estimate_loads(m, m.gravity, m.home, m.parameters, (*[0.0] * kinds, 1.0))


def find_joints_loaded_by_links(mechanism: Mechanism) -> list[str]:
    """Return the joints that carry weight of links with a known mass, if statics determines it."""
    m, known = mechanism, tuple(kind.nominal for kind in masses(mechanism))
    if not any(known) or len(m.joints) > len(m.moves):
        return []
    loads = _estimate_loads(m, m.gravity, m.home, m.parameters, (*known, 0.0))
    return [j for j, load in zip(m.joints, loads, strict=True) if abs(load) > MIN_WEIGHT_FORCE]


def find_self_loaded_joints(mechanism: Mechanism) -> list[str]:
    """Return the revolute joints of a chain that carry weight of its own links."""
    m = mechanism
    loads = _estimate_own_loads(m, m.gravity, m.home, m.parameters)
    joints = zip(m.joints, m.joint_units, loads, strict=True)
    return [joint for joint, unit, load in joints if unit == "rad" and load > MIN_WEIGHT_FORCE]


def needs_weight(mechanism: Mechanism) -> str:
    """Return why an effect of the payload's weight does not apply; empty if it does."""
    if len(mechanism.joints) > len(mechanism.moves):
        return (
            "it has more joints than degrees of freedom: statics alone does not determine the "
            "joint forces"
        )
    return "" if find_loaded_joints(mechanism) else "no joint carries any of the payload's weight"


def needs_rods(mechanism: Mechanism) -> str:
    """Return why an effect on rods between joints and platform does not apply; empty if it does."""
    return needs_weight(mechanism) or (
        "" if rods(mechanism)[0] else "it has no rods in addition to its joints"
    )


@lru_cache(maxsize=64)
def _estimate_loads(
    mechanism: Mechanism,
    gravity: tuple[float, ...],
    home: Home,
    table: ParameterTable,
    weights: tuple[float, ...],
) -> tuple[float, ...]:
    """Apply weights (kg), of each kind of mass and of a payload, to the nominal robot a little away
    from home.

    What a model file sets is passed as an argument, so that the cache stays valid.
    """
    n, p = len(home.joints), _nominal(table)
    *known, payload = weights
    q = ca.SX(home.joints + mechanism.length * np.arange(1, n + 1) / (10 * n))
    r, R = mechanism.start(q, p)
    e = Named([kind.name for kind in masses(mechanism)], ca.SX(known))
    at = Named([PAYLOAD], ca.SX(payload))
    seen = Seen(q, ca.SX(r), ca.SX(R), p, ca.SX(home.passive))
    forces = ca.DM(joint_forces(seen, e, at, mechanism))
    return tuple(float(forces[i]) for i in range(n))


@lru_cache(maxsize=64)
def _estimate_own_loads(
    mechanism: Mechanism, gravity: tuple[float, ...], home: Home, table: ParameterTable
) -> tuple[float, ...]:
    """Return the largest torque on each joint, as of `own_weight_torques`, at some poses.

    The arguments keep the cache valid, as in `_estimate_loads`.
    """
    q, p = ca.SX.sym("q", len(home.joints)), _nominal(table)
    torques = own_weight_torques(Seen(q, ca.SX(home.position), ca.SX.eye(3), p), mechanism)
    evaluate = ca.Function("torques", [q], [torques])
    around = np.random.default_rng(0).uniform(-1.0, 1.0, (20, len(home.joints)))
    found = [np.array(evaluate(home.joints + turned)).ravel() for turned in around]
    return tuple(np.abs(found).max(axis=0).tolist())


def _nominal(table: ParameterTable) -> Named:
    return Named(table.names, ca.SX(table.nominal))


def _forces(u: int, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Any:
    """Return dU/du - (dphi/du)^T lambda with (dphi/dx)^T lambda = dU/dx; u: JOINTS or RODS, x: the
    platform and passive coordinates.

    U is the work of gravity on payload, platform and parts, J. Platform and passive coordinates
    follow u so that phi stays zero.
    """
    loads = [e["mass"][kind] for kind in ("platform", *mechanism.parts)]
    slopes = _slopes(mechanism, mechanism.gravity)
    loads = ca.vertcat(*loads, at[PAYLOAD])
    found = slopes(seen.q, seen.r, seen.R, seen.u, seen.p.column, loads)
    by_x, by_u = found[0], found[u]
    multipliers = ca.solve(by_x[:-1, :].T, by_x[-1, :].T)
    return by_u[-1, :].T - by_u[:-1, :].T @ multipliers


@lru_cache(maxsize=64)
def _slopes(mechanism: Mechanism, gravity: tuple[float, ...]) -> ca.Function:
    """Build the derivatives of (phi, U) by the moved part of the pose (x, w) and the passive
    coordinates, by the joints and by the parameters of the rods.

    They are functions of (q, r, R, u, geometry, masses), which all effects of a mechanism share.
    """
    names = mechanism.parameters.names
    q, r, R = ca.SX.sym("q", len(mechanism.joints)), ca.SX.sym("r", 3), ca.SX.sym("R", 3, 3)
    p, x = ca.SX.sym("p", len(names)), ca.SX.sym("x", len(POSE))
    u = ca.SX.sym("u", len(mechanism.passive))
    platform, *parts, payload = masses = ca.vertsplit(ca.SX.sym("m", len(mechanism.parts) + 2))
    position = r + x[:3]
    pose = mechanism.arguments(q, u, position, R + ca.skew(x[3:]) @ R, Named(names, p))
    phi, centres = ca.vertcat(mechanism.closure(*pose)), mechanism.centres(*pose)
    mass = dict(zip(mechanism.parts, parts, strict=True))
    moments = [mass[kind] * point for kind, points in centres.items() for point in points]
    # The weights of payload and platform act at {P}.
    moment = sum(moments, (platform + payload) * position)
    rows = ca.vertcat(phi, ca.dot(ca.DM(gravity), moment))
    of_rods = [p[names.index(name)] for name in rods(mechanism)[0]]
    dependent = ca.vertcat(x[mechanism.moved], u)
    by = ca.vertcat(dependent, q, *of_rods)
    slopes = ca.horzsplit(
        ca.jacobian(rows, by),
        np.cumsum([0, dependent.numel(), q.numel(), len(of_rods)]).tolist(),
    )
    slopes = ca.cse(ca.substitute(slopes, [x], [ca.SX.zeros(len(POSE))]))
    return ca.Function("slopes", [q, r, R, u, p, ca.vertcat(*masses)], slopes)
