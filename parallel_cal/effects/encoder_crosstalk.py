"""Joints that are not independent: a reading changes when the neighbouring joint moves."""

from __future__ import annotations

import casadi as ca

from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter

# A coupling is at most one to one; if compensated, it has the relative error of its belt's pitch.
TOLERANCE = 0.2e-3
MAX_COUPLING_ERROR = 1.6e-3
WHEEL = 0.1  # m, radius of a wheel that converts travel into an angle
# (unit of the joint, unit of its neighbour): unit of the coupling, and its scale
SIZE = {
    ("rad", "rad"): ("1", 1.0),
    ("m", "m"): ("1", 1.0),
    ("rad", "m"): ("rad/m", 1 / WHEEL),
    ("m", "rad"): ("m/rad", WHEEL),
}


class EncoderCrosstalk(Effect):
    """q_ideal_i = q_i + sum over neighbours j of by_j * q_j, neighbours in the order of the joints.

    The first joint and the last are neighbours, too. A Delta's geometry leaves a twentieth of
    it; wires that leak into one another ripple with the signal's period and are not this.
    """

    physics = (
        "Shafts that run through one another and belts that share a frame drag their neighbours."
    )
    remedy = "separate cables, belts and shafts, or keep the correction in the model"
    source = "toothed belts hold their length to 1.6e-3 at 10 inches, 1.0e-3 at 20 (ANSI/RMA IP-24)"
    lookalikes = (
        "encoder_gain",
        "encoder_eccentricity",
        "encoder_second_harmonic",
        "universal_joint_offset",
    )
    separated_by = "poses in which one joint moves over its range while its neighbours stand still"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        units = dict(zip(mechanism.joints, mechanism.joint_units, strict=True))
        sizes = [(i, j, *SIZE[units[i], units[j]]) for i, j in neighbours(mechanism)]
        return [
            Parameter(
                f"{i}.by_{j}",
                unit,
                0.0,
                TOLERANCE * by,
                low=-MAX_COUPLING_ERROR * by,
                high=MAX_COUPLING_ERROR * by,
            )
            for i, j, unit, by in sizes
        ]

    def applies(self, mechanism: Mechanism) -> str:
        return "" if len(mechanism.joints) > 1 else "it has only one joint"

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        read = dict(zip(mechanism.joints, ca.vertsplit(seen.q), strict=True))
        q = dict(read)
        for i, j in neighbours(mechanism):
            q[i] += e[i][f"by_{j}"] * read[j]
        return seen.with_q(ca.vertcat(*q.values()))


def neighbours(mechanism: Mechanism) -> list[tuple[str, str]]:
    """Return the pairs of a joint and its neighbour, each once."""
    joints = mechanism.joints
    beside = {k: (joints[k - 1], joints[(k + 1) % len(joints)]) for k in range(len(joints))}
    return list(dict.fromkeys((joints[k], j) for k, pair in beside.items() for j in pair))
