"""What the effects on joint readings share: which joints they touch, and how."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

import casadi as ca

from parallel_cal.model.effect import Seen
from parallel_cal.model.mechanism import Mechanism

WAVE = {"sin": "sine part", "cos": "cosine part"}  # of an error that comes round: its labels


def turning(mechanism: Mechanism) -> list[str]:
    """The joints that turn: whatever comes round once a turn can only be theirs."""
    joints = zip(mechanism.joints, mechanism.joint_units, strict=True)
    return [joint for joint, unit in joints if unit == "rad"]


def needs_turning(mechanism: Mechanism) -> str:
    """What `Effect.applies` answers for an effect of joints that turn."""
    return "" if turning(mechanism) else "no joint turns"


def shifted(
    seen: Seen, mechanism: Mechanism, joints: Collection[str], error: Callable[[str, Any], Any]
) -> Seen:
    """q + error(joint, q) for the joints named, the others as they are read."""
    rows = [
        seen.q[i] + error(joint, seen.q[i]) if joint in joints else seen.q[i]
        for i, joint in enumerate(mechanism.joints)
    ]
    return seen.with_q(ca.vertcat(*rows))
