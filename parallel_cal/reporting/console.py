"""Output of the commands: documents and tables on stdout, notes on stderr."""

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

STOPPED = "stopped; the finished work is kept; run the same command again to resume"


def emit(document: Any) -> None:
    """Write one JSON document to stdout."""
    sys.stdout.write(json.dumps(to_json_value(document), allow_nan=False) + "\n")


def say(text: str) -> None:
    """Write a line of the answer to stdout."""
    sys.stdout.write(text + "\n")


def note(text: str) -> None:
    """Write a line that is not part of the answer, such as a warning, to stderr."""
    sys.stderr.write(text + "\n")


def warn(warnings: Iterable[str]) -> None:
    for text in warnings:
        note(f"warning: {text}")


def error(text: str) -> None:
    """Write an error as one line."""
    note("error: " + " ".join(text.split()))


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Write a short table without frames, with numbers aligned to the right."""
    say(columns(header, rows))


def progress(stage: str, fraction: float) -> None:
    """Write a line that overwrites itself to stderr if it is a terminal."""
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
