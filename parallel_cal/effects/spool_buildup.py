"""Layers of line on a spool: its radius grows with the line that it holds."""

from __future__ import annotations

import casadi as ca

from parallel_cal.effects._joints import explain_how_to_state_spool
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter


class SpoolBuildup(Effect):
    """q_ideal = q - Q k q^2 / (4 R) for every joint that a spool moves, positive letting line out.

    A metre of line on the spool adds Q to its radius squared, so a spool that has turned by
    s = k q has the radius R - Q s / 2 and has let out R s - Q s^2 / 4: a spool of constant radius
    R would do so at the reading q_ideal. For the angle of a motor, k is 1 / gear. For a length,
    k is advantage / R, negative if a growing length winds line on the spool. Q (m) is the line's
    cross-section over pi times the spool's width, one number because every spool holds the same
    line on the same width.
    """

    physics = "Every layer of line makes the spool larger, so the same turn moves more line."
    remedy = "enter the spool's build-up in the firmware, or keep the correction in the model"
    source = "the Hangprinter's maker; round line has Q = d^2 / (4 width), 1 mm in 3: 0.08 mm"
    lookalikes = ("encoder_gain", "line_stretch", "pulley_radius", "line_flex", "line_sag")
    separated_by = "poses over the whole range of every line, near and far from its anchor"

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return [Parameter("Q", "m", 0.0, 0.1e-3, low=0.0, high=0.5e-3, label="build-up")]

    def applies(self, mechanism: Mechanism) -> str:
        p = Named(mechanism.parameters.names, mechanism.parameters.nominal)
        if any(mechanism.spool(i, p) for i in range(len(mechanism.joints))):
            return ""
        if "m" not in mechanism.joint_units:
            return "it has no line on a spool"
        return f"no joint states a spool. {explain_how_to_state_spool(mechanism)}".rstrip()

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        rows = []
        for i in range(len(mechanism.joints)):
            q, spool = seen.q[i], mechanism.spool(i, seen.p)
            rows.append(q - e.Q * spool.turn * q**2 / (4 * spool.radius) if spool else q)
        return seen.with_q(ca.vertcat(*rows))
