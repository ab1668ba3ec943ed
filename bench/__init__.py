"""Benchmarks, by what they measure: `python -m bench.speed.NAME` the time that something takes,
`bench.truth` what a result is worth, `bench.documents` the numbers of the thesis and the paper.

The robots that are measured come from the tests: they share nothing with the package.
"""

import sys
from pathlib import Path

sys.path[:0] = map(str, sorted((Path(__file__).parents[1] / "test").glob("*/")))
