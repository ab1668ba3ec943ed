"""What the command line takes to start, beside Python and the imports that most of it needs.

Time of the processor, the least of several runs: what else the machine does is not ours.
"""

from __future__ import annotations

import resource
import subprocess
import sys

from timing import Row, show

CODE = {
    "numpy and casadi": "import numpy, casadi",
    "numpy": "import numpy",
    "typer, and pydantic that it may use": "import typer; from pydantic import TypeAdapter",
    "typer": "import typer",
    "python": "pass",
}
COMMANDS = (["--help"], ["mechanisms", "--json"], ["effects", "--json"])


def main() -> None:
    rows = [_row(name, ["-c", code]) for name, code in CODE.items()]
    rows += [_row(f"parallel-cal {' '.join(c)}", ["-m", "parallel_cal.cli", *c]) for c in COMMANDS]
    show("start-up, to the end of the process", rows)


def _row(name: str, arguments: list[str]) -> Row:
    return Row(name, min(_processor([sys.executable, *arguments]) for _ in range(7)))


def _processor(command: list[str]) -> float:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


if __name__ == "__main__":
    main()
