"""Notices when a file was written, replaced or moved into place."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from threading import Lock, Timer
from typing import Any

from watchdog.events import FileSystemEvent, FileSystemEventHandler
from watchdog.observers import Observer

# Opening and reading are events too: only those that change the content count.
CHANGES = ("created", "modified", "moved", "closed")
DEBOUNCE = 0.15  # s of quiet: editors write in several steps


class FileWatch(FileSystemEventHandler):
    """Calls `changed()` from a thread of its own, once the watched file has been left alone.

    The folder is watched, not the file: an atomic replacement leaves an old file behind.
    """

    def __init__(self, changed: Callable[[], None]):
        self._changed = changed
        self._observer: Any = None
        self._names: set[str] = set()
        self._path: Path | None = None
        self._timer: Timer | None = None
        self._lock = Lock()

    def watch(self, path: str | Path | None) -> bool:
        """Watch this file instead (None: nothing); whether its folder exists to be watched."""
        wanted = Path(path).absolute() if path else None
        if wanted is not None and wanted == self._path:
            return True
        self.stop()
        if wanted is None or not wanted.parent.is_dir():
            return wanted is None
        observer = Observer()
        # A link may be pointed elsewhere, or the file behind it be replaced.
        places = {wanted, wanted.resolve()}
        for folder in {place.parent for place in places if place.parent.is_dir()}:
            observer.schedule(self, str(folder))
        self._names = {str(place) for place in places}
        observer.daemon = True
        observer.start()
        self._path, self._observer = wanted, observer
        return True

    @property
    def idle(self) -> bool:
        """Nothing is watched."""
        return self._path is None

    def stop(self) -> None:
        """Watch nothing any more."""
        with self._lock:
            if self._timer is not None:
                self._timer.cancel()
        if self._observer is not None:
            self._observer.stop()
            self._observer.join(1.0)
        self._path, self._observer = None, None

    def on_any_event(self, event: FileSystemEvent) -> None:
        """Called by watchdog for everything in the folder."""
        if event.event_type not in CHANGES:
            return
        if not self._names & {str(event.src_path), str(event.dest_path)}:
            return
        with self._lock:
            if self._timer is not None:
                self._timer.cancel()
            self._timer = Timer(DEBOUNCE, self._changed)
            self._timer.daemon = True
            self._timer.start()
