"""Static loads: the forces of weights on joints and rods, by virtual work on the closure."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from parallel_cal.model.effect import Seen
from parallel_cal.model.mechanism import POSE, Home, Mechanism
from parallel_cal.model.parameters import Named, Parameter, ParameterTable

PAYLOAD = "payload"
MIN_WEIGHT_FORCE = 1e-6  # Nm or N, under 1 kg; a joint below it carries no weight


def masses(mechanism: Mechanism) -> list[Parameter]:
    """Return the known masses besides the payload (kg): the platform, and one part of each kind."""
    kinds = ("platform", *mechanism.parts)
    return [Parameter(f"mass.{kind}", "kg", 0.0, 100.0, low=0.0, high=1000.0) for kind in kinds]


def joint_forces(seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Any:
    """Return the force of the weights on each joint along its reading (n_joints, 1), Nm or N."""
    q = ca.SX.sym("q", len(mechanism.joints))
    return _forces(seen.with_q(q), q, seen.q, e, at, mechanism)


def rod_forces(seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Any:
    """Return the tension of each rod under the weights (n_rods, 1), N; compression is negative."""
    names, by_length = rods(mechanism)
    lengths = ca.SX.sym("l", len(names))
    loose = seen.with_p(dict(zip(names, ca.vertsplit(lengths), strict=True)))
    given = ca.vertcat(*[seen.p[name] for name in names])
    return np.linalg.pinv(by_length).T @ _forces(loose, lengths, given, e, at, mechanism)


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
    return _estimate_loads(m, m.gravity, m.home, m.parameters)


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
    mechanism: Mechanism, gravity: tuple[float, ...], home: Home, table: ParameterTable
) -> tuple[float, ...]:
    """Apply 1 kg to the nominal robot a little away from home.

    What a model file sets is passed as an argument, so that the cache stays valid.
    """
    n, kinds, p = len(home.joints), masses(mechanism), Named(table.names, ca.SX(table.nominal))
    q = ca.SX(home.joints + mechanism.length * np.arange(1, n + 1) / (10 * n))
    r, R = mechanism.start(q, p)
    e = Named([kind.name for kind in kinds], ca.SX.zeros(len(kinds)))
    at = Named([PAYLOAD], ca.SX(1))
    forces = ca.DM(joint_forces(Seen(q, ca.SX(r), ca.SX(R), p), e, at, mechanism))
    return tuple(float(forces[i]) for i in range(n))


def _forces(loose: Seen, u: Any, given: Any, e: Named, at: Named, mechanism: Mechanism) -> Any:
    """Return dU/du - (dphi/du)^T lambda with (dphi/dx)^T lambda = dU/dx, at u = given.

    U is the work of gravity on payload, platform and parts, J. The platform follows u so that phi
    stays zero.
    """
    x, free = ca.SX.sym("x", len(POSE)), mechanism.moved
    turned = loose.R + ca.skew(x[3:]) @ loose.R
    pose = loose.with_pose(loose.r + x[:3], turned)
    phi = ca.vertcat(mechanism.closure(pose.q, pose.r, pose.R, pose.p))
    # The weights of payload and platform act at {P}.
    mass, centres = e["mass"], mechanism.centres(pose.q, pose.r, pose.R, pose.p)
    moments = [mass[kind] * point for kind, points in centres.items() for point in points]
    moment = sum(moments, (mass.platform + at[PAYLOAD]) * pose.r)
    rows = ca.vertcat(phi, ca.dot(ca.DM(mechanism.gravity), moment))
    slopes = [ca.jacobian(rows, x)[:, free], ca.jacobian(rows, u)]
    by_x, by_u = ca.substitute(slopes, [x, u], [ca.SX.zeros(len(POSE)), given])
    multipliers = ca.solve(by_x[:-1, :].T, by_x[-1, :].T)
    return by_u[-1, :].T - by_u[:-1, :].T @ multipliers
