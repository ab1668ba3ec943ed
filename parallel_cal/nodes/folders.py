"""Limit the files that a request may name to folders that the owner of the node allowed."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.files import BACKUP_SUFFIX
from parallel_cal.nodes.parameters import absolute

MARKS = {"model": b"parallel_cal:", "samples": b'"parallel_cal_samples"'}
ENDINGS = {"model": (".yaml", ".yml"), "samples": (".json",)}
HEAD = 4096  # bytes at the start of a file in which its mark must lie


class Folders:
    """The folders that requests may use.

    A request may come from any machine on the network, but the parameters at the start come only
    from the owner of the node. Links are resolved before a file is checked.
    """

    def __init__(self, listed: str, usual: Iterable[str | Path]):
        """Allow the folders in `listed` (separated by colons), or else the `usual` ones."""
        given = [absolute(folder) for folder in listed.split(os.pathsep) if folder]
        self._allowed = [Path(os.path.realpath(f)) for f in given or map(str, usual)]

    def to_read(self, path: str) -> str:
        """Return the absolute path; raise ParallelCalError if it is outside all folders."""
        named = absolute(path)
        if not self._places(named):
            listed = ", ".join(map(str, self._allowed)) or "none"
            raise ParallelCalError(
                f"{path}: not in a folder that requests may use (allowed_folders: {listed})"
            )
        return named

    def to_write(self, path: str, kind: str) -> str:
        """Return the absolute path of a file that may be written.

        The file may replace only a file of the same `kind`, model or samples. A model file is
        written with a backup, which may replace only a model file.

        The path must end as its kind does and must not be hidden. Both hold for the path itself and
        for the file that it leads to. A request determines part of the content, such as the name of
        a frame, and a shell executes some files because of their name, such as `.bash_profile`.

        Raises
        ------
        ParallelCalError
            If the file must not be written.
        """
        for one in (path, path + BACKUP_SUFFIX) if kind == "model" else (path,):
            there = Path(self.to_read(one))
            if os.path.lexists(there) and not _has_mark(there, MARKS[kind]):
                raise ParallelCalError(
                    f"{one}: exists and is not a {kind} file; nothing was written"
                )
        named = self.to_read(path)
        names = Path(named).name, os.path.basename(os.path.realpath(named))
        if not all(name.endswith(ENDINGS[kind]) for name in names):
            expected = " or ".join(ENDINGS[kind])
            raise ParallelCalError(
                f"{path}: a {kind} file's name must end in {expected}; nothing was written"
            )
        visible = [p for p in self._places(named) if not any(n.startswith(".") for n in p.parts)]
        if names[0].startswith(".") or not visible:
            raise ParallelCalError(
                f"{path}: a {kind} file must not be hidden or lie in a hidden folder, so no name "
                "may begin with a dot; nothing was written"
            )
        return named

    def _places(self, named: str) -> list[Path]:
        """Return the path of a file relative to each allowed folder that contains it."""
        real = Path(os.path.realpath(named))
        return [real.relative_to(f) for f in self._allowed if real.is_relative_to(f)]


def _has_mark(path: Path, mark: bytes) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        return mark in stream.read(HEAD)
