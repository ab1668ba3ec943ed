"""Values stated in files, with file and line for messages about wrong ones."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import DatasetError
from parallel_cal.base.files import read_foreign_text


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
    that were not found. `remarks` name values that the controller does not use.
    """

    texts: dict[str, tuple[str, SourceLine]]
    paths: Sequence[Path]
    unread: tuple[str, ...] = ()
    remarks: Sequence[str] = ()

    def __contains__(self, field: str) -> bool:
        return field in self.texts

    def text(self, field: str, expected: str) -> tuple[str, SourceLine]:
        """Return a field's text and line; DatasetError if no file has the field."""
        if field not in self.texts:
            files = ", ".join(map(str, self.paths))
            why = "".join(f"; {words}" for words in self.describe_unused())
            raise DatasetError(f"{files}: no {field}, expected {expected}{why}")
        return self.texts[field]

    def describe_unused(self) -> list[str]:
        """Return what was not read or is not used:
        `the included files delta.cfg, macros/*.cfg were not found: give them as well`."""
        if not self.unread:
            return [*self.remarks]
        names = ", ".join(self.unread)
        plural = "s" if len(self.unread) > 1 else ""
        unread = (
            f"the included file{plural} {names} {'were' if plural else 'was'} not found and not "
            "read: if a value of the kinematics is in there, give that file as well, with the same "
            "option"
        )
        return [*self.remarks, unread]

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
        if default is not None and field not in self.texts:
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
        if default is not None and field not in self.texts:
            return np.full(count, default)
        text, place = self.text(field, expected)
        words = text.split(":")
        if len(words) not in (1, count):
            raise place.error(field, text, f"{expected}: 1 or {count} numbers")
        values = [place.number(field, word, expected, low) for word in words]
        return np.array(values * count if len(values) == 1 else values)


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
