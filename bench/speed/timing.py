"""How the benchmarks time and print: of the clock or the processor, and ratios to a first row."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from typing import Any

from rich.console import Console
from rich.table import Table


@dataclass(frozen=True)
class Row:
    """A time; None for a peer that is not installed."""

    name: str
    seconds: float | None


def seconds_each(call: Callable[[], Any], least: int = 2000, repeats: int = 5) -> float:
    """Median over repeats of the mean time of a call, after one call to warm up."""
    return median(_each(time.perf_counter, call, least, repeats))


def processor_each(call: Callable[[], Any], least: int = 2000, repeats: int = 7) -> float:
    """The same of the processor, the least of the repeats: others on the machine count little."""
    return min(_each(time.process_time, call, least, repeats))


def _each(
    clock: Callable[[], float], call: Callable[[], Any], least: int, repeats: int
) -> list[float]:
    call()
    times = []
    for _ in range(repeats):
        begin = clock()
        for _ in range(least):
            call()
        times.append((clock() - begin) / least)
    return times


def show(title: str, rows: list[Row]) -> None:
    """One table; ratios are to the first row, measured in the same run."""
    table = Table("what", "time", "ratio", title=title)
    first = rows[0].seconds
    for row in rows:
        if row.seconds is None or first is None:
            table.add_row(row.name, "not installed", "-")
        else:
            table.add_row(row.name, readable(row.seconds), f"{row.seconds / first:.2f}")
    Console().print(table)


def readable(seconds: float) -> str:
    """A time with its unit."""
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6)):
        if seconds >= size:
            return f"{seconds / size:.2f} {unit}"
    return f"{seconds * 1e9:.0f} ns"
