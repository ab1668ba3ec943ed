"""Output of the commands: documents and tables on stdout, notes on stderr.

A terminal gets lines of its width and colours. A pipe and a file get the same text without colours,
and one line for each sentence.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TextIO

from parallel_cal.base.documents import to_json_value
from parallel_cal.base.progress import Progress
from parallel_cal.reporting.blocks import Block, as_text
from parallel_cal.reporting.readable import (
    COMMAND,
    FOUND,
    HEADING,
    LABEL,
    ODD,
    Paint,
    columns,
    plain,
    wrap,
)

STOPPED = "stopped; the finished work is kept; run the same command again to resume"
MAX_WARNINGS = 3  # of a command on a terminal
MIN_WIDTH = 40
PATIENCE = 2.0  # s, after which the time left is shown
BAR_WIDTH = 20
# SGR codes of the marks: dim, bold, green, yellow, cyan, yellow, red.
COLOURS = {
    HEADING: "2",
    LABEL: "1",
    FOUND: "32",
    ODD: "33",
    COMMAND: "36",
    "warning": "33",
    "error": "31",
}


def emit(document: Any) -> None:
    """Write one JSON document to stdout."""
    sys.stdout.write(json.dumps(to_json_value(document), allow_nan=False) + "\n")


def say(text: str) -> None:
    """Write lines of the answer to stdout; a terminal gets long ones wrapped."""
    if (columns_of_line := width(sys.stdout)) is not None:
        text = "\n".join(
            "\n".join(wrap(line, columns_of_line, "  ")) if len(line) > columns_of_line else line
            for line in text.split("\n")
        )
    write(text)


def write(text: str) -> None:
    """Write lines to stdout as they are: tables, files, and commands to copy."""
    sys.stdout.write(text + "\n")


def show(blocks: Iterable[Block], options: Collection[str] = ()) -> None:
    """Write blocks to stdout, with the details of these options."""
    write(as_text(blocks, options, width(sys.stdout), paint(sys.stdout)))


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Write a short table without frames, with numbers aligned to the right."""
    write(columns(header, rows, width(sys.stdout), paint(sys.stdout)))


def note(text: str, mark: str = "") -> None:
    """Write a line that is not part of the answer, such as a warning, to stderr.

    The mark colours the first word."""
    columns_of_line = width(sys.stderr)
    if columns_of_line is not None:
        text = "\n".join(wrap(text, columns_of_line, "  "))
    first, space, rest = text.partition(" ")
    _bar.clear()
    sys.stderr.write(f"{paint(sys.stderr)(first, mark)}{space}{rest}\n")


def warn(warnings: Iterable[str], brief: bool = False) -> None:
    """Write warnings to stderr.

    `brief` is for commands with the option --details: a terminal then gets one line for each
    warning, and a count instead of those after the third. A pipe gets all of them.
    """
    given, columns_of_line = list(warnings), width(sys.stderr)
    if not brief or columns_of_line is None:
        for text in given:
            note(f"warning: {text}", "warning")
        return
    lines = [wrap(f"warning: {text}", columns_of_line - len(" ...")) for text in given]
    for first, *others in lines[:MAX_WARNINGS]:
        note(f"{first} ..." if others else first, "warning")
    more = len(lines[MAX_WARNINGS:])
    if more:
        note(
            f"{more} more warnings; --details shows all"
            if more > 1
            else "1 more warning; --details shows all"
        )
    elif any(len(line) > 1 for line in lines):
        note("--details shows the whole warnings")


def error(text: str) -> None:
    """Write an error as one line, which a terminal gets wrapped."""
    note(f"error: {' '.join(text.split())}", "error")


def width(stream: TextIO) -> int | None:
    """Return the columns of the terminal; None if the stream is a pipe or a file."""
    if not stream.isatty():
        return None
    return max(shutil.get_terminal_size().columns, MIN_WIDTH)


def paint(stream: TextIO) -> Paint:
    """Return the function that colours marked texts.

    It leaves them plain in a pipe or a file, with the variable NO_COLOR, and on a terminal without
    colours.
    """
    colours = stream.isatty() and not os.environ.get("NO_COLOR")
    return _colour if colours and os.environ.get("TERM") != "dumb" else plain


def _colour(text: str, mark: str) -> str:
    code = COLOURS.get(mark)
    return f"\x1b[{code}m{text}\x1b[0m" if code and text.strip() else text


@dataclass
class Bar:
    """A line on stderr that overwrites itself: what is done, its share, and the time left."""

    clock: Callable[[], float] = time.monotonic
    start: float = 0.0
    last: float = 1.0
    drawn: bool = False

    def __call__(self, stage: str, fraction: float) -> None:
        """Draw the line if stderr is a terminal; a share of 1 removes it."""
        columns_of_line = width(sys.stderr)
        if columns_of_line is None:
            return
        now = self.clock()
        if self.last >= 1 or fraction < self.last:  # other work begins
            self.start = now
        self.last = fraction
        self.clear()
        if fraction >= 1:
            return
        done = round(BAR_WIDTH * fraction)
        left, elapsed = "", now - self.start
        if elapsed >= PATIENCE and fraction > 0:
            left = f", {format_duration(elapsed * (1 - fraction) / fraction)} left"
        bar = f"[{'#' * done}{'-' * (BAR_WIDTH - done)}] {100 * fraction:3.0f} %{left}"
        sys.stderr.write(f"{bar}  {stage}"[: columns_of_line - 1])
        sys.stderr.flush()
        self.drawn = True

    def clear(self) -> None:
        """Remove the line."""
        if self.drawn:
            sys.stderr.write("\r\x1b[2K")
            sys.stderr.flush()
        self.drawn = False


def format_duration(seconds: float) -> str:
    """Format a time as `45 s`, `3 min` or `1 h 20 min`."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    hours, minutes = divmod(round(seconds / 60), 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min"


_bar = Bar()


def progress(stage: str, fraction: float) -> None:
    """Draw a progress bar on stderr if it is a terminal; a share of 1 removes it."""
    _bar(stage, fraction)


@contextmanager
def bar() -> Iterator[Progress]:
    """Show a progress bar on stderr if it is a terminal.

    A Ctrl-C may be swallowed where it arrives, for example in a destructor or in another library's
    callback. The next call of the bar then raises its KeyboardInterrupt.
    """
    asked = list[int]()

    def report(stage: str, fraction: float) -> None:
        if asked:
            raise KeyboardInterrupt
        progress(stage, fraction)

    def interrupted(number: int, frame: object) -> None:
        asked.append(number)
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, interrupted)
    try:
        yield report
    finally:
        signal.signal(signal.SIGINT, before)
        progress("", 1.0)
