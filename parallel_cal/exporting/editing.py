"""Edit values in configuration files, and keep comments and order."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path

from parallel_cal.base.errors import ModelError
from parallel_cal.base.files import read_text
from parallel_cal.importing.sections import SAVE_CONFIG_PREFIX
from parallel_cal.importing.settings import Settings

# A line may state a value under another name: a signal that leads to the pin, or a key of an .ini
# file (LinuxCNC), or a global variable (RepRapFirmware).
VARIABLE = re.compile(r"\s*sets\s+(\S+)|(?:set\s+)?global[\s.]\s*(\w+)\s*=|\s*([A-Za-z_]\w*)\s*=")

DEFINITIONS = ("DELTA_", "DEFAULT_")  # beginnings of names in Configuration.h


def format_settings(settings: Mapping[str, str]) -> str:
    """Format a file of settings; fields are `M665 L`, `[section] key`, `$641` or `pin.name`."""
    found = []
    for head, group in groupby(settings, _head):
        fields = list(group)
        if re.fullmatch(r"[GM]\d+", head):
            found.append(" ".join([head, *(_line(f, settings[f]) for f in fields)]))
        else:
            section = [head] if head.startswith("[") else []
            found += [*section, *(_line(f, settings[f]) for f in fields)]
    return "\n".join(found) + "\n"


def edit_files(
    stated: Settings, groups: Sequence[tuple[Mapping[str, str], Sequence[Path]]]
) -> dict[Path, str]:
    """Return the texts of files with new settings; each group has the files for its new ones.

    A setting replaces its last value, in whatever file, unless this is the same number in other
    digits. A new one is inserted next to settings of the same command or section, or at the end of
    the group's last file.
    """
    places = {field: (place.path, place.line - 1) for field, (_, place) in stated.texts.items()}
    lines = {path: read_verbatim(path).splitlines(keepends=True) for path in stated.paths}
    for settings, files in groups:
        for field, value in settings.items():
            if field in stated and _are_same_numbers(stated.texts[field][0], value):
                continue
            near = [place for other, place in places.items() if _head(other) == _head(field)]
            path, k = places.get(field) or (near[-1] if near else (None, 0))
            if path is None:
                end = lines[files[-1]]
                end.append(
                    ("" if not end or end[-1].endswith("\n") else "\n")
                    + format_settings({field: value})
                )
                path, k = files[-1], len(end) - 1
            elif field in stated:
                lines[path][k] = _replace_value(
                    lines[path][k], field, stated.texts[field][0], value
                )
            else:
                lines[path][k] = _insert_setting(lines[path][k], field, value)
            places[field] = (path, k)
    return {path: "".join(text) for path, text in lines.items()}


def read_verbatim(path: Path) -> str:
    """Read the text of a file with its line ends."""
    read_text(path)  # refuses anything but a plain file
    with path.open(encoding="utf-8", newline="") as stream:
        return stream.read()


def _head(field: str) -> str:
    """Return the group of a field: `M665`, `[section]`, `$`, `DELTA_` (C), or the component."""
    defined = "|".join(DEFINITIONS)
    return re.match(rf"\[[^\]]*\]|[GM]\d+(?= )|\$|{defined}|[^.]*", field)[0]  # type: ignore[index]


def _key(field: str) -> str:
    return field.removeprefix(_head(field)).strip() if field[0] in "[GM" else field


def _line(field: str, value: str) -> str:
    """Format a setting without its command or section."""
    if field[0] in "GM":
        return _key(field) + value
    if field[0] == "[":
        return f"{_key(field)} = {value}"
    if field.startswith(DEFINITIONS):
        return f"#define {field} {value}"
    return f"{field}={value}" if field[0] == "$" else f"setp {field} {value}"


def _are_same_numbers(old: str, new: str) -> bool:
    """Return whether two texts are the same numbers, such as `1:2:3`; `1` stands for `1:1:1`."""
    try:
        before, after = (
            [float(word) for word in re.split("[:,]", text.strip("{} "))] for text in (old, new)
        )
    except ValueError:
        return False
    return (before * len(after) if len(before) == 1 else before) == after


def _replace_value(line: str, field: str, old: str, new: str) -> str:
    """Replace a field's value at its last place in a line outside comments."""
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
    pattern = rf"(?i){begins}{key}(\s*[:=]?\s*){re.escape(old)}(?![\w.])"
    comment = r"\([^)]*\)|;.*" if field[0] in "GM" else r"(?<=\s)[#;].*"
    if field.startswith(DEFINITIONS):
        comment = r"//.*"
    code = re.sub(comment, lambda found: " " * len(found[0]), line)
    places = [*re.finditer(pattern, code)]
    if not places:
        raise ModelError(f"'{line.strip()}': {field} is not in this line")
    return line[: places[-1].end() - len(old)] + new + line[places[-1].end() :]


def _insert_setting(line: str, field: str, value: str) -> str:
    """Add a word to a command, or a line after this one."""
    if field[0] in "GM":
        command, comment = re.fullmatch(r"([^;(\r\n]*?)(\s*(?:[;(].*)?\s*)", line, re.S).groups()  # type: ignore[union-attr]
        return f"{command} {_line(field, value)}{comment}"
    saved = f"{SAVE_CONFIG_PREFIX} " if line.startswith(SAVE_CONFIG_PREFIX) else ""
    end = "\r\n" if line.endswith("\r\n") else "\n"
    return line.rstrip("\r\n") + end + saved + _line(field, value) + end
