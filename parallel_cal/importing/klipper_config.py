"""Klipper's configuration: sections of `key: value`, with the precedence that Klipper gives them.

The last of two equal options counts. An `[include FILE]` is read at its place, relative to the file
that includes it. What SAVE_CONFIG wrote at the end counts only for options that the main part does
not state, and not at all if other text stands below it. Source: Klipper klippy/configfile.py
(84104bbbd, August 2026), which parses with the same library.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from configparser import MissingSectionHeaderError, ParsingError, RawConfigParser
from glob import glob
from pathlib import Path

from parallel_cal.base.errors import DatasetError
from parallel_cal.importing.settings import Settings, SourceLine, read_lines

SAVE_CONFIG_PREFIX = "#*#"  # before every line that Klipper's SAVE_CONFIG wrote
SAVE_CONFIG_HEADER = [
    "#*# <---------------------- SAVE_CONFIG ---------------------->",
    "#*# DO NOT EDIT THIS BLOCK OR BELOW. The contents are auto-generated.",
    "#*#",
]
COMMENT = re.compile(r"#.*|(?:^|(?<=\s));.*")
INCLUDE = "include "
MARK = "\0"  # between a line and its number: the library returns values without their lines

Line = tuple[SourceLine, str]


def settings(paths: Sequence[Path], texts: Mapping[Path, str] | None = None) -> Settings:
    """Read the values by `[section] key` of a configuration, with the files that it includes.

    An included file that is not at its place may be among `paths`. `texts` replace those of files.
    Raise DatasetError if no file of `paths` includes all others: Klipper would not read them.
    """
    given, others = {path.resolve(): path for path in paths}, []
    for main in paths:
        reader = _Reader(given, texts or {})
        found = reader.read(main)
        if set(paths) <= set(reader.paths):
            return found
        others.append([path for path in paths if path not in reader.paths])
    raise DatasetError(
        f"{others[0][0]}: {paths[0]} does not include it, so Klipper does not read it: leave it "
        f"out, or write [include {others[0][0].name}] into {paths[0].name}"
    )


class _Reader:
    """Reads a configuration file and the files that it includes into one parser."""

    def __init__(self, given: Mapping[Path, Path], texts: Mapping[Path, str]):
        self.given, self.texts = given, texts
        self.paths: list[Path] = []
        self.unread: list[str] = []
        self.remarks: list[str] = []
        self.lines: list[SourceLine] = []  # of which the marks are the indices
        self.config = RawConfigParser(strict=False)

    def read(self, main: Path) -> Settings:
        lines = self._open(main)
        regular, saved, below = split_saved(lines)
        self._add(main, regular, [main.resolve()])
        if below is not None:
            self.remarks.append(
                f"{main}: the SAVE_CONFIG block is not read, because line {below.line} does not "
                "belong to it: Klipper then ignores the whole block. Move it above the block"
            )
        self._add_saved(saved)
        values = {
            f"[{section}] {option}": self._value(text)
            for section in self.config.sections()
            for option, text in self.config.items(section)
        }
        return Settings(values, self.paths, tuple(self.unread), tuple(self.remarks))

    def _open(self, path: Path) -> list[Line]:
        if path not in self.paths:
            self.paths.append(path)
        return read_lines(path, self.texts.get(path))

    def _add(self, path: Path, lines: Sequence[Line], including: Sequence[Path]) -> None:
        """Add lines; a file that is included twice is read twice, at both places."""
        part = list[Line]()
        for place, line in lines:
            header = RawConfigParser.SECTCRE.match(COMMENT.sub("", line))
            if not header or not header["header"].startswith(INCLUDE):
                part.append((place, line))
                continue
            self._parse(self.config, part)
            part = []
            name = header["header"].removeprefix(INCLUDE).strip()
            for file in self._find(path, name):
                if file.resolve() in including:
                    raise place.error("[include]", name, "a file that does not include this one")
                self._add(file, self._open(file), [*including, file.resolve()])
        self._parse(self.config, part)

    def _find(self, path: Path, name: str) -> list[Path]:
        """Return the included files: those at their place, else given ones of the same name."""
        found = [Path(file) for file in sorted(glob(str(path.parent / name)))]
        found = [self.given.get(file.resolve(), file) for file in found if file.is_file()]
        if not found:
            moved = (f for f in self.given.values() if f.match(name) or f.name == Path(name).name)
            found = [file for file in moved if file != path]
        if not found:
            self.unread.append(name)
        return found

    def _add_saved(self, lines: Sequence[Line]) -> None:
        """Add the options that SAVE_CONFIG wrote, except those that the main part states."""
        saved, hidden = RawConfigParser(strict=False), list[str]()
        self._parse(saved, [(place, line[len(SAVE_CONFIG_PREFIX) + 1 :]) for place, line in lines])
        for section in saved.sections():
            for option, text in saved.items(section):
                if not self.config.has_option(section, option):
                    if not self.config.has_section(section):
                        self.config.add_section(section)
                    self.config.set(section, option, text)
                elif self._value(text)[0] != self._value(self.config.get(section, option))[0]:
                    hidden.append(f"[{section}] {option}")
        if hidden:
            self.remarks.append(
                f"{lines[0][0].path}: SAVE_CONFIG's values of {', '.join(hidden)} are not used: "
                "like Klipper, this reads the values that the main part states for them"
            )

    def _parse(self, config: RawConfigParser, lines: Sequence[Line]) -> None:
        """Parse lines without comments, each with its index in `self.lines` behind it."""
        marked = []
        for place, line in lines:
            plain = COMMENT.sub("", line).rstrip()
            marked.append(f"{plain}{MARK}{len(self.lines)}\n" if plain else "\n")
            self.lines.append(place)
        try:
            config.read_file(marked)
        except MissingSectionHeaderError as error:
            place, line = lines[error.lineno - 1]
            expected = "[section] above it; an [include] ends the section before it"
            raise place.error("the line", line.strip(), expected) from None
        except ParsingError as error:
            place, line = lines[error.errors[0][0] - 1]
            raise place.error("the line", line.strip(), "[section] or key: value") from None

    def _value(self, text: str) -> tuple[str, SourceLine]:
        """Return a value without marks, and the last of its lines that has text."""
        pieces = [line.partition(MARK) for line in text.splitlines() if MARK in line]
        stated = [piece for piece in pieces if piece[0].strip()] or pieces[:1]
        words = " ".join(piece[0].strip() for piece in stated)
        return words, self.lines[int(stated[-1][2])]


def split_saved(lines: Sequence[Line]) -> tuple[Sequence[Line], Sequence[Line], SourceLine | None]:
    """Split a configuration into its main part and the lines of its SAVE_CONFIG block.

    If Klipper ignores the block, all lines are main part, and the last value is the line that
    makes it so.
    """
    texts = [line for _, line in lines]
    starts = [k for k in range(1, len(texts) - 2) if texts[k : k + 3] == SAVE_CONFIG_HEADER]
    start = starts[0] if starts else len(texts)
    block = list(lines[start + len(SAVE_CONFIG_HEADER) :])
    while block and not block[-1][1].strip():
        block.pop()
    while block and not block[0][1].strip():
        block.pop(0)
    wrong = [k for k in range(1, start) if texts[k].startswith(f"{SAVE_CONFIG_PREFIX} ")]
    bad = [lines[k] for k in [*wrong, *starts[1:]]]
    bad += [each for each in block if each[1][:4] not in (SAVE_CONFIG_PREFIX, "#*# ")]
    if not bad:
        return lines[:start], block, None
    return lines, [], next((place for place, line in bad if line.strip()), bad[0][0])
