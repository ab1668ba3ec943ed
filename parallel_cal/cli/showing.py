"""Commands that run the demonstration and the benchmarks."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from typing import Annotated

import typer

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.cli.arguments import Json
from parallel_cal.reporting import console

CONTAINED = ("peers",)  # all tables of these are those of `speed`, too


def demo(
    effect: Annotated[str, typer.Option(help="hidden effect [default: drawn at random]")] = "",
    seed: Annotated[
        int | None, typer.Option(help="seed of the robot's parameters [default: random]")
    ] = None,
    as_json: Json = False,
) -> None:
    """Let a simulated robot calibrate itself. Needs ROS 2."""
    try:
        module = import_module("parallel_cal.nodes.demo")
    except ModuleNotFoundError as error:
        raise ParallelCalError(
            f"the demonstration needs ROS 2 ({error.name} was not found): source your ROS "
            "installation, or pip install 'parallel_cal[ros]'"
        ) from None
    sys.exit(module.main(json=as_json, effect=effect, seed=seed))


def bench(
    names: Annotated[
        list[str] | None, typer.Argument(help="names of benchmarks [default: all]")
    ] = None,
) -> None:
    """Run the benchmarks of speed and accuracy in bench/. Needs the repository."""
    import os
    import subprocess

    root = Path(__file__).resolve().parents[2]
    files = sorted(root.glob("bench/*/*.py"), key=lambda file: file.stem)
    scripts = {f.stem: f for f in files if "__main__" in f.read_text(encoding="utf-8")}
    if not scripts:
        raise ParallelCalError(
            f"{root / 'bench'}: no benchmarks found; clone the repository to run them"
        )
    unknown = [name for name in names or [] if name not in scripts]
    if unknown:
        raise ParallelCalError(
            f"unknown benchmark {', '.join(unknown)}; expected one of {', '.join(scripts)}"
        )
    places = [str(root), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, places))}
    for name in names or [name for name in scripts if name not in CONTAINED]:
        console.note(f"{name} ...")
        module = ".".join(scripts[name].relative_to(root).with_suffix("").parts)
        done = subprocess.run([sys.executable, "-m", module], env=environment, check=False)
        if done.returncode:
            raise ParallelCalError(f"{scripts[name]} failed (exit {done.returncode})")
