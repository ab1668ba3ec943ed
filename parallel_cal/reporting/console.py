"""Everything that is printed: documents and tables on stdout, notes on stderr."""

from __future__ import annotations

import json
import signal
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from parallel_cal.base.documents import to_json_value
from parallel_cal.base.progress import Progress
from parallel_cal.reporting.readable import columns

STOPPED = "stopped; what is done is kept, and the same command goes on from there"


def emit(document: Any) -> None:
    """One JSON document on stdout."""
    sys.stdout.write(json.dumps(to_json_value(document), allow_nan=False) + "\n")


def say(text: str) -> None:
    """A line of the answer for people, on stdout."""
    sys.stdout.write(text + "\n")


def note(text: str) -> None:
    """A line beside the answer: progress, warnings; on stderr."""
    sys.stderr.write(text + "\n")


def warn(warnings: Iterable[str]) -> None:
    for text in warnings:
        note(f"warning: {text}")


def error(text: str) -> None:
    """One line, whatever the text."""
    note("error: " + " ".join(text.split()))


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """A short table without frames; numbers to the right."""
    say(columns(header, rows))


def progress(stage: str, fraction: float) -> None:
    """A line on stderr that overwrites itself, where somebody looks at it."""
    if sys.stderr.isatty():
        text = f"{stage} {100 * fraction:.0f} %" if fraction < 1 else ""
        sys.stderr.write(f"\r\x1b[2K{text}")
        sys.stderr.flush()


@contextmanager
def bar() -> Iterator[Progress]:
    """Show a progress bar on stderr if it is a terminal.

    A Ctrl-C may be swallowed where it arrives, for example in a destructor or in another library's
    callback. The next call of the bar then raises its KeyboardInterrupt.
    """
    from rich.console import Console
    from rich.progress import Progress as Bar

    shown = Console(stderr=True)
    with Bar(console=shown, transient=True, disable=not shown.is_terminal) as drawn:
        task, asked = drawn.add_task("", total=1.0), list[int]()

        def report(stage: str, fraction: float) -> None:
            if asked:
                raise KeyboardInterrupt
            drawn.update(task, description=stage, completed=fraction)

        def interrupted(number: int, frame: object) -> None:
            asked.append(number)
            raise KeyboardInterrupt

        before = signal.signal(signal.SIGINT, interrupted)
        try:
            yield report
        finally:
            signal.signal(signal.SIGINT, before)
