"""Which files a request may name: those in folders that whoever started the node has allowed."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.files import BACKUP_SUFFIX
from parallel_cal.nodes.parameters import absolute

MARKS = {"model": b"parallel_cal:", "samples": b'"parallel_cal_samples"'}
ENDINGS = {"model": (".yaml", ".yml"), "samples": (".json",)}
HEAD = 4096  # bytes in which a file of ours says what it is


class Folders:
    """Requests come from anybody on the network; parameters at the start from who starts the node.

    Links are followed before it is judged where a file lies.
    """

    def __init__(self, listed: str, usual: Iterable[str | Path]):
        """`listed` are folders by colons; where it is empty the `usual` ones are allowed."""
        given = [absolute(folder) for folder in listed.split(os.pathsep) if folder]
        self._allowed = [Path(os.path.realpath(f)) for f in given or map(str, usual)]

    def to_read(self, path: str) -> str:
        """The absolute path; ParallelCalError where it lies elsewhere."""
        named = absolute(path)
        if not self._places(named):
            listed = ", ".join(map(str, self._allowed)) or "none"
            raise ParallelCalError(
                f"{path}: not in a folder that requests may use (allowed_folders: {listed})"
            )
        return named

    def to_write(self, path: str, kind: str) -> str:
        """The same, and it replaces nothing but a file of the same `kind`, model or samples; nor
        does the model file that is laid aside for it.

        A new file has the ending of its kind and is not hidden: a request chooses part of what is
        in it, such as a frame's name, and a shell executes some files for their name alone.
        """
        for one in (path, path + BACKUP_SUFFIX) if kind == "model" else (path,):
            there = Path(self.to_read(one))
            if os.path.lexists(there) and not _holds(there, MARKS[kind]):
                raise ParallelCalError(
                    f"{one}: exists and is not a {kind} file; nothing was written"
                )
        named = self.to_read(path)
        self._check_name(path, named, kind)
        return named

    def _check_name(self, path: str, named: str, kind: str) -> None:
        """ParallelCalError for a hidden file or folder, or an ending of another kind; both of the
        name itself and of the file that it leads to."""
        names = Path(named).name, os.path.basename(os.path.realpath(named))
        if not all(name.endswith(ENDINGS[kind]) for name in names):
            expected = " or ".join(ENDINGS[kind])
            raise ParallelCalError(
                f"{path}: a {kind} file's name must end in {expected}; nothing was written"
            )
        visible = [place for place in self._places(named) if not _is_hidden(place)]
        if names[0].startswith(".") or not visible:
            raise ParallelCalError(
                f"{path}: a {kind} file must not be hidden or lie in a hidden folder, so no name may "
                "begin with a dot; nothing was written"
            )

    def _places(self, named: str) -> list[Path]:
        """Where a file lies below each allowed folder that holds it."""
        real = Path(os.path.realpath(named))
        return [real.relative_to(f) for f in self._allowed if real.is_relative_to(f)]


def _is_hidden(place: Path) -> bool:
    return any(part.startswith(".") for part in place.parts)


def _holds(path: Path, mark: bytes) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        return mark in stream.read(HEAD)
