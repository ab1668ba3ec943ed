"""The .ini files of LinuxCNC: sections of `key = value`.

Source: LinuxCNC 2.9.9 (src/libnml/inifile/inifile.cc, scripts/linuxcnc.in) and its successor of
August 2026 (5c41560ebb, src/emc/ini/inifile.cc).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from parallel_cal.importing.settings import Settings, SourceLine, read_lines

INCLUDE = "#INCLUDE"


def settings(paths: Sequence[Path]) -> Settings:
    """Read values by `[section] key`, as LinuxCNC finds them: the first of two equal ones counts.

    `#INCLUDE FILE` at the begin of a line is read at its place, relative to the file with it.
    """
    texts: dict[str, tuple[str, SourceLine]] = {}
    read, unread = list[Path](), list[str]()
    for path in paths:
        if path not in read:
            _add(path, "", texts, read, unread)
    return Settings(texts, read, tuple(unread))


def _add(
    path: Path,
    section: str,
    texts: dict[str, tuple[str, SourceLine]],
    read: list[Path],
    unread: list[str],
) -> str:
    """Add the values of a file that begins in a section; return the section where it ends."""
    read.append(path)
    for place, line in read_lines(path):
        if line.startswith(INCLUDE):
            name = line.removeprefix(INCLUDE).strip()
            file = path.parent / Path(name).expanduser()
            if not file.is_file():
                unread.append(name)
            elif file in read:
                raise place.error(INCLUDE, name, "a file that is not read yet")
            else:
                section = _add(file, section, texts, read, unread)
            continue
        plain = re.split(r"(?:^|\s)[#;]", line, maxsplit=1)[0].strip()
        if not plain:
            continue
        if header := re.fullmatch(r"\[([^\]]+)\]", plain):
            section = header[1].strip()
            continue
        pair = re.fullmatch(r"([^=]+)=(.*)", plain)
        if not pair or not section:
            raise place.error("the line", line.strip(), "[section] or key = value")
        texts.setdefault(f"[{section}] {pair[1].strip()}", (pair[2].strip(), place))
    return section
