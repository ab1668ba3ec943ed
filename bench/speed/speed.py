"""The tables of docs/speed.md, all from one run: commands, diagnoses, and every peer of peers.py.

Usage: `parallel-cal bench speed`, or `python -m bench.speed.speed [--before FOLDER] [--page]`, in
an environment with the peers (see peers.py). FOLDER is a checkout of an older version, whose
commands are timed in the same run. `--page` writes the tables into the page.
"""

from __future__ import annotations

import argparse
import os
import platform
import re
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from multiprocessing import get_context
from pathlib import Path

from bench.speed import diagnosis, peers
from bench.speed.startup import command_rows
from bench.speed.timing import readable
from bench.truth.blind import put_between

PAGE = Path(__file__).resolve().parents[2] / "docs" / "speed.md"
START, END = (
    "<!-- measured: written by bench/speed/speed.py --page -->",
    "<!-- end of the tables -->",
)
PEERS = ("casadi", "numpy", "scipy", "mujoco", "pin", "figaroh")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--before", type=Path, help="checkout of an older version")
    parser.add_argument("--page", action="store_true", help=f"write the tables into {PAGE.name}")
    given = parser.parse_args()
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # users keep bytecode
    text = "\n".join(lines(given.before))
    print(text)
    if given.page:
        put_between(PAGE, START, END, text)


def lines(before: Path | None) -> Iterator[str]:
    """Yield the lines of all tables, in Markdown."""
    yield f"{platform.machine()}, Python {platform.python_version()}, {', '.join(_versions())}."
    yield from _commands(before)
    yield from _diagnoses()
    for title, rows in peers.tables():
        yield from _head(title[0].upper() + title[1:], "what", "time", "ratio")
        first = rows[0].seconds
        for row in rows:
            name = re.sub("^(--[^,]*)", r"`\1`", row.name)
            if row.seconds is None or first is None:
                yield _row(name, "not installed", "")
            else:
                ratio = row.seconds / first
                yield _row(name, readable(row.seconds), f"{ratio:.{2 if ratio < 100 else 0}f}")


def _versions() -> Iterator[str]:
    for name in PEERS:
        try:
            yield f"{name} {version(name)}"
        except PackageNotFoundError:
            yield f"{name} not installed"


def _commands(before: Path | None) -> Iterator[str]:
    old = {row.name: row.seconds for row in command_rows(before)} if before else {}
    yield from _head("Commands, to the end of the process", "command", "before", "now", "ratio")
    for row in command_rows():
        assert row.seconds is not None
        was = old.get(row.name)
        cells = (readable(was), f"{row.seconds / was:.2f}") if was else ("", "")
        name = re.sub("^(parallel-cal [a-z-]+(?: --json)?)", r"`\1`", row.name)
        yield _row(name, cells[0], readable(row.seconds), cells[1])


def _diagnoses() -> Iterator[str]:
    yield from _head(
        "Diagnosis with the whole catalogue, and one fit of the same data",
        *("data", "samples", "fit [s]", "first diagnosis [s]", "later [s]", "first / fit"),
    )
    # A fresh process for each, so that nothing is built yet.
    with get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        for name, samples, fit, first, later, ratio, *_ in pool.imap(
            diagnosis.measured, diagnosis.CASES
        ):
            yield _row(name, samples, fit, first, later, ratio)


def _head(title: str, *columns: str) -> list[str]:
    rule = "|" + "|".join(["---", *["--:"] * (len(columns) - 1)]) + "|"
    return ["", f"### {title}", "", _row(*columns), rule]


def _row(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
