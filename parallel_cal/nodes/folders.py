"""Which files a request may name: those in folders that whoever started the node has allowed."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.base.files import PREVIOUS
from parallel_cal.nodes.parameters import absolute

MARKS = {"model": b"parallel_cal:", "samples": b'"parallel_cal_samples"'}
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
        real = Path(os.path.realpath(named))
        if not any(real == folder or folder in real.parents for folder in self._allowed):
            listed = ", ".join(map(str, self._allowed)) or "none"
            raise ParallelCalError(
                f"{path}: not in a folder that requests may use (allowed_folders: {listed})"
            )
        return named

    def to_write(self, path: str, kind: str) -> str:
        """The same, and it replaces nothing but a file of the same `kind`, model or samples; nor
        does the model file that is laid aside for it."""
        for one in (path, path + PREVIOUS) if kind == "model" else (path,):
            named = Path(self.to_read(one))
            if os.path.lexists(named) and not _holds(named, MARKS[kind]):
                raise ParallelCalError(f"{one}: exists and is no {kind} file; nothing was written")
        return self.to_read(path)


def _holds(path: Path, mark: bytes) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        return mark in stream.read(HEAD)
