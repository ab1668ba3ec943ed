"""To see it work: the demonstration and the benchmarks."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from typing import Annotated

import typer

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.cli.arguments import Json
from parallel_cal.reporting import console


def demo(
    effect: Annotated[str, typer.Option(help="what it hides; none: drawn")] = "",
    seed: Annotated[int | None, typer.Option(help="draws how it is built; none: drawn")] = None,
    as_json: Json = False,
) -> None:
    """Let a virtual robot calibrate itself from beginning to end (needs ROS 2)."""
    try:
        module = import_module("parallel_cal.nodes.demo")
    except ModuleNotFoundError as error:
        raise ParallelCalError(f"the demonstration needs {error.name}") from None
    sys.exit(module.main(json=as_json, effect=effect, seed=seed))


def bench(
    names: Annotated[list[str] | None, typer.Argument(help="which ones; none: all")] = None,
) -> None:
    """Run the measurements of speed and accuracy in bench/ (needs the repository)."""
    import subprocess

    folder = Path(__file__).resolve().parents[2] / "bench"
    files = sorted(folder.glob("*.py"))
    scripts = {f.stem: f for f in files if "__main__" in f.read_text(encoding="utf-8")}
    if not scripts:
        raise ParallelCalError(f"{folder}: no benchmarks; they come with the repository")
    unknown = [name for name in names or [] if name not in scripts]
    if unknown:
        raise ParallelCalError(f"no benchmark {', '.join(unknown)}; there are {', '.join(scripts)}")
    for name in names or scripts:
        console.note(f"{name} ...")
        done = subprocess.run([sys.executable, str(scripts[name])], check=False)
        if done.returncode:
            raise ParallelCalError(f"{scripts[name]} failed (exit {done.returncode})")
