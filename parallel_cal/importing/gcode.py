"""Settings in G-code; the last value of each word counts."""

from __future__ import annotations

import re
from collections.abc import Sequence
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
COMMAND = re.compile(r"\s*(?:N\d+\s*)?([GM]\d+)(?![\d.])(.*)", re.IGNORECASE)


def settings(paths: Sequence[Path], codes: Sequence[str]) -> Settings:
    """Read the words of some commands in G-code files, by fields such as `M665 L`.

    A word such as `R{global.radius}` has the value and the line of the global variable.
    """
    texts: dict[str, tuple[str, SourceLine]] = {}
    variables: dict[str, tuple[str, SourceLine]] = {}
    for path in paths:
        for place, line in read_lines(path):
            parse_settings_line(texts, place, line, codes)
            if found := GLOBAL.match(line):  # an indented line may never be reached
                variables[found[1]] = (found[2], place)
    for field, (text, _) in texts.items():
        if (used := USE.fullmatch(text)) and used[1] in variables:
            texts[field] = variables[used[1]]
    return Settings(texts, paths)


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
