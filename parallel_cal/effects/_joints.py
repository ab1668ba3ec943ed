"""Shared by effects on joint readings: which joints they change, and how."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from parallel_cal.mechanisms.cable import Cable
from parallel_cal.model.drive import Drive
from parallel_cal.model.effect import Effect, Seen
from parallel_cal.model.mechanism import Mechanism
from parallel_cal.model.parameters import Named, Parameter

SMOOTH = "a smooth error of the joint's angle"  # family of effects that are waves or powers of it
WAVE = {"sin": "sine part", "cos": "cosine part"}  # labels of a periodic error


def find_revolute_joints(mechanism: Mechanism) -> list[str]:
    """Return the revolute joints: only they can have an error that repeats once per turn."""
    joints = zip(mechanism.joints, mechanism.joint_units, strict=True)
    return [joint for joint, unit in joints if unit == "rad"]


def find_prismatic_joints(mechanism: Mechanism) -> list[str]:
    """Return the prismatic joints, whatever drives them."""
    joints = zip(mechanism.joints, mechanism.joint_units, strict=True)
    return [joint for joint, unit in joints if unit == "m"]


def find_drives(mechanism: Mechanism) -> dict[str, Drive | None]:
    """Return the prismatic joints with their stated drives, except lines without one: they wind
    onto a spool of unknown size."""
    drives = mechanism.drives or (None,) * len(mechanism.joints)
    stated = dict(zip(mechanism.joints, drives, strict=True))
    joints = find_prismatic_joints(mechanism)
    by_default = not isinstance(mechanism, Cable)
    return {joint: stated[joint] for joint in joints if stated[joint] or by_default}


def scan_periods(travel: float, short: float, long: float) -> Iterator[float]:
    """Yield periods (m) whose reciprocals are 1 / (2 travel) apart: half a peak's width."""
    low, high = 1 / long, 1 / short
    for waves in np.arange(low, high, 1 / (2 * max(travel, 0.5 / (high - low)))):
        yield float(1 / waves)


def explain_how_to_state_spool(mechanism: Mechanism) -> str:
    """Return how to state the spool of a joint in m without a stated drive; empty if all such
    joints have one."""
    drives = mechanism.drives or (None,) * len(mechanism.joints)
    joints = zip(mechanism.joints, mechanism.joint_units, drives, strict=True)
    for joint, unit, drive in joints:
        if unit == "m" and drive is None:
            stated = f"{joint}: {{..., drive: {{kind: spool, radius: 0.05}}}}"
            return f"If a spool moves the joint, state it in the model file: {stated}"
    return ""


def needs_turning(mechanism: Mechanism) -> str:
    """Return why an effect of revolute joints does not apply; empty if it does."""
    return "" if find_revolute_joints(mechanism) else "it has no revolute joint"


def sizes(
    mechanism: Mechanism, size: Mapping[str, tuple[float, ...]]
) -> list[tuple[str, str, tuple[float, ...]]]:
    """Return joint, unit and size of an error for each joint; `size` gives the sizes by unit.

    If a joint winds a line (behind a gear, on a spool), the size is that of the line in metres.
    """
    joints = list(zip(mechanism.joints, mechanism.joint_units, strict=True))
    if not mechanism.winds:
        return [(joint, unit, size[unit]) for joint, unit in joints]
    lines = zip(joints, mechanism.winds, strict=True)
    return [(joint, unit, tuple(s / metres for s in size["m"])) for (joint, unit), metres in lines]


def shift_joints(
    seen: Seen, mechanism: Mechanism, joints: Collection[str], error: Callable[[str, Any], Any]
) -> Seen:
    """Return q + error(joint, q) for the named joints; the others keep their reading."""
    rows = [
        seen.q[i] + error(joint, seen.q[i]) if joint in joints else seen.q[i]
        for i, joint in enumerate(mechanism.joints)
    ]
    return seen.with_q(ca.vertcat(*rows))


def wave(own: Named, number: str, angle: Any) -> Any:
    """Return sin * sin(angle) + cos * cos(angle) with the amplitudes of one joint; `number` is the
    ending of their names, and empty if the joint has one wave."""
    return own[f"sin{number}"] * ca.sin(angle) + own[f"cos{number}"] * ca.cos(angle)


def constant_of(e: Named, joint: str, name: str) -> Any:
    """Return a constant of a joint: its own, or the common one where its own is 0."""
    own, common = e[joint].get(name, 0), e.get(name, None)
    return own if common is None else ca.if_else(own == 0, common, own)


def make_own_constants(joints: Collection[str], common: Parameter) -> list[Parameter]:
    """Return a constant that all joints share, and those that each of several may have of its
    own."""
    if len(joints) < 2:
        return [common]
    own = replace(common, nominal=0.0, low=0.0, label=f"own {common.label}")
    return [common, *(replace(own, name=f"{joint}.{common.name}") for joint in joints)]


def make_waves(
    joint: str, unit: str, size: float, highest: float, waves: Mapping[str, str]
) -> list[Parameter]:
    """Return the amplitudes of the waves of a joint's error, for `wave`.

    The keys of `waves` are the endings of their names, the values complete their labels."""
    return [
        Parameter(
            f"{joint}.{part}{ending}",
            unit,
            0.0,
            size,
            low=-highest,
            high=highest,
            label=f"{label}{words}",
        )
        for ending, words in waves.items()
        for part, label in WAVE.items()
    ]


def make_harmonics(
    joint: str, unit: str, size: float, highest: float, waves: Sequence[str]
) -> list[Parameter]:
    """Return the amplitudes of the harmonics of a joint's error, for `wave`: 1, 2 and so on, with
    labels that `waves` complete.

    They usually fall with their order. Otherwise a wave would as likely be the second harmonic of
    half of its ratio, without the first.
    """
    return [
        amplitude
        for order, words in enumerate(waves, 1)
        for amplitude in make_waves(joint, unit, size / order, highest, {str(order): words})
    ]


class Harmonic(Effect):
    """q_ideal = q + sin * sin(k q) + cos * cos(k q) for every revolute joint; k is its `order`."""

    separated_by = "poses over the whole range of every joint"
    family = SMOOTH
    order: ClassVar[int]
    tolerance: ClassVar[float]  # rad; ten of it bound the error of real encoders

    def parameters(self, mechanism: Mechanism) -> list[Parameter]:
        return [
            amplitude
            for joint in find_revolute_joints(mechanism)
            for amplitude in make_waves(joint, "rad", self.tolerance, 10 * self.tolerance, {"": ""})
        ]

    def ideal(self, seen: Seen, e: Named, at: Named, mechanism: Mechanism) -> Seen:
        k = e.get("order", self.order)

        def error(joint: str, q: Any) -> Any:
            return wave(e[joint], "", k * q)

        return shift_joints(seen, mechanism, find_revolute_joints(mechanism), error)

    def applies(self, mechanism: Mechanism) -> str:
        return needs_turning(mechanism)
