"""Writes docs/tables.json, docs/tables.md and the pictures: `python -m bench.documents.tables`.

With names (slider_crank, delta, argos, paper) only these are computed again; the others stay.
"""

from __future__ import annotations

import json
import sys
from importlib import import_module
from pathlib import Path
from time import perf_counter
from typing import Any

from bench.documents.tables.common import rounded
from parallel_cal.base.threads import single_threaded

DOCS = Path(__file__).parents[2] / "docs"
GROUPS = ("slider_crank", "delta", "argos", "paper")
INTRODUCTION = """# The documents' tables again

What P. Vischer's thesis (*Improving the Accuracy of Parallel Robots*, EPFL 1996) and the paper by
Savoure, Maurine, Corbel and Krut (ICRA 2006) print, beside what parallel_cal finds. Their data are
not public: ours come from virtual robots with the printed dimensions and the printed noise, built
in `parallel_cal/virtual` and `test/helpers/virtual_*.py` from points and rods without a line of the
rest. Where a difference remains, the text says why. `make tables` computes this page; the numbers,
with more digits, are in [tables.json](tables.json), and `test/thesis/test_tables.py` holds them.
Seeds are 0, 1, 2 and so on.
"""


def page(document: dict[str, Any]) -> str:
    """docs/tables.md for the numbers in docs/tables.json."""
    sections = [group(f"{name}_page").section(document[name]) for name in GROUPS]
    errata = Path(__file__).with_name("errata.md").read_text(encoding="utf-8")
    return "\n\n".join([INTRODUCTION.strip(), *sections, errata.strip()]) + "\n"


def group(name: str) -> Any:
    return import_module(f"bench.documents.tables.{name}")


def compute(name: str, **small: int) -> dict[str, Any]:
    """A group's entry in docs/tables.json; `small` numbers of draws for a quick look."""
    with single_threaded():
        return rounded(group(name).numbers(**small))


def main() -> None:
    file = DOCS / "tables.json"
    document = json.loads(file.read_text()) if file.exists() else {}
    for name in sys.argv[1:] or GROUPS:
        begin = perf_counter()
        print(f"{name} ...", flush=True)
        document[name] = compute(name)
        file.write_text(
            json.dumps({n: document[n] for n in GROUPS if n in document}, indent=1) + "\n"
        )
        print(f"{name}: {perf_counter() - begin:.0f} s")
    (DOCS / "tables.md").write_text(page(document))
    group("pictures").draw(document, DOCS / "tables")
    print(f"wrote {DOCS / 'tables.md'}, tables.json and pictures")


if __name__ == "__main__":
    main()
