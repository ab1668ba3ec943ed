"""Whether a diagnosis of a part of many samples has the verdict of a diagnosis of all.

A virtual Delta visits 1e4 poses (or N), without an effect and with one of the tests' size or a part
of it, DRAWS times each. Each session is diagnosed from about 2000 samples (or PART) and, with
`--all`, from all of them. Two diagnoses agree if they have the same verdict, and if each effect of
one is an effect of the other or one that the data do not distinguish from it (`swaps`).
Usage: `python -m bench.truth.thinned [--all] [--draws DRAWS] [N [PART]]`.
"""

from __future__ import annotations

import argparse
import sys
import time

import numpy as np
import virtual_findings as vf
from findings import dataset
from rich.console import Console
from rich.table import Table

from parallel_cal.diagnosis.diagnose import diagnose
from parallel_cal.diagnosis.result import Diagnosis
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


def session(kind: str, size: float, n: int, seed: int) -> Dataset:
    """A session of n poses, a fifth of them visited twice; `size` is in sizes of the tests."""
    one, day = vf.KINDS.get(kind), vf.session(seed, n - n // 6, n // 6)
    effects = [one.make(size * one.size, np.random.default_rng(seed))] if one else []
    return dataset(vf.samples(day, effects, vr.THESIS_NOISE, seed), vr.THESIS_NOISE)


def found(data: Dataset) -> tuple[Diagnosis, str]:
    begin = time.process_time()
    diagnosis = diagnose(new_model("delta54"), data)
    return diagnosis, f"{time.process_time() - begin:.0f}"


def words(diagnosis: Diagnosis) -> str:
    names = [" or ".join([name, *diagnosis.swaps.get(name, [])]) for name in diagnosis.effects]
    return f"{diagnosis.verdict.word}: {', '.join(names) or '-'}"


def agree(one: Diagnosis, other: Diagnosis) -> bool:
    def lists(a: Diagnosis, b: Diagnosis) -> bool:
        """Whether each effect of b is one of a, or in place of one."""
        known = {n for name in a.effects for n in (name, *a.swaps.get(name, []))}
        return set(b.effects) <= known

    same = one.verdict.word == other.verdict.word and len(one.effects) == len(other.effects)
    return same and (lists(one, other) or lists(other, one))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--all", action="store_true", help="also diagnose all samples")
    parser.add_argument("--draws", type=int, default=1, help="sessions of each kind and size")
    parser.add_argument("n", nargs="?", type=float, default=1e4)
    parser.add_argument("part", nargs="?", type=float, default=2e3)
    given = parser.parse_args()
    table = Table("hidden", "size", "samples", "of a part", "CPU s", "of all", "CPU s", "agree")
    for kind, size in CASES:
        for seed in range(given.draws):
            data = session(kind, size, int(given.n), seed)
            part, seconds = found(data.thinned(int(given.part)))
            row = [kind, f"{size:g}", str(len(data)), words(part), seconds]
            if given.all:
                whole, seconds = found(data)
                row += [words(whole), seconds, "yes" if agree(part, whole) else "no"]
            table.add_row(*row)
            print(*row, sep=" | ", file=sys.stderr, flush=True)
    Console(width=140).print(table)


if __name__ == "__main__":
    main()
