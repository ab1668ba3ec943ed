"""Everything that is printed: documents and tables on stdout, notes on stderr."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Sequence
from typing import Any

from parallel_cal.base.documents import plain
from parallel_cal.reporting.readable import columns


def emit(document: Any) -> None:
    """One JSON document on stdout."""
    sys.stdout.write(json.dumps(plain(document), allow_nan=False) + "\n")


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
