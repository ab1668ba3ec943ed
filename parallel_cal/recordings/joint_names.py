"""Joints that are numbered alike under different names, such as j1 to j6 and joint1 to joint6."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import TypeVar

T = TypeVar("T")
NUMBERED = re.compile(r"(.*\D|)(\d+)(\D*)")  # the last number in a name


def match_numbered_names(joints: Sequence[str], names: Sequence[str]) -> dict[str, str]:
    """Return the name for each joint if both are numbered through, and only one choice is possible.

    The names of a group differ in one number only. Its numbers are consecutive, such as those of
    the joints, but may begin at 0 where the joints begin at 1.

    Returns
    -------
    dict
        A name for each joint; empty if no group, or more than one, has as many names as there are
        joints.

    Examples
    --------
    >>> match_numbered_names(["joint1", "joint2"], ["time", "q_1", "q_0", "x"])
    {'joint1': 'q_0', 'joint2': 'q_1'}
    >>> match_numbered_names(["joint1", "joint2"], ["q1", "q2", "target1", "target2"])
    {}
    """
    own = [*_number_groups(joints).values()]
    if len(joints) < 2 or len(own) != 1 or len(own[0]) != len(joints):
        return {}
    fitting = [group for group in _number_groups(names).values() if len(group) == len(joints)]
    if len(fitting) != 1:
        return {}
    wanted, found = sorted(own[0]), sorted(fitting[0])
    return {own[0][i]: fitting[0][k] for i, k in zip(wanted, found, strict=True)}


def rename_conditions(conditions: Mapping[str, T], names: Mapping[str, str]) -> dict[str, T]:
    """Return conditions such as `direction.j1` under the new names of their joints."""
    renamed = {}
    for key, value in conditions.items():
        kind, _, part = key.partition(".")
        renamed[f"{kind}.{names[part]}" if part in names else key] = value
    return renamed


def describe_match(source: str, matched: Mapping[str, str]) -> str:
    """Say which names were taken for which joints."""
    pairs = ", ".join(f"{name} for {joint}" for joint, name in matched.items())
    return (
        f"{source}: joints were matched by their numbers: {pairs}. If this is wrong, state the "
        "joints of the model in the column map (joints: {JOINT: {column: NAME}})"
    )


def _number_groups(names: Sequence[str]) -> dict[tuple[str, str], dict[int, str]]:
    """Return names by number, of groups whose numbers are consecutive."""
    groups: dict[tuple[str, str], dict[int, str]] = {}
    for name in names:
        if found := NUMBERED.fullmatch(name):
            groups.setdefault((found[1], found[3]), {})[int(found[2])] = name
    return {
        key: group for key, group in groups.items() if max(group) - min(group) + 1 == len(group)
    }
