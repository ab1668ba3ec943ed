"""Whether measuring what a diagnosis plans settles its doubt, on the independent virtual robot.

Each draw hides one effect of a pair that the first session cannot tell apart, drives the planned
poses by way of their stops and in their order, and diagnoses all samples together.
Usage: `python -m bench.truth.settle [draws] [pair ...]`.
"""

from __future__ import annotations

import sys
from collections import Counter

from settling import DOUBTS, settled


def main() -> None:
    draws = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    for name, doubt in DOUBTS.items():
        if not sys.argv[2:] or name in sys.argv[2:]:
            ends = Counter(settled(doubt, seed) for seed in range(draws))
            good = sum(n for (_, end), n in ends.items() if end.startswith("settled"))
            print(f"{name}: settled {good} of {draws}; {dict(ends)}", flush=True)


if __name__ == "__main__":
    main()
