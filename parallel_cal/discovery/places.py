"""Places: where an error can enter the closure, and how it moves the residuals from there."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np

from parallel_cal.base.rotation import left_generators
from parallel_cal.diagnosis.stations import Stations
from parallel_cal.effects._statics import needs_rods, rods
from parallel_cal.model.mechanism import POSE
from parallel_cal.posterior.scene import Scene

JOINT, PARAMETER, ROD, PLATFORM, BASE, DEVICE = (
    "joint",
    "parameter",
    "rod",
    "pose",
    "base",
    "device",
)
MEMBER = re.compile(r"(.*?\d+)\.(.+)")  # chain1.La_x: the chain, and the name of its parameter


@dataclass(frozen=True)
class Place:
    """One quantity that can err.

    `columns` (N, rows) are the derivatives of the residual, in noise units, by an error of the
    quantity in SI units. `joint` is the index of the joint that the quantity belongs to, `rod` that
    of the rod that it is the length of; None if there is no such one. `stations` are those of a
    device that stood elsewhere in each recording: its quantities are then along its own axes.
    """

    name: str
    kind: str
    unit: str
    index: int
    joint: int | None
    columns: np.ndarray = field(repr=False)
    rod: int | None = None
    stations: Stations | None = field(repr=False, default=None)


@dataclass(frozen=True)
class Site:
    """One place, or several places of one kind that follow the same law.

    With `each`, every member has coefficients of its own.
    """

    name: str
    members: tuple[Place, ...]
    each: bool = False

    @property
    def kind(self) -> str:
        return self.members[0].kind

    @property
    def unit(self) -> str:
        return self.members[0].unit

    @property
    def key(self) -> tuple[str, bool]:
        return self.name, self.each

    def of_members(self, numbers: Sequence[int]) -> Site:
        """This site with some of its members."""
        left = tuple(self.members[number] for number in numbers)
        return replace(self, members=left) if len(left) > 1 else Site(left[0].name, left)


def list_places(scene: Scene, stations: Stations | None = None) -> list[Place]:
    """List every joint reading, every parameter of the mechanism, every rod, and the platform's
    pose, which is also the pose that the device shows."""
    mechanism = scene.model.mechanism
    joints, J = scene.model.joints, scene.seen_jacobian
    n = len(joints)
    found = [
        Place(name, JOINT, unit, i, i, J[:, :, i])
        for i, (name, unit) in enumerate(zip(joints, mechanism.joint_units, strict=True))
    ]
    pose = _pose_columns(scene)
    shown = pose
    if stations is not None:  # shift and turn along the axes of the device
        axes = stations.turns.transpose(0, 2, 1)
        shown = np.concatenate([pose[:, :, i : i + 3] @ axes for i in (0, 3)], axis=2)
    for i in mechanism.moved:
        unit, name = "m" if i < 3 else "rad", POSE[i]
        found += [
            Place(f"{PLATFORM}.{name}", PLATFORM, unit, i, None, pose[:, :, i]),
            Place(f"{DEVICE}.{name}", DEVICE, unit, i, None, shown[:, :, i], stations=stations),
        ]
    found += _list_turns_of_base(scene, pose)
    owners, geometry = _find_owners(mechanism.parameters.names, n), n + 12 + len(mechanism.passive)
    found += [
        Place(p.name, PARAMETER, p.unit, k, owners.get(p.name), J[:, :, geometry + k])
        for k, p in enumerate(mechanism.parameters)
    ]
    found += _list_rods(scene, J[:, :, geometry:])
    # Contiguous: sums over them then do not depend on where they are computed, to the last bit.
    return [
        replace(place, columns=np.ascontiguousarray(place.columns))
        for place in found
        if np.any(place.columns)
    ]


def _list_turns_of_base(scene: Scene, pose: np.ndarray) -> list[Place]:
    """The turns of the robot's base, as the device sees them, about the axes of {B} that a weight
    can turn it about; `pose` are the derivatives by a shift and a turn of the platform."""
    n, gravity = len(scene.model.joints), np.array(scene.model.mechanism.gravity)
    r, found = scene.seen[:, n : n + 3], list[Place]()
    for axis, unit in enumerate(np.eye(3)):
        if np.cross(unit, gravity).any():
            shift = np.cross(unit, r)
            columns = np.einsum("nri,ni->nr", pose[:, :, :3], shift) + pose[:, :, 3 + axis]
            found.append(Place(f"{BASE}.{POSE[3 + axis]}", BASE, "rad", 3 + axis, None, columns))
    return found


def _list_rods(scene: Scene, J: np.ndarray) -> list[Place]:
    """The length of each rod; none where statics does not give its tension. `J` are the derivatives
    by the parameters of the mechanism (N, rows, k)."""
    mechanism = scene.model.mechanism
    if needs_rods(mechanism):
        return []
    names, by_length = rods(mechanism)
    own = [mechanism.parameters.names.index(name) for name in names]
    columns = J[:, :, own] @ np.linalg.pinv(by_length)
    return [
        Place(f"rod{k + 1}", ROD, "m", k, None, columns[:, :, k], rod=k)
        for k in range(len(by_length))
    ]


def list_sites(places: list[Place]) -> list[Site]:
    """List single places and groups of places: all joints, one parameter of all chains, the pose's
    translations. A group follows one law, or each member has coefficients of its own."""
    sites = [Site(place.name, (place,)) for place in places]
    groups: dict[str, list[Place]] = defaultdict(list)
    for place in places:
        if place.kind == JOINT:
            groups["joints"].append(place)
        elif place.kind == ROD:
            groups["rods"].append(place)
        elif place.kind == PARAMETER and (match := MEMBER.fullmatch(place.name)):
            groups[match[2]].append(place)
        elif place.kind == BASE:
            groups[BASE].append(place)
        elif place.index < 3:
            groups[f"{place.kind}.xyz"].append(place)
    for name, members in groups.items():
        if len(members) < 2:
            continue
        if members[0].kind in (JOINT, PARAMETER, ROD, BASE):
            sites.append(Site(name, tuple(members)))
        if members[0].kind != ROD:  # so many coefficients would imitate any slow noise
            sites.append(Site(name, tuple(members), each=True))
    return sites


def _pose_columns(scene: Scene) -> np.ndarray:
    """d residual / d(shift and turn of the measured platform) (N, rows, 6): the ideal pose is the
    measured one without them, hence the sign."""
    J, n = scene.seen_jacobian, len(scene.model.joints)
    R9 = ca.SX.sym("R", 9)
    turned = ca.Function("turned", [R9], [left_generators(ca.reshape(R9, 3, 3).T)])
    by_turn = np.array([np.array(turned(R)) for R in scene.seen[:, n + 3 : n + 12]])
    return -np.concatenate([J[:, :, n : n + 3], J[:, :, n + 3 : n + 12] @ by_turn], axis=2)


def _find_owners(names: tuple[str, ...], n_joints: int) -> dict[str, int]:
    """The joint of each parameter that belongs to one chain (`chain1`, `line1`), if there is a
    chain for each joint."""
    matches = {name: match for name in names if (match := MEMBER.fullmatch(name))}
    kinds: dict[str, list[str]] = defaultdict(list)
    for chain in dict.fromkeys(match[1] for match in matches.values()):
        kinds[chain.rstrip("0123456789")].append(chain)
    owners = {
        chain: joint
        for chains in kinds.values()
        if len(chains) == n_joints
        for joint, chain in enumerate(chains)
    }
    return {name: owners[match[1]] for name, match in matches.items() if match[1] in owners}
