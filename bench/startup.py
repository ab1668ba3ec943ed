"""How long the command line takes to start, beside Python and the imports it cannot avoid."""

from __future__ import annotations

import subprocess
import sys

from timing import Row, seconds_each, show

CODE = {
    "python": "pass",
    "numpy": "import numpy",
    "numpy and casadi": "import numpy, casadi",
}
COMMANDS = (["--help"], ["mechanisms", "--json"], ["effects", "--json"])


def main() -> None:
    rows = [_row(name, ["-c", code]) for name, code in CODE.items()]
    rows += [_row(f"parallel-cal {' '.join(c)}", ["-m", "parallel_cal.cli", *c]) for c in COMMANDS]
    show("start-up, to the end of the process", rows)


def _row(name: str, arguments: list[str]) -> Row:
    command = [sys.executable, *arguments]
    return Row(
        name,
        seconds_each(lambda: subprocess.run(command, check=True, capture_output=True), least=1),
    )


if __name__ == "__main__":
    main()
