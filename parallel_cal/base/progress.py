"""How long computations report their progress."""

from __future__ import annotations

from collections.abc import Callable

# Called with the present stage in words and the completed share, 0 to 1. A callback may raise:
# the work then ends with that exception, which is how it is cancelled.
Progress = Callable[[str, float], None]


def ignore_progress(stage: str, fraction: float) -> None:
    """Ignore the progress report."""
