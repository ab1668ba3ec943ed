"""The text that the demo prints while it runs."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from typing import Any

WIDTH = 46  # characters of the longest bar


class Story:
    """Prints what the robot does, and prints nothing with --json."""

    def __init__(self, silent: bool):
        from rich.console import Console

        # The progress goes to stderr: it is no part of the result.
        self._out = Console(quiet=silent, highlight=False, soft_wrap=True)
        self._status = Console(stderr=True, quiet=silent or not sys.stderr.isatty()).status("")
        self._verdict, self._purposes = "", set[str]()

    def __enter__(self) -> None:
        self._say("[bold]A Delta robot misses its targets. It finds the cause by itself.[/]")
        self._say(
            "[dim]A simulated robot with a controller and a tracker runs at four times real time.\n"
            "Its geometry differs from the drawing, and it has a hidden effect. All data pass\n"
            "through ROS 2.[/]\n"
        )

    def __exit__(self, *_: object) -> None:
        self._status.stop()

    def _say(self, text: str) -> None:
        self._status.stop()
        self._out.print(text)

    def on_status(self, status: Any) -> None:
        """Print what is new in a status of the campaign."""
        if status.state == "moving" and status.purpose not in self._purposes:
            self._line("measures", status.purpose)
            self._purposes.add(status.purpose)
        elif status.state == "asking":
            self._line("asks", f"{status.reason} [dim](done by the demo)[/]")
        if status.verdict and not math.isnan(status.error_unseen):
            error = f"error at validation poses {_um(status.error_unseen)}"
            verdict = f"{status.verdict.replace('_', ' ')}, {error}"
            if verdict != self._verdict:
                self._line("judges", f"{status.poses} poses, {verdict}")
                self._verdict = verdict
        self._status.update(f"{status.state}: {status.reason}")
        self._status.start()

    def _line(self, what: str, text: str) -> None:
        self._say(f"[cyan]{what:10}[/]  {text}")

    def end(self, document: Mapping[str, Any]) -> None:
        """Print the result of the campaign and how to continue."""
        found = ", ".join(document["effects"]) or "nothing"
        self._say(f"\n[bold]Found: {found}.[/] Hidden: {document['hidden']}.")
        self._say(f"{document['message']}\n")
        self._say("Error at validation poses (rms) against measured poses:")
        for one in document["curve"]:
            self._say(f"{one['poses']:5}  {_bar(one['error_unseen'], document['curve'])}")
        self._say(
            f"\n[dim]{document['seconds']:.0f} s in total. To continue, first run[/] "
            ". .venv/bin/activate"
        )
        for what, command in (
            ("all results on a live page", f"workbench {document['folder']}"),
            ("a robot of your choice", "calibrate robot.yaml --simulated stewart:hidden --reach 2"),
        ):
            self._say(f"[dim]{what:25}[/] parallel-cal {command}")


def _um(metres: float) -> str:
    return f"{1e6 * metres:.0f} um"


def _bar(error: float | None, curve: Any) -> str:
    """Draw a bar as long as the logarithm of an error; it starts at a third of the least one."""
    if not error:
        return "-"
    known = [one["error_unseen"] for one in curve if one["error_unseen"]]
    low, high = math.log(min(known) / 3), math.log(max(known))
    return f"{'█' * round(WIDTH * (math.log(error) - low) / (high - low))} {_um(error)}"
