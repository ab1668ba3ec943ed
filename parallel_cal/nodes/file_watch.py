"""Detect when a file was written or replaced, or when its link leads to another file."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from threading import Event, Lock, Thread

DEBOUNCE = 0.15  # s between two polls; a change counts once two polls agree

State = tuple[int, ...] | None  # None if there is no file


class FileWatch:
    """Calls `changed()` from its own thread once the watched file has changed and is stable.

    It polls the file. Notifications of the folder would end with the folder, and they would miss a
    link that changes its target and a file that another machine writes.
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
        """Watch this file from now on, even if it does not exist yet (None: no file)."""
        with self._lock:
            if path != self._path:
                self._path, self._known = path, _state(path)

    def stop(self) -> None:
        """Stop watching and end the thread."""
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._ended.wait(DEBOUNCE):
            if self._has_settled_change():
                self._changed()

    def _has_settled_change(self) -> bool:
        """Poll once; return whether the file has changed and is the same as at the last poll."""
        with self._lock:
            before, self._seen = self._seen, _state(self._path)
            if self._seen != before or self._seen == self._known:
                return False
            self._known = self._seen
            return True


def _state(path: str | Path | None) -> State:
    """Return numbers that change with the content of the file or with the file itself."""
    if path is None:
        return None
    try:
        found = os.stat(path)
    except OSError:
        return None
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns
