"""Whether a diagnosis of a part of many samples has the verdict of a diagnosis of all.

A virtual Delta visits 1e4 poses (or N), without an effect and with one of the tests' size or a part
of it. Each session is diagnosed from about 2000 samples (or PART) and, with `--all`, from all of
them, which takes half a gigabyte for every 1000 samples.
Usage: `PYTHONPATH=. python bench/thinned.py [--all] [N [PART]]`.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test"))

import virtual_findings as vf
from findings import dataset

from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.model.model import new_model
from parallel_cal.recordings.dataset import Dataset
from parallel_cal.virtual import robot as vr

CASES = (
    ("nothing", 0.0),
    ("backlash", 1.0),
    ("backlash", 0.3),
    ("backlash", 0.05),
    ("eccentricity", 0.05),
    ("gear ripple", 0.05),
    ("joint compliance", 0.05),
)


def session(kind: str, size: float, n: int) -> Dataset:
    """A session of n poses, a fifth of them visited twice; `size` is in sizes of the tests."""
    one, day = vf.KINDS.get(kind), vf.session(0, n - n // 6, n // 6)
    effects = [one.make(size * one.size, np.random.default_rng(0))] if one else []
    return dataset(vf.samples(day, effects, vr.THESIS_NOISE, 0), vr.THESIS_NOISE)


def found(data: Dataset) -> tuple[str, str]:
    begin = time.process_time()
    diagnosis = diagnose(new_model("delta54"), data)
    words = f"{diagnosis.verdict.word}: {', '.join(diagnosis.effects) or '-'}"
    return words, f"{time.process_time() - begin:.0f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--all", action="store_true", help="also diagnose all samples")
    parser.add_argument("n", nargs="?", type=float, default=1e4)
    parser.add_argument("part", nargs="?", type=float, default=2e3)
    given = parser.parse_args()
    table = Table("hidden", "size", "samples", "of a part", "CPU s", "of all", "CPU s")
    for kind, size in CASES:
        data = session(kind, size, int(given.n))
        part = found(data.thinned(int(given.part)))
        whole = found(data) if given.all else ("", "")
        table.add_row(kind, f"{size:g}", str(len(data)), *part, *whole)
    Console(width=140).print(table)


if __name__ == "__main__":
    main()
