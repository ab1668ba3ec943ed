"""The progress reports of long computations."""

from __future__ import annotations

from collections.abc import Callable

# Called with the present stage in words and the completed share, 0 to 1. To cancel the work, the
# callback raises an exception, which ends the work.
Progress = Callable[[str, float], None]


def ignore_progress(stage: str, fraction: float) -> None:
    """Ignore the progress report."""


def never_falling(progress: Progress) -> Progress:
    """A progress report whose share never falls, for work that begins a part again."""
    done = 0.0

    def report(stage: str, fraction: float) -> None:
        nonlocal done
        done = max(done, fraction)
        progress(stage, done)

    return report
