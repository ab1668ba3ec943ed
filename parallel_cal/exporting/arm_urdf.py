"""The joints of a serial arm's URDF: its own, with the identified origins and axes.

A joint turns about z of its frame, or slides along it. The zero of its encoder is in its origin, so
that its position is the reading of the robot.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from parallel_cal.base.rotation import rotation_vector
from parallel_cal.importing.chain import motion_of
from parallel_cal.kinematics.kinematics import Kinematics
from parallel_cal.mechanisms.serial import JOINT_UNITS, Link, Serial
from parallel_cal.model.effect import CONDITIONS
from parallel_cal.model.model import Model
from parallel_cal.model.parameters import Named
from parallel_cal.model.region import IdentifiedRegion

Array = np.ndarray
N_COMPARED_CONFIGURATIONS = 500
Z = np.array([0.0, 0.0, 1.0])
ROUNDING_ERROR = 1e-15  # m or rad


@dataclass(frozen=True)
class Follow:
    """The position of a joint that follows a reading: factor * reading + offset."""

    reading: str
    factor: float
    offset: float = 0.0


@dataclass(frozen=True)
class ArmJoint:
    """A joint of the URDF: R, P or None (fixed), in the frame `origin` (4, 4) of its parent."""

    name: str
    kind: str | None
    parent: str
    child: str
    origin: Array
    follows: Follow | None = None
    limits: tuple[float, float] = (-np.inf, np.inf)
    velocity: float = np.inf


def link_frames(model: Model) -> tuple[list[Array], Array]:
    """Return the frame (4, 4) in {B} of every link with a joint, whose z is the axis, and that of
    {P}, all where the positions of the joints are zero."""
    names = model.mechanism.parameters.names
    p = Named(names, ca.DM(model.values[: len(names)]))
    at, frames = np.eye(4), []
    for link in _arm(model).links:
        if link.joint:
            frames.append(at)
        turn, shift = link.transform(0, p)
        step = np.eye(4)
        step[:3, :3], step[:3, 3] = np.array(ca.DM(turn)), np.array(ca.DM(shift)).ravel()
        at = at @ step
    return frames, at


def moving_links(model: Model) -> list[tuple[Link, dict[str, float]]]:
    """Return every link with a joint, and the factors of the readings that move it, by the names of
    the model's joints."""
    arm = _arm(model)
    names = dict(zip((link.name for link in arm.driven), model.joints, strict=True))
    return [
        (
            link,
            {
                names[other]: own if other == link.name else model.value(f"{link.name}.by_{other}")
                for other, own in link.driven_by.items()
            },
        )
        for link in arm.links
        if link.joint
    ]


def arm_joints(model: Model) -> list[ArmJoint]:
    """Return the joints of an arm's URDF from its base to its platform, and joints off this chain
    that stand for readings whose factor is not 1."""
    frames, tip = link_frames(model)
    base, platform = (model.frames[name] for name in ("base", "platform"))
    at, parent, chain, beside = np.eye(4), base, list[ArmJoint](), list[ArmJoint]()
    for (link, factors), frame in zip(moving_links(model), frames, strict=True):
        origin, offset = np.linalg.solve(at, frame), link.offset
        own = model.joints[_arm(model).driven.index(link)] if link.has_reading else ""
        if own and (factors[own] != 1 or link.reading != JOINT_UNITS[link.joint or ""]):
            kind = "P" if link.reading == "m" else "R"
            beside.append(_own_joint(model, own, kind, base, np.eye(4)))
            own = ""
        if own or len(factors) > 1:  # of several joints on one axis, or one that has no mimic
            origin, offset = origin @ motion_of(link.joint, Z, offset), 0.0
        for reading, factor in factors.items():
            if reading == own:
                joint = _own_joint(model, own, link.joint, parent, origin)
            else:
                only = len(factors) == 1
                name = f"{link.name}_joint" if only else f"{link.name}_by_{reading}"
                follows = Follow(reading, factor, offset)
                limits = link.limits if only else (-np.inf, np.inf)
                joint = ArmJoint(name, link.joint, parent, f"{name}_link", origin, follows, limits)
            chain.append(joint)
            parent, origin = joint.child, np.eye(4)
        at = frame
    last = ArmJoint(f"{platform}_fixed", None, parent, platform, np.linalg.solve(at, tip))
    return [*beside, *chain, last]


def _own_joint(model: Model, name: str, kind: str | None, parent: str, origin: Array) -> ArmJoint:
    """Return the joint whose position is a reading of the model."""
    i, m = model.joints.index(name), model.mechanism
    rate = m.joint_rates[i][0] if m.joint_rates else np.inf
    child = f"{name}_link"
    return ArmJoint(name, kind, parent, child, origin, None, m.joint_limits[i], rate)


def _arm(model: Model) -> Serial:
    mechanism = model.mechanism
    assert isinstance(mechanism, Serial)
    return mechanism


# ------------------------------------------------------------------ what a URDF cannot represent


def describe_losses(model: Model) -> list[str]:
    """Say which effects a URDF cannot represent, and how far each moves the platform.

    The configurations are drawn from the joint ranges of the samples of the last fit, otherwise
    from the joint limits.
    """
    if not model.effects:
        return []
    region = IdentifiedRegion.of_model(model)
    measured = region is not None and set(region.joints) == set(model.joints)
    ranges = [region.joints[name] for name in model.joints] if region and measured else []
    low, high = np.clip(ranges or model.mechanism.joint_limits, -np.pi, np.pi).T
    rng = np.random.default_rng(0)
    q = rng.uniform(low, high, (N_COMPARED_CONFIGURATIONS, len(model.joints)))
    at = {name: _draw(name, len(q), rng) for name in model.conditions}
    whole, said = _direct(model, q, at), []
    for effect in model.effects:
        moved = _measure(whole, _direct(model.without_effect(effect.name), q, at))
        said.append(f"{effect.name} up to {moved}")
    every = _measure(whole, _direct(model.with_effects(()), q, at))
    total = f"; together up to {every}" if len(said) > 1 else ""
    where = "joint ranges of the samples" if measured else "joint limits"
    return [
        f"not in the URDF, which holds geometry only: {', '.join(said)}{total} (at "
        f"{len(q)} configurations within the {where})"
    ]


def _draw(condition: str, n: int, rng: np.random.Generator) -> Array:
    """Draw a condition: either side of a backlash, its neutral value for all others."""
    kind = condition.split(".")[0]
    if kind in ("direction", "travel"):
        return rng.choice([-1.0, 1.0], n)
    return np.full(n, CONDITIONS[kind][1])


def _direct(model: Model, q: Array, at: Mapping[str, Array]) -> tuple[Array, Array]:
    used = {name: value for name, value in at.items() if name in model.conditions}
    found = Kinematics(model).direct(q, used)
    return found.position, found.rotation


def _measure(one: tuple[Array, Array], other: tuple[Array, Array]) -> str:
    """Return the largest difference between poses, as `212.3 um and 310.4 urad`."""
    position = np.linalg.norm(one[0] - other[0], axis=1).max()
    turned = np.linalg.norm(rotation_vector(one[1] @ other[1].transpose(0, 2, 1)), axis=1).max()
    return f"{1e6 * position:.4g} um and {1e6 * turned:.4g} urad"


# ------------------------------------------------------------------ numbers


def rpy_of(R: Array) -> tuple[float, float, float]:
    """Return roll, pitch and yaw of a rotation: about fixed x, then y, then z.

    The yaw is taken out before the roll is read, so that the product is exact at a pitch of 90
    degrees, too, where only their difference is determined.
    """
    yaw = float(np.arctan2(R[1, 0], R[0, 0]))
    c, s = np.cos(yaw), np.sin(yaw)
    rest = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ R
    pitch = float(np.arctan2(-rest[2, 0], rest[0, 0]))
    return float(np.arctan2(-rest[1, 2], rest[1, 1])), pitch, yaw


def format_exactly(values: Array | tuple[float, ...]) -> str:
    """Format numbers with all their digits, and rounding errors of zero as 0."""
    numbers = np.ravel(np.asarray(values, dtype=float))
    return " ".join(
        repr(v) for v in np.where(np.abs(numbers) < ROUNDING_ERROR, 0.0, numbers).tolist()
    )
