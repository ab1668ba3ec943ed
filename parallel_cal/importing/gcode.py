"""Settings in G-code: words of commands, of which later commands replace those of earlier ones."""

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
HOME_OFFSETS = tuple(f"M206 {axis}" for axis in "XYZ")  # added to the position when homed
LOAD, OVERRIDE = "M501", "config-override.g"  # which M500 writes
MACRO = "M98"  # runs the file that P names
# A command of RepRapFirmware ends where the next G or M begins outside quotes and expressions.
COMMANDS = re.compile(r"""[GM](?:\{[^}]*\}|"[^"]*"|[^GM{"])*""", re.IGNORECASE)
FREE_TEXT = {"M23", "M28", "M30", "M32", "M36", "M38", "M117"}  # the rest of the line is text
COMMAND = re.compile(r"\s*(?:N\d+\s*)?([GM]\d+)(?![\d.])(.*)", re.IGNORECASE)


def settings(
    paths: Sequence[Path], codes: Sequence[str], texts: Mapping[Path, str] | None = None
) -> Settings:
    """Read the words of some commands in G-code files, by fields such as `M665 L`.

    RepRapFirmware reads config-override.g where another file has M501, and never without it, and
    the file that M98 names at its place (GCodes2.cpp, 3.5.3). A word such as `R{global.radius}` has
    the value and the line of the global variable. `texts` replace those of files.
    """
    reader = _Reader(codes, {path.resolve(): path for path in paths}, texts or {})
    overrides = [path for path in paths if path.name.lower() == OVERRIDE]
    for path in paths if len(overrides) == len(paths) else (p for p in paths if p not in overrides):
        if path not in reader.paths:
            reader.read(path)
    unused = [path for path in overrides if path not in reader.paths]
    remarks = [f"{path} is not used, because no M501 loads it" for path in unused]
    return Settings(reader.resolve_variables(), reader.paths, tuple(reader.unread), tuple(remarks))


class _Reader:
    """Reads G-code files, each line once, in the order in which RepRapFirmware does."""

    def __init__(self, codes: Sequence[str], given: Mapping[Path, Path], texts: Mapping[Path, str]):
        self.codes, self.given, self.texts = codes, given, texts
        self.paths, self.unread = list[Path](), list[str]()
        self.running = list[Path]()  # the file that is read, below those that run it
        self.words: dict[str, tuple[str, SourceLine]] = {}
        self.variables: dict[str, tuple[str, SourceLine]] = {}

    def read(self, path: Path) -> None:
        if path not in self.paths:
            self.paths.append(path)
        self.running.append(path)
        for place, line in read_lines(path, self.texts.get(path)):
            for command in split_commands(line):
                codes = (*self.codes, LOAD)
                code = parse_settings_line(self.words, place, command, codes, first_counts=True)
                if code == LOAD and path.name.lower() != OVERRIDE:
                    self._run(path, OVERRIDE)
                elif macro := re.match(rf"{MACRO}\s*P\s*\"([^\"]+)\"", command, re.IGNORECASE):
                    self._run(path, macro[1])
            if variable := GLOBAL.match(line):  # an indented line may never be reached
                self.variables[variable[1]] = (variable[2], place)
        self.running.pop()

    def _run(self, path: Path, name: str) -> None:
        """Read a file that another one runs: the one beside it, else a given one of this name."""
        short = Path(name).name
        beside = path.with_name(short)
        found = [self.given.get(beside.resolve(), beside)] if beside.is_file() else []
        found += [given for given in self.given.values() if given.name.lower() == short.lower()]
        self.unread = [other for other in self.unread if other != short]
        if not found:
            self.unread.append(short)
        elif found[0] not in self.running:  # files that run each other would never end
            self.read(found[0])

    def resolve_variables(self) -> dict[str, tuple[str, SourceLine]]:
        """Return the words, with the values of the variables that they name."""
        found = dict(self.words)
        for field, (text, _) in self.words.items():
            if (used := USE.fullmatch(text)) and used[1] in self.variables:
                found[field] = self.variables[used[1]]
        return found


def split_commands(line: str) -> list[str]:
    """Return the commands of a line of RepRapFirmware (StringParser.cpp, 3.5.3), without comments.

    >>> split_commands('N3 M665 L250 R125 M666 X{global.mm} ; G1')
    ['M665 L250 R125 ', 'M666 X{global.mm} ']
    """
    plain = re.sub(r"\([^)]*\)|;.*", "", line)
    found = COMMAND.match(plain)
    if not found or found[1].upper() in FREE_TEXT:
        return []
    return COMMANDS.findall(plain[found.start(1) :])


def read_scale(stated: Settings) -> Array | None:
    """Return the steps (3,) of the motors for 1 m of a carriage; None if M92 does not state all."""
    if any(field not in stated for field in STEPS_FIELDS):
        return None
    return np.array([stated.number(f, "steps per mm", low=1e-3) / MM for f in STEPS_FIELDS])


def parse_settings_line(
    texts: dict[str, tuple[str, SourceLine]],
    place: SourceLine,
    line: str,
    codes: Sequence[str],
    first_counts: bool = False,
) -> str | None:
    """Add a line's words to `texts`; return the command if it is one of `codes`.

    Of two words with one letter, Marlin takes the last one and RepRapFirmware the first one.
    """
    found = COMMAND.match(re.sub(r"\([^)]*\)|;.*", "", line))
    code = found[1].upper() if found else ""
    if code == "G20":
        raise place.error("unit", "G20", "millimetres (G21)")
    if code not in codes or not found:
        return None
    words = list[str]()
    for word in PARTED.sub("", CHECKSUM.sub("", found[2])).split():
        words += re.findall(r"[A-Za-z][^A-Za-z]*", word) if GLUED.fullmatch(word) else [word]
    own = dict[str, tuple[str, SourceLine]]()
    for word in words:
        field = f"{code} {word[0].upper()}"
        if not (first_counts and field in own):
            own[field] = word[1:], place
    texts |= own
    return code
