"""Parameters, and directions made of them, in words that a mechanic understands."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

from parallel_cal.model.parameters import ParameterTable


def describe(name: str, table: ParameterTable) -> str:
    """Describe `chain2.Lb` as `rod length of chain 2`; without a label, the name is kept."""
    if name in table.names and table[name].title:
        return str(table[name].title)
    *owners, key = name.split(".")
    word = (table[name].label if name in table.names else "") or key
    readable = [re.sub(r"(?<=[a-z])(\d+)$", r" \1", o).replace("_", " ") for o in owners]
    return " of ".join([word, *reversed(readable)])


def direction_in_words(parts: Mapping[str, float], table: ParameterTable) -> str:
    """Describe an unidentifiable direction as `A against B`: A grows while B shrinks.

    `parts` are in tolerances, largest first, as `observability.combination` returns them.
    """
    grows = [name for name, weight in parts.items() if weight > 0]
    shrinks = [name for name, weight in parts.items() if weight < 0]
    sides = [_join_groups(side, table) for side in (grows, shrinks) if side]
    return " against ".join(sides)


def _join_groups(names: list[str], table: ParameterTable, most: int = 3) -> str:
    """The first few parameters; equal parameters of several chains share one phrase."""
    grouped: dict[str, list[str]] = {}
    for name in names:
        grouped.setdefault(name.rpartition(".")[2], []).append(name)
    phrases = []  # such as `rod length of chain 1, 2, 3`
    for group in list(grouped.values())[:most]:
        first, *others = (describe(name, table) for name in sorted(group))
        phrases.append(", ".join([first, *(other.rpartition(" ")[2] for other in others)]))
    rest = len(grouped) - len(phrases)
    return " with ".join(phrases) + (f" and {rest} more" if rest else "")


def parameters_in_words(names: Iterable[str], table: ParameterTable) -> str:
    """Describe parameters, grouped: `D_x, D_y of chain 1, 2 and z of plate of probe`."""
    owners: dict[tuple[str, str], dict[str, None]] = {}
    for name in names:
        word, _, owner = describe(name, table).partition(" of ")
        family, _, number = owner.rpartition(" ") if owner[-1:].isdigit() else (owner, "", "")
        owners.setdefault((word, family), {})[number] = None
    parts: dict[tuple[str, str], list[str]] = {}
    for (word, family), numbers in owners.items():
        parts.setdefault((family, ", ".join(sorted(numbers))), []).append(word)
    phrases = [f"{', '.join(words)} of {f} {n}".rstrip() for (f, n), words in parts.items()]
    return " and ".join(phrases).replace(" of  ", " ").removesuffix(" of")
