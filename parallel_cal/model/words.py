"""Parameters, and directions made of them, in words that a mechanic understands."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from parallel_cal.model.parameters import ParameterTable

NUMBERED = re.compile(r"(.*[a-z])(\d+)")  # an owner in a parameter's name: chain2


@dataclass(frozen=True)
class Owner:
    """What a parameter belongs to: a family such as `chain`, and its number there if it has one."""

    family: str
    number: str = ""

    def __str__(self) -> str:
        return f"{self.family} {self.number}".rstrip()


@dataclass(frozen=True)
class Described:
    """A parameter in words, and its owners from the inside out: `z`, of `plate`, of `probe`."""

    word: str
    owners: tuple[Owner, ...] = ()

    def __str__(self) -> str:
        return " of ".join([self.word, *map(str, self.owners)])

    def numbered(self, place: int, number: str) -> Described:
        """Return it with another number of the owner at a place; unchanged at place -1."""
        owners = list(self.owners)
        if place >= 0:
            owners[place] = Owner(owners[place].family, number)
        return Described(self.word, tuple(owners))

    @classmethod
    def of(cls, name: str, table: ParameterTable) -> Described:
        """Describe a parameter; without a label, its name is kept."""
        if name in table.names and table[name].title:
            return cls(str(table[name].title))
        *owners, key = name.split(".")
        word = (table[name].label if name in table.names else "") or key
        parts = [NUMBERED.fullmatch(owner) for owner in owners]
        families = [match[1] if match else o for o, match in zip(owners, parts, strict=True)]
        numbers = [match[2] if match else "" for match in parts]
        found = map(Owner, [family.replace("_", " ") for family in families], numbers)
        return cls(word, tuple(found)[::-1])


def describe(name: str, table: ParameterTable) -> str:
    """Describe `chain2.Lb` as `rod length of chain 2`; without a label, the name is kept."""
    return str(Described.of(name, table))


def direction_in_words(parts: Mapping[str, float], table: ParameterTable) -> str:
    """Describe an unidentifiable direction as `A against B`: A grows while B shrinks.

    `parts` are in tolerances, largest first, as `observability.combination` returns them.
    """
    grows = [name for name, weight in parts.items() if weight > 0]
    shrinks = [name for name, weight in parts.items() if weight < 0]
    sides = [_join_groups(side, table) for side in (grows, shrinks) if side]
    return " against ".join(sides)


def _join_groups(names: list[str], table: ParameterTable, most: int = 3) -> str:
    """The first few parameters; those that differ in one owner's number share a phrase."""
    groups: dict[tuple[Described, int], dict[str, None]] = {}
    for one in (Described.of(name, table) for name in names):
        place = next((k for k, owner in enumerate(one.owners) if owner.number), -1)
        number = one.owners[place].number if place >= 0 else ""
        groups.setdefault((one.numbered(place, ""), place), {})[number] = None
    phrases = [
        str(alike.numbered(place, ", ".join(sorted(numbers))))  # `rod length of chain 1, 2, 3`
        for (alike, place), numbers in list(groups.items())[:most]
    ]
    rest = len(groups) - len(phrases)
    return " with ".join(phrases) + (f" and {rest} more" if rest else "")


def parameters_in_words(names: Iterable[str], table: ParameterTable) -> str:
    """Describe parameters, grouped: `D_x, D_y of chain 1, 2 and z of plate of probe`."""
    owners: dict[tuple[str, str], dict[str, None]] = {}
    for name in names:
        one = Described.of(name, table)
        *inner, last = one.owners or (Owner(""),)
        family = " of ".join([*map(str, inner), last.family])
        owners.setdefault((one.word, family), {})[last.number] = None
    parts: dict[tuple[str, str], list[str]] = {}
    for (word, family), numbers in owners.items():
        parts.setdefault((family, ", ".join(sorted(numbers))), []).append(word)
    phrases = [
        ", ".join(words) + (f" of {Owner(family, numbers)}" if family else "")
        for (family, numbers), words in parts.items()
    ]
    return " and ".join(phrases)


def join_words(words: Iterable[str]) -> str:
    """Enumerate: `a, b and c`."""
    *before, last = words
    return " and ".join(filter(None, [", ".join(before), last]))
