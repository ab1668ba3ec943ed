"""Settings in sections of `key = value` or `key: value`, as in the .ini files of LinuxCNC."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from parallel_cal.importing.settings import Settings, SourceLine, read_lines


def settings(paths: Sequence[Path]) -> Settings:
    """Read values by `[section] key`; the last of two equal ones counts."""
    texts: dict[str, tuple[str, SourceLine]] = {}
    for path in paths:
        section = ""
        for place, line in read_lines(path):
            plain = re.split(r"(?:^|\s)[#;]", line, maxsplit=1)[0]
            if not plain.strip() or plain[0].isspace():
                continue
            if header := re.fullmatch(r"\[([^\]]+)\]", plain.strip()):
                section = header[1].strip()
                continue
            pair = re.fullmatch(r"([^:=]+)[:=](.*)", plain)
            if not pair or not section:
                raise place.error("the line", line.strip(), "[section] or key: value")
            texts[f"[{section}] {pair[1].strip()}"] = (pair[2].strip(), place)
    return Settings(texts, paths)
