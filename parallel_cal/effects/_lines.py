"""Elastic lines: how far each line stretches under the payload."""

from __future__ import annotations

from typing import Any

import casadi as ca

from parallel_cal.mechanisms.cable import Cable
from parallel_cal.model.effect import Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named


def needs_lines(mechanism: Mechanism) -> str:
    """Return why an effect of elastic lines does not apply; empty if it does."""
    if not isinstance(mechanism, Cable):
        return "no line holds the platform"
    falls = any(mechanism.gravity[i] for i in mechanism.moved)
    return "" if falls else "the platform does not move along gravity"


def compute_sag(seen: Seen, mechanism: Cable, weight: Any) -> Any:
    """Return the displacement of the platform by a weight (N), in the coordinates that move, times
    the stiffness EA (N) of the lines, which is the same for all."""
    n = len(mechanism.moves)
    K = ca.SX.zeros(n, n)
    for i, to_anchor in enumerate(_directions(seen, mechanism), start=1):
        advantage = seen.p[f"line{i}"].advantage
        K += advantage * to_anchor @ to_anchor.T / ca.norm_2(to_anchor) ** 3
    return ca.solve(K, weight)


def line_stretches(seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Any:
    """Return by how much each line is longer under the weights (n_lines, 1), times EA: N m."""
    assert isinstance(mechanism, Cable)
    mass = e["mass"].platform + at["payload"]
    sag = compute_sag(seen, mechanism, mass * mechanism.place(ca.DM(mechanism.gravity)))
    return ca.vertcat(*[-ca.dot(to, sag) / ca.norm_2(to) for to in _directions(seen, mechanism)])


def _directions(seen: Seen, mechanism: Cable) -> list[Any]:
    """From the platform to the anchor of each line, m."""
    return [anchor - mechanism.place(seen.r) for anchor in mechanism.anchors(seen.p)]
