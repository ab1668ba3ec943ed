"""What the demo tells on the way."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

UNITS = {"position": ("um", 1e6), "orientation": ("arcmin", 60 * 180 / math.pi)}


class Story:
    """What the demo tells on the way, for people; silent for --json."""

    def __init__(self, silent: bool, keep: bool):
        from rich.console import Console

        # progress is for those who look on, and never part of the answer
        self._out = Console(quiet=silent, highlight=False, soft_wrap=True)
        self._status = Console(stderr=True, quiet=silent or not sys.stderr.isatty()).status("")
        self._left = f"nothing is left running, the files are {'kept' if keep else 'removed'}"

    def __enter__(self) -> None:
        self._say("[bold]A Delta robot misses its targets. By how much, and what helps?[/]")
        self._say("[dim]virtual robot, bags/README.md; everything below runs through ROS 2[/]\n")

    def __exit__(self, *_: object) -> None:
        self._status.stop()

    def _say(self, text: str) -> None:
        self._status.stop()
        self._out.print(text)

    def progress(self, stage: str, fraction: float) -> None:
        self._status.update(f"{stage} {100 * min(fraction, 1.0):.0f} %")
        self._status.start()

    def collected(self, counted: Mapping[str, int]) -> None:
        self._line(
            "collected",
            f"{counted['collected']} samples of {counted['joint_states']} joint readings and "
            f"{counted['poses']} poses, {counted['dropped']} dropped",
        )
        self._line("", f"{counted['kept_apart']} of them are kept apart: the fit never sees them")

    def missed(self, when: str, errors: Mapping[str, Any]) -> None:
        position, orientation = (_readable(kind, errors) for kind in UNITS)
        self._line(when, f"kinematics_node is off by {position} and {orientation} there")

    def identified(self, fit: Mapping[str, Any]) -> None:
        self._line(
            "identified",
            f"{fit['free']} parameters from {fit['samples']} samples, "
            f"chi2/dof {fit['chi2_per_dof']:.2f} (1: only noise is left)",
        )

    def served(self, path: Path, hash: str, seconds: float) -> None:
        self._line("written", str(path))
        self._line("", f"sha256 {hash}")
        self._line("served", f"kinematics_node took the file over within {seconds + 0.05:.1f} s")

    def _line(self, what: str, text: str) -> None:
        self._say(f"[cyan]{what:10}[/]  {text}")

    def calibrated(self, document: Mapping[str, Any]) -> None:
        self._say("")
        self._out.print(_table(document))
        if document["at_noise"]:
            verdict = "[bold green]What is left is no more than the measurements' noise.[/]"
        else:
            verdict = "[bold yellow]More than noise is left: an effect is missing.[/]"
        self._say(f"\n{verdict}")

    def loaded(self, name: str, samples: int, apart: int) -> None:
        self._say("\n[bold]Another day the same robot is off again. What is missing?[/]\n")
        self._line("loaded", f"{samples} samples of bags/{name}, {apart} of them kept apart")

    def diagnosed(self, message: str) -> None:
        verdict, errors = message.rsplit(": ", 1)
        self._line("diagnosed", verdict)
        self._line("", errors)

    def added(self, effect: str, seconds: float) -> None:
        took = f"kinematics_node took it over within {seconds + 0.05:.1f} s"
        self._line("added", f"{effect}: identified anew and written; {took}")

    def end(self, document: Mapping[str, Any]) -> None:
        self._say(f"\n[dim]{document['seconds']:.0f} s in all; {self._left}.[/]")
        if "hidden" in document:
            bag = f"bags/{document['hidden']['recording']}"
            self._say(
                "[dim]The same on a live page, step by step:[/] . .venv/bin/activate && "
                f"parallel-cal workbench config/delta_mockup_nominal.yaml {bag}"
            )


def _readable(kind: str, errors: Mapping[str, Any]) -> str:
    unit, factor = UNITS[kind]
    digits = 1 if kind == "position" else 2
    return f"{errors[f'{kind}_mean'] * factor:.{digits}f} {unit}"


def _table(document: Mapping[str, Any]) -> Any:
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    table.add_column("mean, unseen poses")
    for name in ("before", "after", "noise alone", "better by"):
        table.add_column(name, justify="right")
    apart, noise = document["kept_apart"], document["noise_floor"]
    for kind in UNITS:
        cells = [_readable(kind, errors) for errors in (apart["before"], apart["after"], noise)]
        table.add_row(kind, *cells, f"{document['improvement'][kind]:.0f}x")
    return table
