"""Run a long study in slices: an outcome a line of a file, and none is computed twice."""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that say where the outcomes are kept and how long a slice takes."""
    parser.add_argument("--results", type=Path)
    parser.add_argument("--minutes", type=float, default=math.inf)


def run_missing(
    cases: Iterable[Any],
    outcomes: dict[Any, Any],
    run: Callable[[Any], Any],
    results: Path | None,
    minutes: float = math.inf,
) -> list[Any]:
    """Run the cases that have no outcome yet, while there is time, and append each to the file.

    Returns
    -------
    list
        The outcomes of `cases`, as far as there are any.
    """
    cases, until = [*cases], time.monotonic() + 60 * minutes
    for case in cases:
        if case in outcomes:
            continue
        if time.monotonic() > until:
            break
        outcomes[case] = run(case)
        if results:
            with results.open("a", encoding="utf-8") as lines:
                lines.write(json.dumps(asdict(outcomes[case])) + "\n")
    return [outcomes[c] for c in cases if c in outcomes]
