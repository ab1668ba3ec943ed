"""What the command line takes to start, beside Python and the imports that most of it needs, and
what a pose, a fit and a diagnosis of a recording take as commands.

Time of the processor, the least of several runs: what else the machine does is not ours. Bytecode
is kept, as users have it.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path

from bench.speed.timing import Row, show

ROOT = Path(__file__).resolve().parents[2]
MODEL, RECORDING = "config/delta_mockup_nominal.yaml", "bags/delta_backlash"
CODE = {
    "numpy and casadi": "import numpy, casadi",
    "numpy": "import numpy",
    "typer, and pydantic that it may use": "import typer; from pydantic import TypeAdapter",
    "typer": "import typer",
    "python": "pass",
}
COMMANDS = {
    "--help": ["--help"],
    "mechanisms --json": ["mechanisms", "--json"],
    "effects --json": ["effects", "--json"],
    "direct, one pose": ["direct", MODEL, "--joints", "0", "0", "0"],
    "fit of a recording": ["fit", MODEL, RECORDING],
    "diagnose of a recording": ["diagnose", MODEL, RECORDING],
}


def main() -> None:
    rows = [Row(name, _least(["-c", code])) for name, code in CODE.items()]
    show("start-up and commands, to the end of the process", rows + command_rows())


def command_rows(checkout: Path = ROOT) -> list[Row]:
    """Times of the commands of a checkout of the repository."""
    run = ["-m", "parallel_cal.cli"]
    return [
        Row(f"parallel-cal {name}", _least([*run, *command], checkout))
        for name, command in COMMANDS.items()
    ]


def _least(arguments: list[str], checkout: Path = ROOT) -> float:
    return min(_processor([sys.executable, *arguments], checkout) for _ in range(7))


def _processor(command: list[str], checkout: Path) -> float:
    own = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        command,
        check=True,
        capture_output=True,
        cwd=checkout,
        env=own | {"PYTHONPATH": str(checkout)},
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


if __name__ == "__main__":
    main()
