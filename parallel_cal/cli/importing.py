"""Measurements from tables."""

from __future__ import annotations

from pathlib import Path

from parallel_cal.recordings.csv_import import import_csv
from parallel_cal.recordings.info import info_of, print_info
from parallel_cal.reporting import console


def csv(table: Path, columns: Path, output: Path, as_json: bool) -> None:
    """Save a CSV table as samples, and show them as `look` does."""
    dataset = import_csv(table, columns)
    dataset.to_json(output)
    document = info_of(dataset)
    if as_json:
        return console.emit(document | {"output": str(output)})
    from rich.console import Console

    print_info(document, Console())
    console.say(f"written: {output}")
