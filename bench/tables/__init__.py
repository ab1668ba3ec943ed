"""The tables and figures of the thesis and the paper again: `python -m bench.tables`.

For each group of tables one file computes `numbers`, which docs/tables.json keeps, and a page
writes them into a `section` beside the printed ones.
"""

import sys
from pathlib import Path

# The robots that are measured here come from the tests: they share nothing with the package.
sys.path.insert(0, str(Path(__file__).parents[2] / "test"))
