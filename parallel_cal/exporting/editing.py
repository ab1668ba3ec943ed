"""Numbers in somebody's configuration: each where it counts, comments and order kept."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path

from parallel_cal.base.errors import ModelError
from parallel_cal.base.files import read_text
from parallel_cal.importing.sections import SAVE_CONFIG_PREFIX
from parallel_cal.importing.settings import Settings


def format_settings(settings: Mapping[str, str]) -> str:
    """A file with these settings alone: fields `M665 L`, `[section] key`, `$641` or `pin.name`."""
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
    stated: Settings, settings: Mapping[str, str], files: Sequence[Path]
) -> dict[Path, str]:
    """The texts of `files` with these settings: where one was stated last, else beside its
    neighbours, else at the last file's end."""
    lines = {path: read_verbatim(path).splitlines(keepends=True) for path in files}
    places = {field: (place.path, place.line - 1) for field, (_, place) in stated.texts.items()}
    for field, value in settings.items():
        path, k = places.get(field) or _neighbour(field, places) or (None, 0)
        if path is None:
            end = lines[files[-1]]
            end.append(
                ("" if not end or end[-1].endswith("\n") else "\n")
                + format_settings({field: value})
            )
            path, k = files[-1], len(end) - 1
        elif field in stated:
            lines[path][k] = _replace_value(lines[path][k], field, stated.texts[field][0], value)
        else:
            lines[path][k] = _insert_setting(lines[path][k], field, value)
        places[field] = (path, k)
    return {path: "".join(text) for path, text in lines.items()}


def read_verbatim(path: Path) -> str:
    """The text of a file, its line ends kept."""
    read_text(path)  # which refuses what is no plain file
    with path.open(encoding="utf-8", newline="") as stream:
        return stream.read()


def _head(field: str) -> str:
    """`M665`, `[section]`, `$`, or the pin's component: what stands together."""
    return re.match(r"\[[^\]]*\]|[GM]\d+(?= )|\$|[^.]*", field)[0]  # type: ignore[index]


def _key(field: str) -> str:
    return field.removeprefix(_head(field)).strip() if field[0] in "[GM" else field


def _line(field: str, value: str) -> str:
    """How a setting is written, without what stands before it in its line or section."""
    if field[0] in "GM":
        return _key(field) + value
    if field[0] == "[":
        return f"{_key(field)} = {value}"
    return f"{field}={value}" if field[0] == "$" else f"setp {field} {value}"


def _neighbour(field: str, places: Mapping[str, tuple[Path, int]]) -> tuple[Path, int] | None:
    """The last place of a setting that stands with this one."""
    near = [place for other, place in places.items() if _head(other) == _head(field)]
    return near[-1] if near else None


def _replace_value(line: str, field: str, old: str, new: str) -> str:
    """With another value at the last place of a line that is no comment."""
    begins = "" if field[0] == "$" else r"(?<![\w.])"
    signal = re.match(r"\s*sets\s+(\S+)", line)  # of LinuxCNC, led to the pin
    key = re.escape(signal[1] if signal else _key(field))
    pattern = rf"(?i){begins}{key}(\s*[:=]?\s*){re.escape(old)}(?![\w.])"
    comment = r"\([^)]*\)|;.*" if field[0] in "GM" else r"(?<=\s)[#;].*"
    code = re.sub(comment, lambda found: " " * len(found[0]), line)
    places = [*re.finditer(pattern, code)]
    if not places:
        raise ModelError(f"'{line.strip()}': {field} is not in this line")
    return line[: places[-1].end() - len(old)] + new + line[places[-1].end() :]


def _insert_setting(line: str, field: str, value: str) -> str:
    """A word more in a command, or a line more after this one."""
    if field[0] in "GM":
        command, comment = re.fullmatch(r"([^;(\r\n]*?)(\s*(?:[;(].*)?\s*)", line, re.S).groups()  # type: ignore[union-attr]
        return f"{command} {_line(field, value)}{comment}"
    saved = f"{SAVE_CONFIG_PREFIX} " if line.startswith(SAVE_CONFIG_PREFIX) else ""
    end = "\r\n" if line.endswith("\r\n") else "\n"
    return line.rstrip("\r\n") + end + saved + _line(field, value) + end
