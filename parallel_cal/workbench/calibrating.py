"""The robot calibrates itself: begun, watched, held and stopped on the page."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

from nicegui import ui

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.reporting.colours import MEASURED
from parallel_cal.workbench.bench import Live
from parallel_cal.workbench.looks import COLOURS, card, course, drawn

AT_REST = ("", "stopped", "done")


class Calibrating:
    """What is said is drawn once, and shown as it changes."""

    def __init__(self, live: Live):
        self.live, self._curve = live, list[Any]()
        with card("The robot calibrates itself"):
            self.said = ui.label().props("id=campaign aria-live=polite")
            self.asked = ui.label().props("id=asked role=alert").style(f"color: {COLOURS['amber']}")
            with ui.row().classes("items-center"):
                self.poses, self.minutes, self.payload = (
                    ui.number(words, value=value, min=least).props("dense").classes("w-40")
                    for words, value, least in (
                        ("poses at most", 80, 1),
                        ("minutes at most", 60, 1),
                        ("kg that can be put on", 0, 0),
                    )
                )
                self.begin = self._button("Calibrate", self._begin)
                self.steers = {
                    word: self._button(name, partial(self._say, word))
                    for word, name in (
                        ("pause", "Pause"),
                        ("resume", "Resume"),
                        ("continue", "It is done, go on"),
                        ("stop", "Stop"),
                    )
                }
            figure = course(
                {"title": {"text": "poses measured"}, "rangemode": "tozero"}, "error [µm]",
                mode="lines+markers", marker={"color": MEASURED, "size": 6},
            )  # fmt: skip
            self.chart = drawn(figure, "error at poses that no fit saw, over poses")

    def show(self, told: dict[str, Any]) -> None:
        """What is known of it now, as `nodes.steering` tells."""
        state = told["state"]
        going = state not in AT_REST
        self.begin.set_visibility(not going)
        for word, seen in (
            ("pause", going and state not in ("paused", "asking")),
            ("resume", state == "paused"),
            ("continue", state == "asking"),
            ("stop", going),
        ):
            self.steers[word].set_visibility(seen)
        self.said.set_text(_words(told))
        self.asked.set_text(told["reason"] if state == "asking" else "")
        self.asked.set_visibility(state == "asking")
        self.chart.set_visibility(bool(told["curve"]))
        if told["curve"] != self._curve:
            self._curve = told["curve"]
            trace = self.chart.figure["data"][0]
            trace["x"] = [poses for poses, _ in self._curve]
            trace["y"] = [1e6 * error for _, error in self._curve]
            self.chart.update()

    def _button(self, name: str, click: Callable[[], None]) -> Any:
        return ui.button(name, on_click=click).props("dense")

    def _begin(self) -> None:
        numbers = (self.poses, self.minutes, self.payload)
        poses, minutes, payload = (float(one.value or 0) for one in numbers)
        self._try(partial(self.live.calibrate, poses=int(poses), minutes=minutes, payload=payload))

    def _say(self, word: str) -> None:
        self._try(partial(self.live.steer, word))

    def _try(self, ask: Callable[[], None]) -> None:
        try:
            ask()
        except ParallelCalError as error:
            ui.notify(str(error), type="negative")


def _words(told: dict[str, Any]) -> str:
    """One line: what it does, how far it is."""
    if not told["state"]:
        return "nothing is known of it yet"
    words = f"{told['state']}: {told['reason']}"
    if told["poses"]:
        words += f"; {told['poses']} poses"
    if not math.isnan(told["error_unseen"]):
        words += f", {1e6 * told['error_unseen']:.0f} µm off at poses that no fit saw"
    if told["state"] in AT_REST and told["answer"]:
        words = f"{told['state']}: {told['answer']}; Take samples, then Fit, show it here"
    return words
