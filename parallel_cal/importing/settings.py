"""Values stated in files, with file and line for messages about wrong ones."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from difflib import SequenceMatcher
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.files import read_foreign_text

# Of a misspelt key, as difflib counts it. 86 % of 10,000 single slips in keys of our importers are
# nearer than this, and 75 % of double ones (the others are in short keys and in single letters).
# `position_min` and `position_max` have 0.83; of 24 configurations that come with Klipper,
# Smoothieware and LinuxCNC, only one key is above 0.72, and that one is a mistake (delta_homing).
MIN_SIMILARITY = 0.85
PARTS = re.compile(r"(.*(?:\] |[/.]))?(.*)")  # of a field: its section, if it has one, and its key


@dataclass(frozen=True)
class SourceLine:
    """A line of a file."""

    path: Path
    line: int

    def error(self, field: str, found: str, expected: str) -> DatasetError:
        return DatasetError(f"{self.path}:{self.line}: {field} is '{found}', expected {expected}")

    def number(
        self, field: str, text: str, expected: str, low: float = -math.inf, high: float = math.inf
    ) -> float:
        """Parse a finite number from `low` to `high`."""
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and low <= value <= high):
            raise self.error(field, text.strip(), expected)
        return value


@dataclass(frozen=True)
class Settings:
    """The texts of a configuration by field (`M665 L`, `[printer] delta_radius`).

    `paths` are all files that were read, `unread` names those that the configuration includes and
    that were not found. `remarks` name values that the controller does not use. `asked` collects
    the fields that were looked for.
    """

    texts: dict[str, tuple[str, SourceLine]]
    paths: Sequence[Path]
    unread: tuple[str, ...] = ()
    remarks: Sequence[str] = ()
    asked: set[str] = field(default_factory=set, compare=False, repr=False)

    def __contains__(self, field: str) -> bool:
        self.asked.add(field)
        return field in self.texts

    def text(self, field: str, expected: str) -> tuple[str, SourceLine]:
        """Return a field's text and line; DatasetError if no file has the field."""
        if field not in self:
            files = ", ".join(map(str, self.paths))
            why = "".join(f"; {words}" for words in self.describe_unused())
            raise DatasetError(f"{files}: no {field}, expected {expected}{why}")
        return self.texts[field]

    def describe_unused(self) -> list[str]:
        """Return what was not read or is not used:
        `the included files delta.cfg, macros/*.cfg were not found: give them as well`.

        Ask after all fields were read: what was looked for in vain may be misspelt.
        """
        remarks = [*self.remarks, *self.describe_misspelt()]
        if not self.unread:
            return remarks
        names = ", ".join(self.unread)
        plural = "s" if len(self.unread) > 1 else ""
        unread = (
            f"the included file{plural} {names} {'were' if plural else 'was'} not found and not "
            "read: if a value of the kinematics is in there, give that file as well, with the same "
            "option"
        )
        return [*remarks, unread]

    def describe_misspelt(self) -> list[str]:
        """Name the fields that nobody looked for and that resemble one that was looked for in vain.

        A configuration has hundreds of keys that are no concern of an importer: a key is compared
        with those of its own section only, and a section in which nobody looked for any key with
        those in which the same key is missing.
        """
        asked = {field: _split(field) for field in sorted(self.asked)}
        missing = [parts for field, parts in asked.items() if field not in self.texts]
        known = {section for section, _ in asked.values()}
        words = list[str]()
        for name in self.texts:
            section, key = _split(name)
            near = list[tuple[float, str]]()
            for other, wanted in missing if name not in asked else ():
                if section == other:
                    near.append((_similarity(key, wanted), other + wanted))
                elif section not in known and key == wanted:
                    near.append((_similarity(section, other), other + wanted))
            alike, meant = max(near, default=(0.0, ""))
            if alike >= MIN_SIMILARITY:
                place = self.texts[name][1]
                words.append(
                    f"{place.path}:{place.line}: {name} is not used: did you mean {meant}?"
                )
        return words

    def error(self, field: str, expected: str) -> DatasetError:
        """Return the error for a field whose text is not as expected."""
        text, place = self.text(field, expected)
        return place.error(field, text, expected)

    def number(
        self,
        field: str,
        expected: str,
        default: float | None = None,
        low: float = -math.inf,
        high: float = math.inf,
    ) -> float:
        if default is not None and field not in self:
            return default
        text, place = self.text(field, expected)
        return place.number(field, text, expected, low, high)

    def numbers(
        self,
        field: str,
        expected: str,
        count: int,
        default: float | None = None,
        low: float = -math.inf,
    ) -> np.ndarray:
        """Parse `count` numbers separated by colons; a single one stands for all."""
        if default is not None and field not in self:
            return np.full(count, default)
        text, place = self.text(field, expected)
        words = text.split(":")
        if len(words) not in (1, count):
            raise place.error(field, text, f"{expected}: 1 or {count} numbers")
        values = [place.number(field, word, expected, low) for word in words]
        return np.array(values * count if len(values) == 1 else values)


def _split(field: str) -> tuple[str, str]:
    """Return the section of a field, with the separator behind it, and its key."""
    found = PARTS.fullmatch(field)
    return (found[1] or "", found[2]) if found else ("", field)


def _similarity(name: str, wanted: str) -> float:
    """Return how alike two names are, up to 1; 0 if only digits and single letters differ, such as
    in `x_offset` and `y_offset`, which are different names."""
    name, wanted = name.lower(), wanted.lower()
    words, plain = (
        [re.findall(e, each) for each in (name, wanted)] for e in ("[a-z]{2,}", r"[^\W_]")
    )
    if words[0] == words[1] and plain[0] != plain[1]:
        return 0.0
    return SequenceMatcher(None, name, wanted).ratio()


def read_fields(paths: Sequence[Path], pattern: re.Pattern[str]) -> Settings:
    """Read the lines that a pattern matches, with groups for the field and its text; the last text
    of each field counts."""
    texts: dict[str, tuple[str, SourceLine]] = {}
    for path in paths:
        for place, line in read_lines(path):
            if found := pattern.match(line):
                texts[found[1]] = (found[2], place)
    return Settings(texts, paths)


def read_lines(path: Path, text: str | None = None) -> list[tuple[SourceLine, str]]:
    """Read the lines of a text file, or of `text` in its place; DatasetError if it is not text."""
    try:
        text = read_foreign_text(path) if text is None else text
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise DatasetError(f"{path}:1: not text (UTF-8, UTF-16 or Latin-1)") from None
    return [(SourceLine(path, k), line) for k, line in enumerate(text.splitlines(), start=1)]


def sha256(paths: Iterable[Path]) -> str:
    return hashlib.sha256(b"".join(path.read_bytes() for path in paths)).hexdigest()
