"""Settings in sections of `key: value` or `key = value`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from fnmatch import fnmatch
from pathlib import Path

from parallel_cal.importing.settings import Settings, SourceLine, read_lines

INCLUDE = re.compile(r"include\s+(.+)")  # Klipper: the header of a section without values
SAVE_CONFIG_PREFIX = "#*#"  # before every line that Klipper's SAVE_CONFIG wrote


def settings(paths: Sequence[Path]) -> Settings:
    """Read values by `[section] key`; those that SAVE_CONFIG wrote override the others.

    Files that `[include FILE]` names are read only if they are among the paths.
    """
    texts: dict[str, tuple[str, SourceLine]] = {}
    included: list[str] = []
    for path in paths:
        section, saved = "", False
        for place, line in read_lines(path):
            if line.startswith(SAVE_CONFIG_PREFIX) and not saved:
                section, saved = "", True
            own = line.removeprefix(SAVE_CONFIG_PREFIX).removeprefix(" ") if saved else line
            plain = re.split(r"(?:^|\s)[#;]", own, maxsplit=1)[0]
            if not plain.strip() or plain[0].isspace():  # indented lines belong to macros
                continue
            if header := re.fullmatch(r"\[([^\]]+)\]", plain.strip()):
                section = header[1].strip()
                if include := INCLUDE.fullmatch(section):
                    included.append(include[1])
                continue
            if saved and not section:  # the introduction of the SAVE_CONFIG block
                continue
            pair = re.fullmatch(r"([^:=]+)[:=](.*)", plain)
            if not pair or not section:
                raise place.error("the line", line.strip(), "[section] or key: value")
            texts[f"[{section}] {pair[1].strip()}"] = (pair[2].strip(), place)
    unread = [name for name in included if not any(fnmatch(str(p), f"*{name}") for p in paths)]
    return Settings(texts, paths, tuple(unread))
