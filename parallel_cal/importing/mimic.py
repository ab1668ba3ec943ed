"""The joints of a URDF, and what moves those that follow others (`<mimic>`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.importing.chain import motion_of
from parallel_cal.recordings.recording import Array


@dataclass(frozen=True)
class Mimic:
    """The position of a joint that follows another one: factor * its position + offset."""

    joint: str
    factor: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Joint:
    """One joint of a chain: its frame (4, 4) in its parent's frame, and its axis in its own, of the
    length that the file states."""

    name: str
    kind: str | None
    parent: str
    child: str
    origin: Array
    stated_axis: Array
    limits: tuple[float, float]
    velocity: float
    is_limit_zero: bool = False  # stated as 0 to 0
    mimic: Mimic | None = None

    @property
    def axis_length(self) -> float:
        """The length of its axis in the file."""
        return float(np.linalg.norm(self.stated_axis))

    @property
    def axis(self) -> Array:
        """The direction of its axis, of length 1, or 0 of a joint that does not move."""
        return self.stated_axis / (self.axis_length or 1.0)

    @property
    def unit(self) -> str:
        """The unit of its position."""
        return "m" if self.kind == "P" else "rad"

    @property
    def finite_limits(self) -> tuple[float, float]:
        """The limits, of an endless joint a turn to both sides."""
        low, high = self.limits
        if self.kind == "R":
            low, high = np.clip(self.limits, -2 * np.pi, 2 * np.pi).tolist()
        return low, high


def resolve_mimic(path: Path, joint: Joint, every: Sequence[Joint]) -> Joint:
    """Return a joint whose mimic names the joint that does not follow another one itself.

    A joint that follows with the factor 0 stands still: it becomes a fixed one.
    """
    if joint.kind is None or joint.mimic is None:
        return joint
    known = {other.name: other for other in every}
    factor, offset, passed, at = 1.0, 0.0, [joint.name], joint
    while at.mimic:
        offset += factor * at.mimic.offset
        factor *= at.mimic.factor
        where, master = f"{path}: joint '{at.name}': mimic", at.mimic.joint
        if master not in known:
            raise DatasetError(
                f"{where} names the joint '{master}', which the file does not have; expected one "
                f"of {', '.join(sorted(known))}"
            )
        if master in passed:
            raise DatasetError(
                f"{where}: {' follows '.join([*passed, master])}: remove one of these mimics"
            )
        at = known[master]
        passed.append(master)
    if factor == 0:
        origin = joint.origin @ motion_of(joint.kind, joint.axis, offset)
        return replace(joint, kind=None, origin=origin)
    if at.kind not in ("R", "P"):
        raise DatasetError(
            f"{where} names the joint '{at.name}', which is {at.kind or 'fixed'}; expected a "
            "revolute, continuous or prismatic joint"
        )
    return replace(joint, mimic=Mimic(at.name, factor, offset))


def enter_drives(
    steps: Sequence[dict[str, Any]], moving: Sequence[Joint], known: Mapping[str, Joint]
) -> dict[str, Joint]:
    """Enter what drives each joint in its link, and return the links with readings and the joints
    of the file that have these readings.

    The reading of a master off the chain is that of the first joint that follows it.
    """
    masters = [joint.mimic.joint if joint.mimic else joint.name for joint in moving]
    names = [f"link{k}" for k in range(1, len(moving) + 1)]
    owners = dict(zip(reversed(masters), reversed(names), strict=True))
    owners |= {j.name: name for j, name in zip(moving, names, strict=True) if not j.mimic}
    for step, joint, master in zip(steps, moving, masters, strict=True):
        if joint.mimic:
            step |= {"driven_by": {owners[master]: joint.mimic.factor}}
            step |= {"offset": joint.mimic.offset} if joint.mimic.offset else {}
            low, high = joint.limits
            step |= {k: v for k, v in (("low", low), ("high", high)) if np.isfinite(v)}
    for owned, name in owners.items():
        if known[owned].kind != (own := steps[names.index(name)])["joint"]:
            own["reading"] = known[owned].unit
    first = dict(zip(names, masters, strict=True))
    driven = {name: known[first[name]] for name in names if name in owners.values()}
    for name, one in driven.items():
        (low, high), joint = one.finite_limits, moving[names.index(name)]
        if joint.mimic:  # its own limits, as limits of the reading that moves it
            law = joint.mimic
            ends = sorted((limit - law.offset) / law.factor for limit in joint.limits)
            if max(low, ends[0]) < min(high, ends[1]):
                low, high = max(low, ends[0]), min(high, ends[1])
        steps[names.index(name)] |= {"low": low, "high": high}
    return driven


def describe_mimics(moving: Sequence[Joint], driven: Mapping[str, Joint]) -> list[str]:
    """Say which joints follow which, and how."""
    said = []
    for k, joint in enumerate(moving, start=1):
        if joint.mimic is None:
            continue
        unit, master = joint.unit, joint.mimic.joint
        factor, offset = joint.mimic.factor, joint.mimic.offset
        law = f"{factor:.6g} {master}"
        law += f" {'-' if offset < 0 else '+'} {abs(offset):.6g} {unit}" if offset else ""
        off = "" if any(j.name == master for j in moving) else ", which is not on the chain"
        owner = next(name for name, one in driven.items() if one.name == master)
        fixed = "" if owner == f"link{k}" else f"; the factor link{k}.by_{owner} is fixed"
        said.append(f"{joint.name} follows {master}{off} ({law}){fixed}")
    return said


def describe_limits(masters: Sequence[Joint], narrowed: Sequence[tuple[float, float]]) -> list[str]:
    """Say which limits are narrower than in the file, and which the file does not state."""
    said = [
        f"{master.name} is limited to {low:.6g} to {high:.6g} {master.unit}: "
        "beyond, a joint that follows it leaves its own limits"
        for master, (low, high) in zip(masters, narrowed, strict=True)
        if master.limits != (low, high)
    ]
    if unlimited := [joint.name for joint in masters if joint.is_limit_zero]:
        said.append(
            f"the limits of {', '.join(unlimited)} are 0 to 0, which does not state how far they "
            "move: set them in the model file (joint_limits)"
        )
    return said
