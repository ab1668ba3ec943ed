"""Settings in G-code; the last value of each word counts."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from parallel_cal.base.units import MM
from parallel_cal.importing.settings import Settings, SourceLine, read_lines
from parallel_cal.recordings.recording import Array

STEPS_FIELDS = tuple(f"M92 {axis}" for axis in "XYZ")  # steps per mm of three towers

GLOBAL = re.compile(r"(?:set\s+)?global[\s.]\s*(\w+)\s*=\s*([^\s;]+)")  # of RepRapFirmware
USE = re.compile(r"\{\s*global\.(\w+)\s*\}")
GLUED = re.compile(r"(?:[A-Za-z][-+]?\d[\d.:]*)+")  # such as L250R125: words without spaces
PARTED = re.compile(r"(?<=[A-Za-z])\s+(?=[-+]?\.?\d)")  # such as L 250
CHECKSUM = re.compile(r"\*\d+\s*$")  # of a line that a host sent
# What hosts write before a line: OctoPrint `Recv: `, Pronterface `>>> `, Simplify3D `READ: `,
# Repetier-Host `08:55:33.358 : `, Arduino `08:55:33.358 -> `, MatterControl `->`; Marlin `echo:`,
# MK4duo `Config:`.
TIME = r"[\[(]?(?:\d{4}-\d\d-\d\d[ T])?\d{1,2}:\d\d:\d\d(?:[.,]\d+)?[\])]?"
DIRECTION = r"\b(?:Recv|Send|Sent|Read|Received|Sending)\s*:"
HOST_PREFIX = re.compile(
    rf"^(?:[^;]*?{DIRECTION})?(?:\s*(?:{TIME}|<+|-?>+|<-)\s*[-|:]*)*\s*(?:(?:echo|Config)\s*:)?",
    re.IGNORECASE,
)
LOAD, OVERRIDE = "M501", "config-override.g"  # which M500 writes
COMMAND = re.compile(r"\s*(?:N\d+\s*)?([GM]\d+)(?![\d.])(.*)", re.IGNORECASE)


def settings(
    paths: Sequence[Path], codes: Sequence[str], texts: Mapping[Path, str] | None = None
) -> Settings:
    """Read the words of some commands in G-code files, by fields such as `M665 L`.

    RepRapFirmware reads config-override.g where another file has M501, and never without it
    (GCodes2.cpp, 3.5.3). A word such as `R{global.radius}` has the value and the line of the global
    variable. `texts` replace those of files.
    """
    reader = _Reader(codes, {path.resolve(): path for path in paths}, texts or {})
    overrides = [path for path in paths if path.name.lower() == OVERRIDE]
    for path in paths if len(overrides) == len(paths) else (p for p in paths if p not in overrides):
        reader.read(path)
    unused = [path for path in overrides if path not in reader.paths]
    remarks = [f"{path} is not used, because no M501 loads it" for path in unused]
    return Settings(reader.resolve_variables(), reader.paths, tuple(reader.unread), tuple(remarks))


class _Reader:
    """Reads G-code files, each line once, in the order in which RepRapFirmware does."""

    def __init__(self, codes: Sequence[str], given: Mapping[Path, Path], texts: Mapping[Path, str]):
        self.codes, self.given, self.texts = codes, given, texts
        self.paths, self.unread = list[Path](), list[str]()
        self.words: dict[str, tuple[str, SourceLine]] = {}
        self.variables: dict[str, tuple[str, SourceLine]] = {}

    def read(self, path: Path) -> None:
        if path not in self.paths:
            self.paths.append(path)
        for place, line in read_lines(path, self.texts.get(path)):
            code = parse_settings_line(self.words, place, line, (*self.codes, LOAD))
            if code == LOAD and path.name.lower() != OVERRIDE:
                beside = path.with_name(OVERRIDE)
                found = [self.given.get(beside.resolve(), beside)] if beside.is_file() else []
                found += [given for given in self.given.values() if given.name.lower() == OVERRIDE]
                for override in found[:1]:
                    self.read(override)
                self.unread = self.unread if found else [OVERRIDE]
            if variable := GLOBAL.match(line):  # an indented line may never be reached
                self.variables[variable[1]] = (variable[2], place)

    def resolve_variables(self) -> dict[str, tuple[str, SourceLine]]:
        """Return the words, with the values of the variables that they name."""
        found = dict(self.words)
        for field, (text, _) in self.words.items():
            if (used := USE.fullmatch(text)) and used[1] in self.variables:
                found[field] = self.variables[used[1]]
        return found


def read_scale(stated: Settings) -> Array | None:
    """Return the steps (3,) of the motors for 1 m of a carriage; None if M92 does not state all."""
    if any(field not in stated for field in STEPS_FIELDS):
        return None
    return np.array([stated.number(f, "steps per mm", low=1e-3) / MM for f in STEPS_FIELDS])


def parse_settings_line(
    texts: dict[str, tuple[str, SourceLine]], place: SourceLine, line: str, codes: Sequence[str]
) -> str | None:
    """Add a line's words to `texts`; return the command if it is one of `codes`."""
    found = COMMAND.match(re.sub(r"\([^)]*\)|;.*", "", line))
    code = found[1].upper() if found else ""
    if code == "G20":
        raise place.error("unit", "G20", "millimetres (G21)")
    if code not in codes or not found:
        return None
    for word in PARTED.sub("", CHECKSUM.sub("", found[2])).split():
        whole = re.findall(r"[A-Za-z][^A-Za-z]*", word) if GLUED.fullmatch(word) else [word]
        texts |= {f"{code} {each[0].upper()}": (each[1:], place) for each in whole}
    return code
