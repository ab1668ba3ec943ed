"""Notices when a file was written, replaced or became another one."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from threading import Event, Lock, Thread

DEBOUNCE = 0.15  # s between two looks; a change counts when the next look finds nothing newer

State = tuple[int, ...] | None  # None where there is no file


class FileWatch:
    """Calls `changed()` from a thread of its own, once the watched file has been left alone.

    The file is looked at again and again: notices from its folder would end with the folder, and
    tell nothing of a linked folder pointed elsewhere or of a file written on another machine.
    """

    def __init__(self, changed: Callable[[], None]):
        self._changed = changed
        self._path: str | Path | None = None
        self._known: State = None
        self._seen: State = None
        self._lock, self._ended = Lock(), Event()
        self._thread = Thread(target=self._run, daemon=True)
        self._thread.start()

    def watch(self, path: str | Path | None) -> None:
        """Watch this file instead, which may be yet to come (None: nothing)."""
        with self._lock:
            if path != self._path:
                self._path, self._known = path, _state(path)

    def stop(self) -> None:
        """Watch nothing any more."""
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._ended.wait(DEBOUNCE):
            if self._has_settled_change():
                self._changed()

    def _has_settled_change(self) -> bool:
        """Whether the file is another one than known, or gone, and the same as at the last look."""
        with self._lock:
            before, self._seen = self._seen, _state(self._path)
            if self._seen != before or self._seen == self._known:
                return False
            self._known = self._seen
            return True


def _state(path: str | Path | None) -> State:
    """What changes with the content or with the file that a path leads to."""
    if path is None:
        return None
    try:
        found = os.stat(path)
    except OSError:
        return None
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns
