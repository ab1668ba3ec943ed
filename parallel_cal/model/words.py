"""What a parameter is, in words a mechanic understands, and directions made of them."""

from __future__ import annotations

import re
from collections.abc import Mapping

from parallel_cal.model.mechanism import Mechanism

# In a chain's frame x points outwards, y up and z along the motor's axis (figure 3.9).
DELTA = {
    "D_x": "motor axis' distance from the centre",
    "D_y": "motor axis' height",
    "D_z": "shift along the motor axis",
    "theta": "chain's direction about z",
    "alpha": "motor axis' tilt",
    "La_x": "arm length",
    "La_y": "encoder offset (arm's end across)",
    "La": "arm length",
    "Lb": "rod length",
    "R": "base radius less platform radius",
    "dalpha": "arm bar's twist against the platform bar, about x",
    "dbeta": "arm bar's twist against the platform bar, about y",
    "dC_x": "difference of the arm's ball positions along the arm",
    "dC_y": "difference of the arm's ball positions across the arm",
    "dC_z": "difference of arm's and platform's bar length",
    "dLb": "difference of the two rods' lengths",
    "d_z": "platform bar's half length",
    "b_x": "platform balls' distance from the centre",
    "b_y": "platform balls' height",
    "b_z": "platform balls' shift along the bar",
}
ARGOS = {
    "alpha0": "encoder offset",
    "Omega": "motor axis' angle out of the base plane",
    "Phi": "motor axis' direction in the base plane",
    "omega": "ball's direction out of the platform plane",
    "phi": "ball's direction in the platform plane",
    "dA": "motor axis' distance from the sphere's centre",
    "dC": "motor axis' height over the sphere's centre",
    "da": "pantograph's distance from the motor axis",
    "dc": "pantograph's shift along the motor axis",
    "gamma": "pantograph's angle to the motor axis",
    "dR": "ball's shift along the pantograph",
    "R": "ball's distance from the platform's centre",
}
LEGS = {
    **{f"B_{a}": f"platform joint's {a}" for a in "xyz"},
    **{f"C_{a}": f"base joint's {a}" for a in "xyz"},
    "L0": "length at reading zero",
    "delta": "actuator's misalignment",
}
OTHERS = {
    **{f"A_{a}": f"anchor's {a}" for a in "xyz"},
    "offset": "line's length at reading zero",
    "gear": "gear ratio",
    "advantage": "pulley's mechanical advantage",
    "R": "radius",
    "a": "crank length",
    "b": "rod length",
    "q0": "encoder offset",
    "width": "play",
    "sin": "sine part",
    "cos": "cosine part",
}
FAMILIES = {
    "delta": DELTA, "argos": ARGOS, "stewart": LEGS, "planar_stewart": LEGS,
}  # fmt: skip


def describe(name: str, mechanism: Mechanism | None = None) -> str:
    """`chain2.Lb` -> `rod length of chain 2`; what no table knows keeps its name.

    A mechanism may bring its own table `words`: key (the name's last part) -> words.
    """
    *owners, key = name.split(".")
    word = _table(mechanism).get(key, key)
    readable = [re.sub(r"(?<=[a-z])(\d+)$", r" \1", o).replace("_", " ") for o in owners]
    return " of ".join([word, *reversed(readable)])


def _table(mechanism: Mechanism | None) -> Mapping[str, str]:
    if mechanism is None:
        return OTHERS
    family = re.sub(r"(_nominal|\d+)$", "", mechanism.name)
    return {**OTHERS, **FAMILIES.get(family, {}), **getattr(mechanism, "words", {})}


def direction_in_words(parts: Mapping[str, float], mechanism: Mechanism | None = None) -> str:
    """A direction as `A against B`: what grows and what shrinks together, unseen (largest
    first; parts in tolerances, as `observability.combination` gives them)."""
    grows = [name for name, weight in parts.items() if weight > 0]
    shrinks = [name for name, weight in parts.items() if weight < 0]
    sides = [_joined(side, mechanism) for side in (grows, shrinks) if side]
    return " against ".join(sides)


def _joined(names: list[str], mechanism: Mechanism | None, most: int = 3) -> str:
    """The first few of them; owners that share a word are named together."""
    grouped: dict[str, list[str]] = {}
    for name in names:
        grouped.setdefault(name.rpartition(".")[2], []).append(name)
    told = [_together(group, mechanism) for group in list(grouped.values())[:most]]
    rest = len(grouped) - len(told)
    return " with ".join(told) + (f" and {rest} more" if rest else "")


def _together(names: list[str], mechanism: Mechanism | None) -> str:
    """`rod length of chain 1, 2, 3` for one parameter of several chains."""
    first, *others = (describe(name, mechanism) for name in sorted(names))
    return ", ".join([first, *(other.rpartition(" ")[2] for other in others)])
