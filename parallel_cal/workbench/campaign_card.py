"""The robot calibrates itself: begun, watched, paused and stopped on the page."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

from nicegui import ui

from parallel_cal.base.errors import ParallelCalError
from parallel_cal.reporting.colours import MEASURED
from parallel_cal.workbench.bench import Live
from parallel_cal.workbench.widgets import COLOURS, card, draw_figure, make_chart

INACTIVE_STATES = ("", "stopped", "done")


class CampaignBar:
    """What the robot does by itself, with Pause and STOP: in the header, so that nobody has to
    scroll for them while the robot moves."""

    def __init__(self, live: Live):
        self.live = live
        with ui.row().classes("w-full no-wrap items-center gap-2"):
            with ui.column().classes("grow min-w-0 gap-0"):
                self.words = ui.label().classes("w-full campaign-words")
                self.words.props("id=campaign aria-live=polite")
                self.asked = ui.label().classes("w-full").props("id=asked role=alert")
                self.asked.style(f"color: {COLOURS['amber']}")
            self.steers = {
                word: self._button(name, word)
                for word, name in (
                    ("continue", "It is done, go on"),
                    ("resume", "Resume"),
                    ("pause", "Pause"),
                    ("stop", "STOP"),
                )
            }
            self.steers["stop"].props("color=negative unelevated").tooltip(
                "end the campaign: the robot is stopped on its path"
            )

    def show(self, told: dict[str, Any]) -> None:
        """What is known of the campaign now, as `nodes.steering` tells."""
        state = told["state"]
        going = state not in INACTIVE_STATES
        for word, seen in (
            ("resume", state == "paused"),
            ("pause", state != "paused"),
            ("continue", state == "asking"),
        ):
            self.steers[word].set_visibility(seen)
        self.steers["pause"].set_enabled(going and state != "asking")
        # Where nothing was heard of a campaign there may be one all the same.
        self.steers["stop"].set_enabled(going or not state)
        self.words.set_text(_describe_status(told))
        self.asked.set_text(told["reason"] if state == "asking" else "")
        self.asked.set_visibility(state == "asking")

    def _button(self, name: str, word: str) -> Any:
        click = partial(_try, partial(self.live.steer, word))
        return ui.button(name, on_click=click).props("dense").classes("shrink-0")


class CampaignCard:
    """Begins a campaign, and shows how its error falls."""

    def __init__(self, live: Live):
        self.live, self._curve = live, list[Any]()
        with card("The robot calibrates itself"):
            with ui.row().classes("items-center"):
                self.poses, self.minutes, self.payload = (
                    ui.number(words, value=value, min=least).props("dense").classes("w-40")
                    for words, value, least in (
                        ("poses at most", 80, 1),
                        ("minutes at most", 60, 1),
                        ("kg that can be put on", 0, 0),
                    )
                )
                self.begin = ui.button("Calibrate", on_click=self._begin).props("dense")
            self.going = ui.label("It is at it: Pause and STOP are at the top of the page.")
            figure = make_chart(
                {"title": {"text": "poses measured"}, "rangemode": "tozero"},
                "error [µm]",
                mode="lines+markers",
                marker={"color": MEASURED, "size": 6},
            )
            self.chart = draw_figure(figure, "error at poses that no fit saw, over poses")

    def show(self, told: dict[str, Any]) -> None:
        """What is known of it now, as `nodes.steering` tells."""
        at_rest = told["state"] in INACTIVE_STATES
        self.begin.set_visibility(at_rest)
        self.going.set_visibility(not at_rest)
        self.chart.set_visibility(bool(told["curve"]))
        if told["curve"] != self._curve:
            self._curve = told["curve"]
            trace = self.chart.figure["data"][0]
            trace["x"] = [poses for poses, _ in self._curve]
            trace["y"] = [1e6 * error for _, error in self._curve]
            self.chart.update()

    def _begin(self) -> None:
        numbers = (self.poses, self.minutes, self.payload)
        poses, minutes, payload = (float(one.value or 0) for one in numbers)
        _try(partial(self.live.calibrate, poses=int(poses), minutes=minutes, payload=payload))


def _try(ask: Callable[[], None]) -> None:
    try:
        ask()
    except ParallelCalError as error:
        ui.notify(str(error), type="negative")


def _describe_status(told: dict[str, Any]) -> str:
    """One line: what it does, how far it is."""
    if not told["state"]:
        return "nothing is known of it yet"
    words = f"{told['state']}: {told['reason']}"
    if told["poses"]:
        words += f"; {told['poses']} poses"
    if not math.isnan(told["error_unseen"]):
        words += f", {1e6 * told['error_unseen']:.0f} µm off at poses that no fit saw"
    if told["state"] in INACTIVE_STATES and told["answer"]:
        words = f"{told['state']}: {told['answer']}; Take samples, then Fit, show it here"
    return words
