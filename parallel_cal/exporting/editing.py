"""Edit values in configuration files, and keep comments and order."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path

import numpy as np

from parallel_cal.base.errors import ModelError
from parallel_cal.base.files import read_text
from parallel_cal.importing.gcode import COMMANDS
from parallel_cal.importing.klipper_config import SAVE_CONFIG_PREFIX
from parallel_cal.importing.settings import Settings

# A line may state a value under another name: a signal that leads to the pin, or a key of an .ini
# file (LinuxCNC), or a global variable (RepRapFirmware).
VARIABLE = re.compile(r"\s*sets\s+(\S+)|(?:set\s+)?global[\s.]\s*(\w+)\s*=|\s*([A-Za-z_]\w*)\s*=")

EQUALS = " = "  # between the key and the value of `[section] key`
DEFINITIONS = ("DELTA_", "DEFAULT_")  # beginnings of names in Configuration.h


def format_number(value: float, decimals: int) -> str:
    """Format a number with fixed decimals, and zero without a sign."""
    return f"{np.round(value, decimals) + 0.0:.{decimals}f}"


def format_settings(settings: Mapping[str, str]) -> str:
    """Format a file of settings; fields are `M665 L`, `[section] key`, `$641`, `pin.name`,
    `section/section/key` or `/key` (YAML) or, of a file of `key value`, `key`."""
    found = []
    for head, group in groupby(settings, _head):
        fields = list(group)
        if re.fullmatch(r"[GM]\d+.*", head):
            found.append(" ".join([head, *(_line(f, settings[f]) for f in fields)]))
        elif "/" in head:
            names = head.split("/")
            found += ["  " * k + f"{name}:" for k, name in enumerate(names)]
            found += ["  " * len(names) + _line(f, settings[f]) for f in fields]
        else:
            section = [head] if head.startswith("[") else []
            found += [*section, *(_line(f, settings[f]) for f in fields)]
    return "\n".join(found) + "\n"


def edit_files(
    stated: Settings, groups: Sequence[tuple[Mapping[str, str], Sequence[Path]]]
) -> dict[Path, str]:
    """Return the texts of files with new settings; each group has the files for its new ones.

    A setting replaces its last value, in whatever file, unless this is the same number in other
    digits. A new one is inserted next to settings of the same command or section in one of the
    group's files, or at the end of its last file, above what SAVE_CONFIG wrote.
    """
    places = {field: (place.path, place.line - 1) for field, (_, place) in stated.texts.items()}
    lines = {path: read_verbatim(path).splitlines(keepends=True) for path in stated.paths}
    appended = list[tuple[Path, str]]()
    for settings, files in groups:
        apart = dict[str, str]()
        for field, value in settings.items():
            if field in stated:
                old, (path, k) = stated.texts[field][0], places[field]
                if not are_same_numbers(old, value):
                    lines[path][k] = _replace_value(lines[path][k], field, old, value)
                continue
            near = [f for f in places if _head(f) == _head(field) and places[f][0] in files]
            if near:
                path, k = places[near[-1]]
                begin, equals = _find_style(lines[path][: k + 1], near[-1])
                lines[path][k] = _insert_setting(lines[path][k], field, value, begin, equals)
            else:
                apart[field] = value
        if apart:
            appended.append((files[-1], format_settings(apart)))
    for path, text in appended:
        own = lines[path]
        saved = (k for k, line in enumerate(own) if line.startswith(SAVE_CONFIG_PREFIX))
        k = next(saved, len(own))
        if k and not own[k - 1].endswith("\n"):
            own[k - 1] += "\n"
        own.insert(k, text)
    return {path: "".join(text) for path, text in lines.items()}


def _find_style(lines: Sequence[str], field: str) -> tuple[str, str]:
    """Return what stands before the key of a setting, whose value is on the last of the lines, and
    what stands between the key and the value."""
    if field[0] != "[" and not _is_of_yaml(field):
        return "", EQUALS
    key = re.compile(rf"(?im)^((?:#\*# )?[ \t]*){re.escape(_key(field))}([ \t]*[:=][ \t]*)")
    found = next((found for line in reversed(lines) if (found := key.search(line))), None)
    if found is None:
        return "", EQUALS
    return found[1], found[2] if found[2][-1].isspace() else f"{found[2]} "


def read_verbatim(path: Path) -> str:
    """Read the text of a file with its line ends."""
    read_text(path)  # refuses anything but a plain file
    with path.open(encoding="utf-8", newline="") as stream:
        return stream.read()


def _is_of_yaml(field: str) -> bool:
    return "/" in field and field[0] != "["


def _head(field: str) -> str:
    """Return the group of a field: `M665`, `M206 T3 P881`, `[section]`, `$`, `DELTA_` (C), the
    component of a pin, the sections of YAML, or nothing for all keys of a file of `key value`."""
    if _is_of_yaml(field):
        return field.rpartition("/")[0]
    defined = "|".join(DEFINITIONS)
    return re.match(rf"\[[^\]]*\]|[GM]\d+(?: T\d P\d+)?(?= )|\$|{defined}|[^.]*(?=\.)|", field)[0]  # type: ignore[index]


def sets_stored_value(field: str) -> bool:
    """Return whether a field is a word of a command or a setting `$641`: controllers store them."""
    return re.match(r"\$|[GM]\d+ ", field) is not None


def _key(field: str) -> str:
    if _is_of_yaml(field):
        return field.rpartition("/")[2]
    return field.removeprefix(_head(field)).strip() if field[0] in "[GM" else field


def _line(field: str, value: str, equals: str = EQUALS) -> str:
    """Format a setting without its command or section."""
    if field[0] in "GM":
        return _key(field) + value
    if field[0] == "[":
        return f"{_key(field)}{equals}{value}"
    if field.startswith(DEFINITIONS):
        return f"#define {field} {value}"
    if _is_of_yaml(field):
        return f"{_key(field)}: {value}"
    if field[0] == "$":
        return f"{field}={value}"
    return f"setp {field} {value}" if "." in field else f"{field} {value}"


def are_same_numbers(old: str, new: str) -> bool:
    """Return whether two texts are the same numbers, such as `1:2:3`; `1` stands for `1:1:1`."""
    try:
        before, after = (
            [float(word) for word in re.split("[:,]", text.strip("{} "))] for text in (old, new)
        )
    except ValueError:
        return False
    return (before * len(after) if len(before) == 1 else before) == after


def _replace_value(line: str, field: str, old: str, new: str) -> str:
    """Replace a field's value at each place in a line outside comments."""
    begins = "" if field[0] == "$" else r"(?<![\w.])"
    stated = VARIABLE.match(line)
    if stated and stated[2]:
        if len({*new.split(":")}) > 1:
            raise ModelError(
                f"'{line.strip()}': {field} needs several numbers, {new}; write {old} in place of "
                "the variable first"
            )
        new = new.split(":")[0]
    key = re.escape(next(filter(None, stated.groups())) if stated else _key(field))
    if field[0] == "[" and not re.search(rf"(?i){begins}{key}\s*[:=]", line):
        key = ""  # the value is on a line of its own
    pattern = rf"(?i){begins}{key}(\s*[:=]?\s*){re.escape(old)}(?![\w.])"
    comment = r"\([^)]*\)|;.*" if field[0] in "GM" else r"(?<!^)(?<!^#\*)#.*|(?<=\s);.*"
    if field.startswith(DEFINITIONS):
        comment = r"//.*"
    code = re.sub(comment, lambda found: " " * len(found[0]), line)

    def find_ends(*parts: tuple[int, int]) -> list[int]:
        return [one.end() for part in parts for one in re.compile(pattern).finditer(code, *part)]

    ends: list[int] = []
    if field[0] in "GM" and not stated:  # a line may hold several commands
        own = re.compile(rf"{_head(field)}(?!\d)", re.IGNORECASE)
        ends = find_ends(*(part.span() for part in COMMANDS.finditer(code) if own.match(part[0])))
    # Some firmwares have a word G: to them, a line is one command.
    ends = ends or find_ends((0, len(code)))
    if not ends:
        raise ModelError(f"'{line.strip()}': {field} is not in this line")
    for end in reversed(ends):
        line = line[: end - len(old)] + new + line[end:]
    return line


def _insert_setting(line: str, field: str, value: str, begin: str, equals: str) -> str:
    """Add a word to a command, or a line after this one that has `begin` before its key."""
    if field[0] in "GM":
        command, comment = re.fullmatch(r"([^;(\r\n]*?)(\s*(?:[;(].*)?\s*)", line, re.S).groups()  # type: ignore[union-attr]
        return f"{command} {_line(field, value)}{comment}"
    end = "\r\n" if line.endswith("\r\n") else "\n"
    return line.rstrip("\r\n") + end + begin + _line(field, value, equals) + end
